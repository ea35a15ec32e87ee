from dataclasses import replace

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.simulation.results.statistics import ErrorStatistics

BATCHES = 50  # of runs, whose spread gives standard errors


def statistics(errors, bound, claim="exact"):
    """ErrorStatistics of errors (run, time, n) with one claimed covariance."""
    deal = (np.arange(len(errors))[:, None] % BATCHES == np.arange(BATCHES)).astype(float)
    i, j = np.triu_indices(errors.shape[-1])
    nees = np.einsum("rti,ij,rtj->rt", errors, np.linalg.inv(bound), errors)
    return ErrorStatistics(
        deal.sum(axis=0),
        np.einsum("rb,rti->bti", deal, errors[..., i] * errors[..., j]),
        np.broadcast_to(bound[i, j], (BATCHES, errors.shape[1], len(i))),
        deal.T @ nees,
        claim,
    )


BOUND = np.array([[2.0, 0.5], [0.5, 1.0]])


def draws(covariance, runs=5000, steps=4, seed=0):
    rng = np.random.default_rng(seed)
    return rng.multivariate_normal([0, 0], covariance, (runs, steps))


def test_rmse_and_its_error():
    s = statistics(draws(BOUND), BOUND)
    rmse, error = s.rmse()
    assert abs(rmse - np.sqrt(3.0)) < 4 * error
    # Var|e|^2 = 2 tr(P^2) = 11 over 20,000 independent steps; 50 batches know a standard error to 10 %.
    assert error == pytest.approx(np.sqrt(11 / 20_000) / (2 * np.sqrt(3)), rel=0.4)


def test_rmse_error_counts_correlation_over_time():
    """Twenty identical steps carry as much information as one."""
    once = draws(BOUND, steps=1)
    repeated = np.repeat(once, 20, axis=1)
    assert statistics(repeated, BOUND).rmse()[1] == pytest.approx(statistics(once, BOUND).rmse()[1], rel=1e-12)


def test_nees_interval_covers_one_at_its_confidence():
    """95 % intervals of 200 repetitions: 190 +- 3.1 cover; outside 176..200 has probability below 1e-4."""
    covered = 0
    for seed in range(200):
        mean, low, high = statistics(draws(BOUND, runs=200, steps=2, seed=seed), BOUND).nees_per_dimension()
        assert low <= mean <= high
        covered += low <= 1 <= high
    assert 176 <= covered <= 200


def test_the_worst_direction_is_found_and_not_biased_by_the_search():
    actual = BOUND + 0.5 * np.outer([1, -1], [1, -1])
    s = statistics(draws(actual), BOUND, "upper")
    w = s.worst_direction()
    exact = np.max(np.linalg.eigvals(np.linalg.solve(BOUND, actual)).real)
    assert abs(w.ratio - exact) < 4 * w.standard_error
    assert w.z > 10
    fair = [statistics(draws(BOUND, seed=seed), BOUND).worst_direction() for seed in range(20)]
    # Under a true claim each z is about standard normal (the larger of two halves): their mean stays near .6.
    assert abs(np.mean([w.z for w in fair])) < 1.3 and max(w.z for w in fair) < 4


def test_worst_direction_needs_runs():
    with pytest.raises(ValueError, match="at least 4 runs"):
        statistics(draws(BOUND, runs=2), BOUND).worst_direction()


class Breaking(hg.filters.AbstractFilter):
    """Its covariance is no number where z > 2, from then on."""

    claim: str = "exact"
    states: tuple[str, ...] = ("x",)
    inputs: tuple[str, ...] = ()
    received: int = 1

    @hg.filters.in_float64
    def init(self):
        return jnp.ones((1, 1))

    @hg.filters.predicts
    def predict(self, state, u=(), k=0):
        return state

    @hg.filters.corrects
    def correct(self, state, z, k=0):
        return jnp.where(z > 2, jnp.nan, state), hg.filters.gaussian_innovation(z, jnp.zeros(1), jnp.eye(1))

    @hg.filters.in_float64
    def estimate(self, state):
        return hg.model.Estimate(jnp.zeros(1), state, self.claim)


def test_runs_that_fail_are_counted_and_no_figure_hides_them():
    plant, sensor = hg.LinearPlant([[0.5]], 1.0, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.1)
    network = hg.Network(
        plant, {"node": hg.Node(sensor, hg.perfect(), {"b": Breaking(), "open": hg.filters.open_loop_filter(plant)})}
    )
    with pytest.warns(UserWarning, match="node/b: no valid covariance from step 0 in"):
        record = hg.monte_carlo(network, 6, 100, 0)
    outcome = hg.monte_carlo(network, 6, 100, 0, keep=hg.Statistics())
    above = (record.measurements["node"][..., 0] > 2).any(axis=1).sum()
    assert 0 < above < 100
    assert (
        outcome.failures() == record.failures() == [f"node/b: no valid covariance from step 0 in {above} of 100 runs"]
    )
    for item in (outcome["node"]["b"], hg.simulation.error_statistics(record, "node", "b")):
        assert item.failed_runs == above
        for figure in (item.rmse, item.nees_per_dimension, item.worst_direction, item.mean_trace, item.rmse_over_time):
            with pytest.warns(UserWarning, match=f"no valid covariance from step 0 in {above} of 100 runs"):
                figure()
    assert not outcome["node"]["open"].failure and np.isfinite(outcome["node"]["open"].rmse()[0])


def test_a_record_in_single_precision_is_summed_in_double():
    """Its numbers are rounded to 6e-8 of their size, its sums no further: squares of 40 runs to 1e-6."""
    plant, sensor = hg.LinearPlant([[0.9]], [[0.1]], [0.0], [[1.0]]), hg.LinearSensor([[1.0]], 0.1)
    node = hg.Node(sensor, hg.perfect(), {"f": hg.kalman_filter(plant, sensor)})
    record = hg.monte_carlo(hg.Network(plant, {"a": node}), 6, 40, 0)
    result = record.estimates["a"]["f"]
    single = replace(result, mean=np.float32(result.mean), covariance=np.float32(result.covariance))
    rounded = replace(record, truth=np.float32(record.truth), estimates={"a": {"f": single}})
    both = [hg.simulation.error_statistics(item, "a", "f") for item in (rounded, record)]
    assert both[0].pairs.dtype == np.float64
    assert both[0].rmse() == pytest.approx(both[1].rmse(), rel=1e-6)
    assert both[0].nees_per_dimension() == pytest.approx(both[1].nees_per_dimension(), rel=1e-6)
