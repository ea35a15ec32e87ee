"""Smoothing beside the filters: in Monte Carlo, in bounded memory, and of recordings."""

from dataclasses import replace

import numpy as np
import pytest

import heliograph as hg
from heliograph.model.estimate import Estimate

PLANT = hg.LinearPlant([[0.95, 0.2], [-0.2, 0.9]], 0.05, [1.0, -0.5], [[0.5, 0.1], [0.1, 0.4]])
SENSOR = hg.LinearSensor([[1.0, 0.0]], 0.02)
FADING = hg.hop(hg.Discrete([0.5, 1.0, 1.4], [0.2, 0.5, 0.3]), 0.02)
FILTERS = {
    "linear": hg.linear_filter(PLANT, SENSOR, FADING),
    "mixture": hg.filters.mixture_filter(PLANT, SENSOR, FADING),
}
GAPS = hg.Network(
    PLANT,
    {f"node {arrival}": hg.Node(SENSOR, hg.erasure(FADING, arrival), FILTERS) for arrival in (0.6, 0.9)},
    {"both": hg.Fusion("linear", hg.CovarianceIntersection())},
)
WHOLE = hg.Network(PLANT, {"node": hg.Node(SENSOR, FADING, {"linear": FILTERS["linear"]})})
HORIZON, RUNS, LAG = 12, 40, 2
CLAIMS = {"linear": "exact", "mixture": "nominal", "both": "upper"}


@pytest.fixture(scope="module")
def record():
    return hg.monte_carlo(GAPS, HORIZON, RUNS, 3, smooth=hg.smoothing.FixedLag(LAG))


@pytest.mark.slow
def test_a_network_is_smoothed_as_each_of_its_filters_alone(record):
    result = record.smoothed
    assert result.failures() == [] and np.array_equal(result.truth, record.truth)
    for node in GAPS.names:
        for name, item in FILTERS.items():
            known = result.estimates[node][name]
            assert known.claim == CLAIMS[name]
            for run in (0, RUNS - 1):
                _, steps = hg.smoothing.smoother_steps(item, record.measurements[node][run])
                alone = hg.smoothing.FixedLag(LAG).estimates(steps)
                np.testing.assert_allclose(known.mean[run], alone.mean, rtol=0, atol=1e-14)  # rounding of another order
                np.testing.assert_allclose(known.covariance[run], alone.covariance, rtol=0, atol=1e-14)


def test_fusion_intersects_smoothed_estimates_of_the_same_time(record):
    result = record.smoothed.estimates
    parts = [result[node]["linear"] for node in GAPS.names]
    fused = hg.fusion.fuse(hg.CovarianceIntersection(), parts)
    assert result["fused"]["both"].claim == fused.claim == "upper"
    np.testing.assert_allclose(result["fused"]["both"].mean, fused.mean, rtol=0, atol=1e-12)
    assert np.all(np.trace(fused.covariance, axis1=2, axis2=3)[:, :-1] < 0.5)  # of about 1 without measurements


def test_saving_says_what_has_to_be_saved_apart(record, tmp_path):
    with pytest.warns(UserWarning, match="without `smoothed`, which is saved apart"):
        record.save(tmp_path / "all.nc")
    record.smoothed.save(tmp_path / "smoothed.nc")  # no warning, which would be an error here
    assert hg.Record.open(tmp_path / "smoothed.nc") == record.smoothed


def test_statistics_of_the_record_and_its_smoothed_part(record):
    for node in GAPS.names:
        for name in FILTERS:
            both = [hg.simulation.error_statistics(part, node, name) for part in (record, record.smoothed)]
            assert both[1].rmse()[0] < 0.97 * both[0].rmse()[0]


def test_in_bounded_memory_with_gains_known_before_data():
    smooth = hg.smoothing.FixedInterval()
    statistics = hg.monte_carlo(WHOLE, HORIZON, 4 * RUNS, 3, keep=hg.Statistics(), smooth=smooth)
    result = statistics.smoothed["node"]["linear"]
    _, steps = hg.smoothing.smoother_steps(FILTERS["linear"], np.zeros((HORIZON, 1)))
    claimed = smooth.estimates(steps).covariance  # no data change it
    np.testing.assert_allclose(result.claimed(), claimed, rtol=0, atol=1e-13)
    _, low, high = result.nees_per_dimension(0.9999)
    assert result.claim == "exact" and low < 1 < high
    assert result.rmse()[0] < 0.97 * statistics["node"]["linear"].rmse()[0]


def test_a_smoothed_estimate_that_is_no_number_is_a_failure_of_its_record(record):
    estimate = record.smoothed.estimates["node 0.6"]["linear"]
    covariance = np.array(estimate.covariance)
    covariance[..., 3, :, :] = np.nan
    broken = Estimate(estimate.mean, covariance, estimate.claim)
    smoothed = replace(record.smoothed, estimates={"node 0.6": {"linear": broken}})
    runs = record.runs
    expected = [f"smoothed node 0.6/linear: no valid covariance from step 3 in {runs} of {runs} runs"]
    assert record.failures() == []
    assert replace(record, smoothed=smoothed).failures() == expected


def test_a_recording_is_smoothed_from_a_fixed_point_on():
    z = np.sin(np.arange(HORIZON))
    result = hg.run(WHOLE, {"node": z}, time=np.arange(HORIZON) / 10, smooth=hg.smoothing.FixedPoint(4)).smoothed
    assert np.array_equal(result.time, np.arange(4, HORIZON) / 10)
    assert np.array_equal(result.measurements["node"][:, 0], z[4:])
    _, steps = hg.smoothing.smoother_steps(FILTERS["linear"], z[:, None])
    alone = hg.smoothing.FixedPoint(4).estimates(steps)
    np.testing.assert_allclose(result.estimates["node"]["linear"].mean, alone.mean, rtol=0, atol=1e-13)


def test_what_cannot_be_smoothed_is_refused_in_one_line():
    particle = hg.filters.particle_filter(PLANT, SENSOR, FADING, particles=10)
    network = hg.Network(PLANT, {"node": hg.Node(SENSOR, FADING, {"one": particle})})
    with pytest.raises(ValueError, match=r"smoothing: expected .* got StateParticleFilter"):
        hg.monte_carlo(network, 4, 2, 0, smooth=hg.smoothing.FixedInterval())
    with pytest.raises(ValueError, match=r"smooth: expected one such as .*, got 'interval'"):
        hg.monte_carlo(WHOLE, 4, 2, 0, smooth="interval")
    nothing = hg.Network(PLANT, {"node": hg.Node(SENSOR, FADING, {})})
    with pytest.raises(ValueError, match="smoothing: expected a filter at a node or the centre, got a network without"):
        hg.monte_carlo(nothing, 4, 2, 0, smooth=hg.smoothing.FixedInterval())
    with pytest.raises(ValueError, match="step of a fixed point: expected one of the run's 4"):
        hg.monte_carlo(WHOLE, 4, 2, 0, smooth=hg.smoothing.FixedPoint(4))
