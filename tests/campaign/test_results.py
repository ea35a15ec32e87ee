import numpy as np
import pytest

import heliograph as hg
from heliograph.campaign.jobs import ErrorReducer
from heliograph.campaign.run import run_campaign
from heliograph.campaign.summary import _make_score, open_results, read_summary
from tests.campaign.example import CAMPAIGN, CHUNKS, NETWORK, chunk_files, contents, write


@pytest.mark.slow
def test_the_store_is_labelled(finished):
    results = open_results(finished)
    assert dict(results.sizes) == {"setting": 6, "run": 100, "time": 4, "node": 1, "filter": 1, "state": 1}
    assert results.error.dims == ("setting", "run", "time", "node", "filter", "state")
    assert results.error.chunksizes["run"] == (64, 36)
    np.testing.assert_array_equal(results.gain, [0.5, 0.5, 0.7, 0.7, 0.9, 0.9])
    np.testing.assert_array_equal(results.time, [1, 2, 3, 4])
    assert {"gain", "noise"} <= set(results.coords)
    assert [*results.node.values, *results["filter"].values, *results.state.values] == ["near", "trusting", "x"]
    assert set(np.unique(results.claim.values)) == {"nominal"}
    assert results.attrs["campaign"] == CAMPAIGN and results.attrs["network_source"] == NETWORK
    chosen = results.error.where(results.gain == 0.9, drop=True)
    assert chosen.sizes["setting"] == 2 and np.all(np.isfinite(chosen))


def test_the_numbers_are_those_of_monte_carlo(tmp_path, finished):
    campaign, results = write(tmp_path), open_results(finished)
    for setting in (0, 5):
        network = campaign.function()(**campaign.settings[setting])
        record = hg.monte_carlo(network, 4, 100, campaign.key(setting))
        stored = results.sel(setting=setting, node="near", filter="trusting")
        estimate = record.estimates["near"]["trusting"]
        # Two compilations of the same arithmetic: rounding only.
        np.testing.assert_allclose(stored.error, record.errors("near", "trusting"), rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(stored.variance[..., 0], estimate.covariance[..., 0, 0], rtol=1e-12)
        nees = stored.error[..., 0] ** 2 / stored.variance[..., 0]
        np.testing.assert_allclose(stored.nees_per_dimension, nees, rtol=1e-12)


def test_the_table_agrees_with_the_statistics_of_monte_carlo(tmp_path, finished):
    campaign, scores = write(tmp_path), read_summary(finished / "summary.csv")
    assert [score.setting for score in scores] == list(range(6))
    network = campaign.function()(**campaign.settings[3])
    result = hg.monte_carlo(network, 4, 100, campaign.key(3), hg.Statistics())["near"]["trusting"]
    assert scores[3].rmse == pytest.approx(result.rmse()[0], rel=1e-12)
    assert scores[3].nees_per_dimension == pytest.approx(result.nees_per_dimension()[0], rel=1e-12)
    # One from the scatter of 100 runs, the other of 50 batches of 2: both estimate the same, each to some 10 %.
    assert scores[3].rmse_error == pytest.approx(result.rmse()[1], rel=0.4)
    assert (scores[3].runs, scores[3].finite_runs, scores[3].claim) == (100, 100, "nominal")


def test_a_part_of_the_runs_is_the_same_part_of_all(tmp_path):
    campaign = write(tmp_path)
    network = campaign.function()(gain=0.5)
    part = hg.monte_carlo(network, 4, 36, 1, first_run=64, chunk=64)
    everything = hg.monte_carlo(network, 4, 100, 1, chunk=64)
    assert np.array_equal(part.truth, everything.truth[64:])
    assert np.array_equal(part.estimates["near"]["trusting"].mean, everything.estimates["near"]["trusting"].mean[64:])
    with pytest.raises(ValueError, match="first_run: expected a multiple of 32, got 63"):
        hg.monte_carlo(network, 4, 36, 1, first_run=63)


@pytest.mark.slow
def test_different_nodes_and_filters_and_the_world(tmp_path):
    text = CAMPAIGN.partition("[grid]")[0].replace("seed = 5", 'keep = "trajectories"')
    campaign = write(
        tmp_path, text + '[[settings]]\ngain = 0.5\n[[settings]]\ngain = 0.5\nkind = "two"\nnoise = [[0.2]]\n'
    )
    assert run_campaign(campaign, tmp_path / "out", workers=0).failures == []
    results = open_results(tmp_path / "out").load()
    assert list(results.node.values) == ["near", "far"] and list(results["filter"].values) == ["trusting", "other"]
    assert results.claim.values.tolist() == [[["nominal", ""], ["", ""]], [["nominal", ""], ["", "none"]]]
    there = np.isfinite(results.error).all(("run", "time", "state"))
    np.testing.assert_array_equal(there, results.claim != "")
    assert list(results.kind.values) == ["", "two"] and list(results.noise.values) == ["", "[[0.2]]"]
    np.testing.assert_array_equal(np.isfinite(results.measurement).all(("run", "time", "received")), [[1, 0], [1, 1]])
    network = campaign.function()(**campaign.settings[1])
    recorded = hg.monte_carlo(network, 4, 64, campaign.key(1), ErrorReducer(world=True))
    assert np.array_equal(results.truth[1, :64], recorded["truth"])  # the very same program
    assert np.array_equal(results.measurement[1, :64, :, 1], recorded["measurements"]["far"])
    assert np.array_equal(results.error[1, :64, :, 1, 1], recorded["estimates"]["far"]["other"]["error"])
    scores = read_summary(tmp_path / "out" / "summary.csv")
    assert [(s.setting, s.node, s.filter, s.claim) for s in scores] == [
        (0, "near", "trusting", "nominal"),
        (1, "near", "trusting", "nominal"),
        (1, "far", "other", "none"),
    ]
    assert scores[2].finite_runs == 100 and np.isnan(scores[2].nees_per_dimension)
    # The bare filter's estimate is 0 always, so its error is the state.
    assert scores[2].rmse == pytest.approx(np.sqrt((results.truth[1] ** 2).mean().item()), rel=1e-12)


def test_runs_that_are_not_finite_do_not_count():
    squared = np.array([1.0, np.nan, 4.0, np.inf])
    score = _make_score(0, "n", "f", "nominal", squared, np.array([1.0, np.nan, 3.0, 2.0]))
    assert (score.runs, score.finite_runs) == (4, 2)
    assert score.rmse == pytest.approx(np.sqrt(2.5)) and score.nees_per_dimension == 2.0
    # The mean of 1 and 4 has the standard error 1.5; that of its root is 1.5 / (2 sqrt(2.5)).
    assert score.rmse_error == pytest.approx(0.75 / np.sqrt(2.5)) and score.nees_error == 1.0
    nothing = _make_score(0, "n", "f", "nominal", squared[1:2], squared[1:2])
    assert nothing.finite_runs == 0 and np.isnan([nothing.rmse, nothing.rmse_error, nothing.nees_per_dimension]).all()


def test_a_finished_campaign_is_left_alone(tmp_path, finished, expected):
    times = {path: path.stat().st_mtime_ns for path in finished.rglob("*")}
    result = run_campaign(write(tmp_path), finished, workers=0)
    assert (result.already, result.computed) == (CHUNKS, 0)
    assert {path: path.stat().st_mtime_ns for path in finished.rglob("*")} == times


CHANGES = {
    "runs": ("runs = 100", "runs = 101", "runs 101 (was 100)"),
    "seed": ("seed = 5", "seed = 6", "seed 6 (was 5)"),
    "grid": ("0.9]", "0.9, 1.0]", "8 settings (was 6)"),
    "value": ("0.9]", "1.9]", "setting 4 {'gain': 1.9, 'noise': 0.1} (was {'gain': 0.9, 'noise': 0.1})"),
    "keep": ("seed = 5", 'seed = 5\nkeep = "trajectories"', "keep 'trajectories' (was 'errors')"),
}


@pytest.mark.parametrize("case", CHANGES)
def test_another_campaign_is_refused(tmp_path, finished, expected, case):
    old, new, said = CHANGES[case]
    with pytest.raises(ValueError, match="expected the campaign it was begun with, or another folder, got ") as caught:
        run_campaign(write(tmp_path, CAMPAIGN.replace(old, new)), finished, workers=0)
    assert str(caught.value).endswith(", got " + said)
    assert contents(finished) == expected


def test_another_network_or_version_is_refused_and_a_comment_is_not(tmp_path, finished):
    with pytest.raises(ValueError, match=r"got another source of net.py$"):
        run_campaign(write(tmp_path, network=NETWORK + "# changed\n"), finished, workers=0)
    campaign = write(tmp_path)
    campaign.versions["jax"] = "0.0"
    with pytest.raises(ValueError, match=r"got jax 0.0 \(was "):
        run_campaign(campaign, finished, workers=0)
    assert run_campaign(write(tmp_path, "# a comment\n" + CAMPAIGN), finished, workers=0).computed == 0


def test_foreign_folders_are_left_alone(tmp_path):
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "mine.txt").touch()
    with pytest.raises(ValueError, match="a new or empty folder"):
        run_campaign(write(tmp_path), tmp_path / "out", workers=0)
    with pytest.raises(ValueError, match=r"a folder with results.zarr, got none"):
        open_results(tmp_path / "out")
    with pytest.raises(ValueError, match="workers: expected a whole number of at least 0, got -1"):
        run_campaign(write(tmp_path), tmp_path / "new", workers=-1)
    assert not (tmp_path / "new").exists() and not chunk_files(tmp_path / "out")
