"""The page of a run: its numbers are those of the recording, and what is wrong is said."""

import json
import re
from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph import cli
from heliograph.report import Arrivals, FilterHealth, examine, run_figures, run_page, run_summary
from heliograph.report.diagnosis.sensor_output_health import compute_filter_errors, round_to
from heliograph.report.pages.run import make_errors_table
from heliograph.simulation.results.whiteness import MemoryTest
from tests.losing import Tied

STEPS = 300
DRIFT = 0.95 * np.eye(1)
BAD = "</h2>\x1b[31m$x_{"
PLANT = hg.LinearPlant(DRIFT, [[1.0]], [0.0], [[10.0]], states=["level"])
SENSOR = hg.LinearSensor([[1.0], [1.0]], 0.1 * np.eye(2), outputs=["left", "right"])
LINK = hg.erasure(hg.perfect(2), 0.9)
GOOD = hg.linear_filter(PLANT, SENSOR, hg.perfect(2))
CALM = hg.LinearPlant(DRIFT, [[0.01]], [0.0], [[10.0]], states=["level"])
SURE = hg.linear_filter(CALM, SENSOR, hg.perfect(2))
NODES = {"a": hg.Node(SENSOR, LINK, {"sure": SURE, "good": GOOD}), BAD: hg.Node(SENSOR, hg.perfect(2), {})}
WORLD, NETWORK = hg.Network(PLANT, NODES), hg.Network(CALM, NODES)  # what happens, and what was thought of it


@pytest.fixture(scope="module")
def health():
    record = hg.monte_carlo(WORLD, STEPS, 1, key=1)
    received = {node: z[0].copy() for node, z in record.measurements.items()}
    received[BAD][10:14, 1] = np.nan
    return examine(NETWORK, hg.run(NETWORK, received), np.zeros((STEPS, 0)))


@pytest.mark.slow
def test_claims_are_judged_by_innovations(health):
    good, sure = (next(filter_ for filter_ in health.filters if filter_.filter == name) for name in ("good", "sure"))
    assert abs(good.test.power - 1) < 4 * good.test.power_error and not good.test.significant
    assert good.white.shape == (STEPS, 2) and sure.test.power > 5
    assert sure.test.correlation[0] > 0.3  # a filter that follows too slowly is wrong the same way again
    # the whitened innovation of one step by hand: the first, whose prior is the plant's own
    arrived = np.flatnonzero(~np.isnan(health.record.measurements["a"][:, 0]))[0]
    prior = 10.0 * 0.95 ** (2 * (arrived + 1)) + sum(0.95 ** (2 * i) for i in range(arrived + 1))
    first = health.record.measurements["a"][arrived, 0] / np.sqrt(prior + 0.1)
    assert np.isclose(good.white[arrived, 0], first, rtol=1e-9)


def test_links_are_said_as_they_were(health):
    links = {(link.node, link.component): link for link in health.links}
    item = links[BAD, "right"]
    assert (
        item.share == 1 - 4 / STEPS
        and item.longest_gap == 4
        and not item.may_be_lost
        and links["a", "left"].may_be_lost
    )
    rows = np.arange(7.0)
    assert Arrivals("a", "b", rows, np.zeros(7, bool), np.zeros(0), True).longest_gap == 7
    assert Arrivals("a", "b", rows, np.ones(7, bool), np.zeros(7), True).longest_gap == 0


def test_what_is_doubtful_is_said_and_no_more(health):
    lines = health.warnings()
    assert len([line for line in lines if "a/sure is too sure" in line]) == 1
    assert any("right is missing in 1.3% of the rows; the network says that it is never lost" in line for line in lines)
    assert not any("a/good" in line or "a: left" in line for line in lines)


def test_the_page_holds_every_number_and_names_do_not_act_in_it(health, fits):
    figures = run_figures(health)
    assert list(figures) == ["estimates_0", "innovations", "links"]
    page = run_page(health, BAD, dict.fromkeys(figures, b"<svg/>")).html()
    fits(page)
    assert "a/sure" in page and "98.7%" in page and "</h2>\x1b" not in page and "&lt;/h2&gt;\\x1b" in page
    summary = json.loads(json.dumps(run_summary(health)))
    assert summary["rows"] == STEPS and summary["links"][BAD]["right"] == {"arrived": 1 - 4 / STEPS, "longest_gap": 4}
    assert summary["filters"]["a"]["good"]["size"] == next(f for f in health.filters if f.filter == "good").test.power


def test_a_filter_that_lost_its_covariance_claims_nothing_on_the_page():
    """Neither in the table of tests nor beside its errors, nor in the summary."""
    plant = hg.LinearPlant(0.9 * np.eye(2), 0.1, [0.0, 0.0], 1.0, states=["p", "v"])
    sensor = hg.LinearSensor([[1.0, 0.0]], 0.1)
    filters = {"losing": Tied(), "kalman": hg.kalman_filter(plant, sensor)}
    network = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), filters)})
    z = np.random.default_rng(0).normal(size=(30, 1))
    record = hg.run(network, {"a": z}, truth=np.zeros((30, 2)))
    health_ = examine(network, record, np.zeros((30, 0)))
    claims = {item.filter: item.claim for item in health_.filters}
    of_errors = {item.filter: item.claim for item in compute_filter_errors(record)}
    summary = run_summary(health_)["filters"]["a"]
    expected = {"losing": "none", "kalman": "exact"}
    assert claims == of_errors == {name: part["claim"] for name, part in summary.items()} == expected
    assert [row[:2] for row in make_errors_table(record)[0].rows] == [["a/losing", "none"], ["a/kalman", "exact"]]


NET = """
import numpy as np
import heliograph as hg

plant = hg.LinearPlant(0.9 * np.eye(1), np.eye(1), [0.0], np.eye(1))
sensor = hg.LinearSensor(np.eye(1), np.eye(1), outputs=["y"])
node = hg.Node(sensor, hg.perfect(), {"f": hg.kalman_filter(plant, sensor), "open": hg.filters.open_loop_filter(plant)})
network = hg.Network(plant, {"n": node})
"""


@pytest.mark.slow
@pytest.mark.parametrize("value", [0.0, 1.5])
def test_a_recording_at_rest_has_a_page(tmp_path, monkeypatch, capsys, value):
    """All innovations are zero, or become so: there is a page, and status 0."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "net.py").write_text(NET)
    (tmp_path / "data.csv").write_text("time,y\n" + "".join(f"{i},{value}\n" for i in range(60)))
    arguments = ["run", "net.py", "--measurements", "data.csv", "--out", "out.csv", "--report", "page"]
    assert cli.main(arguments) == 0
    assert (tmp_path / "page" / "report.html").is_file() and (tmp_path / "out.csv").is_file()
    assert "expected innovations" not in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("rows", [3, 120])
def test_the_command_writes_a_report(tmp_path, monkeypatch, capsys, rows):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "net.py").write_text(NET)
    times = np.datetime64("2026-11-21T23:59") + np.arange(rows) * np.timedelta64(1, "s")
    (tmp_path / "data.csv").write_text(
        "time,y\n" + "".join(f"{t}+01:00,{jnp.sin(1.0 * i)}\n" for i, t in enumerate(times))
    )
    arguments = ["run", "net.py", "--measurements", "data.csv", "--report", "out/run"]
    assert cli.main(arguments) == 0 and cli.main([*arguments, "--out", "estimates.csv"]) == 0
    said = capsys.readouterr()
    assert "out/run/report.html: " in said.out and said.err.count("warning") == 0
    assert {p.name for p in (tmp_path / "out" / "run").iterdir()} >= {"report.html", "summary.json", "estimates_0.png"}
    summary = json.loads((tmp_path / "out" / "run" / "summary.json").read_text())
    assert ("size" in summary["filters"]["n"]["f"]) == (rows == 120)
    (tmp_path / "mine").mkdir()
    (tmp_path / "mine" / "thesis").touch()
    assert cli.main([*arguments[:-1], "mine"]) == 2 and "got thesis, which would be lost" in capsys.readouterr().err
    assert cli.main(arguments[:-2]) == 2 and "(--out FILE) or a folder for a report" in capsys.readouterr().err


@pytest.mark.slow
def test_of_many_nodes_one_is_chosen_from_a_list_the_fused_estimate_first(fits):
    """Ten nodes and a centre: every estimate and every filter's innovations are there, one shown at a time."""
    sensor = hg.LinearSensor([[1.0]], 0.1, outputs=["height"])
    nodes = {f"n{i}": hg.Node(sensor, hg.perfect(), {"kalman": hg.kalman_filter(PLANT, sensor)}) for i in range(10)}
    network = hg.Network(PLANT, nodes, {"all": hg.Fusion("kalman", hg.CovarianceIntersection())})
    received = np.random.default_rng(0).normal(size=(10, 60, 1))
    record = hg.run(network, dict(zip(nodes, received, strict=True)))
    health_ = examine(network, record, np.zeros((60, 0)))
    figures = run_figures(health_)
    assert list(figures) == [f"estimates_{i}" for i in range(11)] + [f"innovations_{i}" for i in range(10)] + ["links"]
    page = run_page(health_, "net", dict.fromkeys(figures, b"<svg/>")).html()
    fits(page)
    options = re.findall("<option>(.*?)</option>", page)
    assert options == ["fused", *nodes, *nodes] and page.count("<select") == 2 and "Not drawn" not in page
    assert page.index("fused: estimates with bands") < page.index("n0: estimates with bands")
    legend = figures["innovations_0"].axes[0].get_legend()
    assert [text.get_text() for text in legend.get_texts()] == ["height"]


def test_few_nodes_stand_below_each_other(health):
    page = run_page(health, "net", dict.fromkeys(run_figures(health), b"<svg/>")).html()
    assert "<select" not in page and "<script" not in page


CENTRAL = """
import numpy as np
import heliograph as hg

plant = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0, states=["level"])
sensor = hg.LinearSensor([[1.0]], 0.1, outputs=["y"])
both = hg.LinearSensor([[1.0], [1.0]], 0.1)
nodes = {name: hg.Node(sensor, hg.perfect(), {}) for name in ("a", "b")}
network = hg.Network(plant, nodes, {"centre": hg.kalman_filter(plant, both)})
"""


def test_a_network_whose_only_filter_is_the_fused_one_runs(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "net.py").write_text(CENTRAL)
    rows = [f"{k},{np.sin(k)},{np.cos(k)}" for k in range(40)]
    (tmp_path / "data.csv").write_text("\n".join(["time,a.y,b.y", *rows]))
    arguments = ["run", "net.py", "--measurements", "data.csv", "--out", "out.csv", "--report", "report"]
    assert cli.main(arguments) == 0
    assert (tmp_path / "out.csv").read_text().startswith("time,fused.level,fused.level.sd,fused.valid\n")
    page = (tmp_path / "report" / "report.html").read_text()
    assert "fused: estimates with bands" in page and "fused/centre" in page


@pytest.mark.slow
def test_a_filter_to_compare_with_is_no_doubt_about_the_network(fits):
    """Behind a gain that is random, the filter that takes its mean is too sure; the network relies on the exact one."""
    sensor = hg.LinearSensor([[1.0]], 0.1, outputs={"height": "m"})
    plant = hg.LinearPlant(DRIFT, [[1.0]], [3.0], [[10.0]], states={"level": "m"})
    hop = hg.hop(hg.Discrete([0.2, 1.8], [0.5, 0.5]), 0.01)
    filters = {
        "exact": hg.linear_filter(plant, sensor, hop),
        "mean": hg.mean_gain_filter(plant, sensor, hop),
    }
    network = hg.Network(plant, {"a": hg.Node(sensor, hop, filters)})
    record = hg.monte_carlo(network, STEPS, 1, key=2)
    health_ = examine(network, hg.run(network, {"a": record.measurements["a"][0]}), np.zeros((STEPS, 0)))
    assert health_.warnings() == [] and any("a/mean is too sure" in line for line in health_.remarks())
    figures = run_figures(health_)
    assert figures["estimates_0"].axes[0].get_ylabel() == "level (m)"
    page = run_page(health_, "net", dict.fromkeys(figures, b"<svg/>")).html()
    fits(page)
    assert "No doubts." in page and "there to be compared with" in page
    assert "None is missing" in page and "orange" not in page


def test_many_filters_do_not_make_a_doubt_of_chance(health):
    """Twenty tests at a level of 1 % each made a doubt in half of all recordings of twenty nodes that were right."""

    def judged(power: float, p_value: float, count: int) -> list[str]:
        test = MemoryTest(np.full(1, 0.3), np.full(1, 0.1), p_value, 1.0, 0.09, power, 0.1 * power)
        quiet = replace(test, power=1.0, p_value=0.5)
        of = [FilterHealth("a", f"f{i}", "exact", None, quiet if i else test) for i in range(count)]
        return replace(health, filters=of, links=[], outputs=[]).warnings()

    # Normal quantiles of 0.1 % and 0.1 % / 20, both sides: 3.29 and 4.06 relative errors of 0.1.
    for count, errors in ((1, 3.29), (20, 4.06)):
        for sign in (-1, 1):
            assert judged(np.exp(sign * 0.1 * (errors - 0.02)), 0.5, count) == []
            assert len(judged(np.exp(sign * 0.1 * (errors + 0.02)), 0.5, count)) == 1
    assert len(judged(1.0, 0.0004, 1)) == 1 and judged(1.0, 0.0004, 20) == []  # two tests share .001


def test_the_title_is_the_result_and_doubts_follow(health):
    """The last estimate with two claimed deviations; of the doubts the three that matter most."""
    page = run_page(health, "net", dict.fromkeys(run_figures(health), b"<svg/>"))
    estimate = health.record.estimates["a"]["sure"]
    deviation = float(np.sqrt(estimate.covariance[-1, 0, 0]))
    assert page.title == (
        f"level {round_to(estimate.mean[-1, 0], deviation)} ± {round_to(2 * deviation, deviation)} at the end, by sure"
    )
    many = replace(health, links=[replace(health.links[-1], component=f"c{i}") for i in range(9)])
    points = run_page(many, "net", {}).sections[0].blocks[1].points
    assert len(points) == 3 and len(many.warnings()) == 11  # nine links, size and memory of a/sure


def test_a_sender_that_is_slower_than_the_rows_loses_nothing():
    """Each fifth row, on time or nearly: due each half second; of losses at random no interval is a period."""
    rng = np.random.default_rng(0)
    time = np.arange(1000) * 0.1
    there = np.arange(1000) % 5 == 2
    slow = Arrivals("a", "odom", time, there, np.zeros(there.sum()), False)
    assert np.isclose(slow.period, 0.5) and slow.share == 1 and slow.longest_gap == 0
    there[[7, 102, 107]] = False  # three of 200 are lost, two of them in a row
    slow = Arrivals("a", "odom", time, there, np.zeros(there.sum()), False)
    assert np.isclose(slow.period, 0.5) and slow.due == 200 and slow.share == 197 / 200 and slow.longest_gap == 2
    for probability in (0.9, 0.5, 0.25):
        came = rng.random(1000) < probability
        lossy = Arrivals("a", "odom", time, came, np.zeros(came.sum()), True)
        assert lossy.period is None and np.isclose(lossy.share, came.mean())
    dated = Arrivals("a", "odom", np.datetime64("2026-11-28", "ns") + (time * 1e9).astype("timedelta64[ns]"), there,
                     np.zeros(there.sum()), False)  # fmt: skip
    assert np.isclose(dated.period, 0.5) and dated.share == 197 / 200


@pytest.mark.slow
def test_another_share_of_losses_than_stated_is_a_doubt():
    """Of 720 rows 75 % where 85 % is said, with a gap of 30; and no doubt where it is as said, in 200 recordings."""
    rng, time = np.random.default_rng(0), np.arange(720.0)
    there = rng.random(720) < 0.78
    there[300:330] = False
    assert Arrivals("a", "y", time, there, np.zeros(there.sum()), True, stated_share=0.85).contradicts(0.01)
    false = 0
    for _ in range(200):
        there = rng.random(720) < 0.85
        false += Arrivals("a", "y", time, there, np.zeros(there.sum()), True, stated_share=0.85).contradicts(0.01)
    assert false <= 8  # 2 expected; more than 8 with probability 2e-4
    link = hg.erasure(hg.perfect(), 0.85)
    sensor = hg.LinearSensor([[1.0]], 0.1, outputs=["y"])
    plant = hg.LinearPlant([[0.98]], 0.04, [0.0], 1.0, states=["x"])
    network = hg.Network(plant, {"a": hg.Node(sensor, link, {"k": hg.kalman_filter(plant, sensor)})})
    z = np.where(rng.random(720) < 0.6, hg.monte_carlo(network, 720, 1, key=0).measurements["a"][0, :, 0], np.nan)
    (line,) = examine(network, hg.run(network, {"a": z[:, None]}), np.zeros((720, 0))).warnings()
    assert line.startswith("a: y arrived in ") and line.endswith("; the network says that 85.0% do")


def test_several_rates_are_no_doubt():
    """A recording of the network's own world, rows at the stamps of two nodes with rates of their own."""
    plant = hg.LinearPlant([[0.98]], 0.04, [0.0], 1.0, states=["x"])
    sensor = hg.LinearSensor([[1.0]], 0.1, outputs=["y"])
    nodes = {name: hg.Node(sensor, hg.perfect(), {"k": hg.kalman_filter(plant, sensor)}) for name in "ab"}
    network = hg.Network(plant, nodes)
    z = {name: values[0].copy() for name, values in hg.monte_carlo(network, 600, 1, key=0).measurements.items()}
    z["b"][np.arange(600) % 4 != 0] = np.nan
    health = examine(network, hg.run(network, z), np.zeros((600, 0)))
    assert health.warnings() == [] and health.links[1].period == 4.0
    most = z | {"b": np.where(np.arange(600)[:, None] % 4 == 0, np.nan, z["a"])}  # three of each four rows
    regular = examine(network, hg.run(network, most), np.zeros((600, 0)))
    assert not any(line.startswith("b: ") for line in regular.warnings())
    (link,) = run_summary(regular)["links"]["b"].values()
    assert link == {"arrived": 1.0, "longest_gap": 0, "due": "3 of 4 rows"}
    periodic = hg.Network(plant, {"b": hg.Node(sensor, hg.perfect(), nodes["b"].filters, trigger=hg.Periodic(4))})
    z["b"][np.arange(600) % 40 == 0] = np.nan
    link = examine(periodic, hg.run(periodic, {"b": z["b"]}), np.zeros((600, 0))).links[0]
    # The first of 150 did not come, and no period begins before it.
    assert link.period == 4.0 and link.share == 135 / 149 and not link.may_be_lost


def test_numbers_are_rounded_by_their_standard_error():
    """Two digits of the standard error, whatever the size of the number."""
    for value, error, text in [
        (12.34567, 0.0123, "12.346"), (0.5, 0.2, "0.50"), (1234.5, 130.0, "1230"), (3.14159, 0.0, "3.142"),
        (np.nan, 1.0, "nan"), (1.0, np.inf, "1"),
    ]:  # fmt: skip
        assert round_to(value, error) == text


@pytest.mark.slow
def test_probabilities_of_modes_have_a_figure_of_their_own_filtered_and_smoothed():
    laws = [hg.LinearPlant([[1.0, 1.0], [0.0, a]], 0.1, [0.0, 0.0], 1.0, states=["x", "v"]) for a in (0.9, 0.5)]
    plant, sensor = hg.markov_plant(laws, [[0.9, 0.1], [0.2, 0.8]]), hg.LinearSensor([[1.0, 0.0]], 1.0)
    parts = plant, sensor, hg.perfect(1)
    filters = {"imm": hg.filters.imm_filter(*parts), "linear": hg.linear_filter(*parts)}
    network = hg.Network(plant, {"radar": hg.Node(sensor, hg.perfect(1), filters)})
    z = np.random.default_rng(0).normal(size=(30, 1))
    record = hg.run(network, {"radar": z}, smooth=hg.smoothing.FixedInterval())
    figures = run_figures(examine(network, record, np.zeros((30, 0))))
    assert {"modes_estimates_0", "modes_smoothed_0"} <= set(figures)
    lines = figures["modes_estimates_0"].axes[0].get_lines()
    assert len(lines) == 2  # the linear filter weighs none
    np.testing.assert_allclose(sum(line.get_ydata() for line in lines), 1.0, rtol=1e-12)
    page = run_page(examine(network, record, np.zeros((30, 0))), "net", dict.fromkeys(figures, b"<svg></svg>"))
    assert "radar: probability of each mode, given later data too." in page.html()
