"""What a run's innovations say of each output: the one with outliers is to blame, and only where values are weighed."""

import json

import numpy as np
import pytest

import heliograph as hg
from heliograph import cli
from heliograph.report import examine, run_figures, run_page, run_summary

STEPS = 200
PLANT = hg.LinearPlant([[0.95]], [[1.0]], [0.0], [[10.0]], states=["level"])
LAW = hg.random_affine.Independent([hg.Contaminated(0.1, 0.02, 10.0), hg.Contaminated(0.1, 0.02, 10.0)])
SENSOR = hg.LinearSensor([[1.0], [1.0]], LAW, outputs=["left", "right"])
LINK = hg.erasure(hg.perfect(2), 0.9)
FILTERS = {"robust": hg.robust_filter(PLANT, SENSOR, hg.perfect(2)), "plain": hg.kalman_filter(PLANT, SENSOR)}
NETWORK = hg.Network(PLANT, {"tank": hg.Node(SENSOR, LINK, FILTERS)})


@pytest.fixture(scope="module")
def recorded():
    """A run whose left sensor is off by 15 in 20 of 200 rows, where its law says 2 %."""
    z = hg.monte_carlo(NETWORK, STEPS, 1, key=1).measurements["tank"][0].copy()
    z[::10, 0] += 15.0
    return z


def summarise_weighed_outputs(network, z):
    """What is said of the outputs by the filters that weigh."""
    health = examine(network, hg.run(network, {"tank": z}), np.zeros((STEPS, 0)))
    return [item for item in health.outputs if item.weighs]


def test_only_filters_that_weigh_say_that_they_do():
    rows = np.zeros((3, 2))
    assert hg.adaptive_filter(FILTERS["plain"]).run(rows).weights.shape == (3, 2)
    assert FILTERS["plain"].run(rows).weights is None and FILTERS["robust"].run(rows).weights.shape == (3, 2)


def test_the_output_with_outliers_is_to_blame(recorded):
    left, right = summarise_weighed_outputs(NETWORK, recorded)
    arrived = ~np.isnan(recorded)
    assert (left.judged.summary.received, right.judged.summary.received) == tuple(arrived.sum(axis=0))
    # Of the 20 rows with 15 more (14 deviations of an innovation) those that arrived, and the law's own 2 %.
    off = arrived[::10, 0].sum()
    assert off <= left.judged.summary.down_weighted <= off + 9 and left.judged.to_blame and not right.judged.to_blame
    assert str(left).startswith(
        f"tank/robust: left: {left.judged.summary.down_weighted} of {left.judged.summary.received} down-we"
    )
    assert str(left).endswith("; to blame: more than of the others") and "to blame" not in str(right)


def test_only_a_filter_that_the_network_relies_on_blames_an_output_where_it_weighs(recorded):
    """Of two that weigh the network relies on the first; of `FILTERS` on the one that does not weigh."""
    two = {"robust": FILTERS["robust"], "again": FILTERS["robust"]}
    network = hg.Network(PLANT, {"tank": hg.Node(SENSOR, LINK, two)})
    items = summarise_weighed_outputs(network, recorded)
    assert [(item.filter, item.judged.output) for item in items if item.judged.to_blame] == [("robust", "left")]
    assert items[0].judged.summary == items[2].judged.summary


@pytest.mark.slow
def test_the_page_and_the_last_lines_have_the_same_numbers(recorded, tmp_path, fits, monkeypatch, capsys):
    health = examine(NETWORK, hg.run(NETWORK, {"tank": recorded}), np.zeros((STEPS, 0)))
    assert [item.weighs for item in health.outputs] == [True, True, False, False]
    page = run_page(health, "tank", dict.fromkeys(run_figures(health), b"<svg/>")).html()
    fits(page)
    left = health.outputs[0].judged.summary
    assert f"{left.received} of {STEPS}" in page and "to blame" in page
    numbers = json.loads(json.dumps(run_summary(health)))["outputs"]["tank"]
    assert numbers["robust"]["left"]["down_weighted"] == left.down_weighted and numbers["robust"]["left"]["to_blame"]
    assert "down_weighted" not in numbers["plain"]["left"] and np.isclose(numbers["plain"]["left"]["received"], left[1])
    # The command prints a line for each output of the robust filter, and none of the other.
    (tmp_path / "net.py").write_text(
        "from tests.report.diagnosis.test_sensor_output_health import NETWORK as network\n"
    )
    rows = "\n".join(",".join(["" if np.isnan(x) else repr(float(x)) for x in row]) for row in recorded)
    times = [f"{k},{row}" for k, row in enumerate(rows.split("\n"))]
    (tmp_path / "data.csv").write_text("\n".join(["time,left,right", *times]) + "\n")
    monkeypatch.chdir(tmp_path)
    assert cli.main(["run", "net.py", "--measurements", "data.csv", "--out", "out.csv"]) == 0
    lines = [line for line in capsys.readouterr().out.splitlines() if "down-weighted" in line]
    assert lines == [str(item) for item in health.outputs[:2]]
