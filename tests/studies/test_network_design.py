"""The example's designs beside the numbers that are known of them, and the page that shows them."""

import json

import numpy as np
import pytest

from heliograph_studies import network_design
from heliograph_studies.network_design import compute
from heliograph_studies.network_design.compute import Circuit, packets

pytestmark = pytest.mark.slow

SETTING = network_design.Setting(one_hop=(2.0,), two_hops=(6.0,), front=(0.3, 1.0), periods=(1, 2, 3))


@pytest.fixture(scope="module")
def results(tmp_path_factory, widths):
    """Fewer cases than the example's; what other tests compute (the demonstration) and a long descent stand in."""
    out = tmp_path_factory.mktemp("out")
    powers = {"as_it_is": 5000.0, "centred": 1200.0, "centred_thousandth": 1.2}
    designs = {name: {"rmse": 1.0, "claimed": 1.0, "power": power} for name, power in powers.items()}
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(network_design, "POINTS", 6)
        patch.setattr(compute, "demonstration", lambda *_: designs)
        patch.setattr(compute, "circuit", lambda: Circuit(25.0, 25.0))
        network_design.run(SETTING, out)
    folder = out / "network-design"
    widths(folder / "report.html")
    return json.loads((folder / "summary.json").read_text()), (folder / "report.html").read_text()


def test_one_hop_is_the_convex_optimum(results):
    result = results[0]["one_hop"]["2"]
    assert result["equal"] == pytest.approx(0.91212826, abs=5e-9)
    assert result["best"] == pytest.approx(0.87632288, abs=5e-9)
    assert result["powers"] == pytest.approx([0.42275, 0.60692, 0, 0.44522, 0, 0.52510], abs=1e-5)
    assert result["least_power"] == pytest.approx(1.62, abs=5e-5)
    assert result["gap"] < 1e-9


def test_two_hops_are_between_the_bound_and_the_best_known(results):
    result = results[0]["two_hops"]["6"]
    assert result["equal"] == pytest.approx(1.56566806, abs=5e-9)
    assert result["bound"] <= result["best"] <= 1.36438856
    assert result["bound"] > 1.3333
    assert result["powers"] == pytest.approx([3.4644, 2.5356, 0, 0, 0, 0], abs=1e-3)
    assert sum(result["hop_powers"]) == pytest.approx(6.0, rel=1e-9)
    assert result["least_power_bound"] <= result["least_power"] <= result["least_power_same_paths"] < 3.5971


def test_schedules_and_sites_are_the_known_ones(results):
    schedules, sites = results[0]["schedules"], results[0]["sites"]
    assert [schedules["by_period"][p] for p in "123"] == pytest.approx([1.167, 1.043, 1.006], abs=5e-4)
    assert schedules["bound"] == pytest.approx(0.972, abs=5e-4)
    assert schedules["greedy"] == pytest.approx(1.024, abs=5e-4)
    bursts = schedules["bursts"]
    assert (bursts["every"], bursts["errors"]["1"]) == (8, pytest.approx(0.5235, abs=5e-5))
    assert bursts["bound"] <= bursts["error"] == pytest.approx(0.4026, abs=5e-5)
    for rho, site in ((1.0, 0.5), (4.0, 0.5)):
        assert sites[f"{rho:g}"]["one_relay"]["site"] == pytest.approx(site, abs=1e-3)
    far = sites["20"]["one_relay"]
    assert far["site"] * (1 - far["site"]) == pytest.approx(1 / 20, abs=1e-6)
    assert (far["noise"], far["direct"]) == (pytest.approx(20, rel=1e-6), pytest.approx(21, rel=1e-12))


def test_the_page_says_what_is_saved(results):
    summary, html = results
    assert summary["circuit"] == {"error_saved_percent": 25.0, "power_saved_percent": 25.0}
    assert set(summary["demonstration"]) == {"as_it_is", "centred", "centred_thousandth"}
    for words in (
        "Two relays in turn",
        "not below",
        "Sending less of the signal",
        "1/4167",
        "heliograph example network-design",
    ):
        assert words in html
    assert html.count("<img") == 4


@pytest.mark.parametrize(("times", "silent"), [(1.1, 52), (3.0, 61)])
def test_a_relay_for_packets_saves_half_and_more(times, silent):
    """By plain iteration of the bound on the informed filter's mean error."""
    result = packets(times)
    assert result["silent"] == pytest.approx(silent, abs=0.5)
    a, c = np.array(compute.PLANT.matrix), np.array([[1.0, 1.0]])
    traces = []
    for q in (1.0, result["arrival"]):
        p = np.eye(2)
        for _ in range(3000):
            p = a @ (p - q * p @ c.T @ c @ p / ((c @ p @ c.T).item() + 1)) @ a.T + np.eye(2)
        traces.append(np.trace(p))
    assert traces[1] == pytest.approx(times * traces[0], rel=1e-6)
