"""Error and claim of event filters beside particles and beside the mixture of all losses."""

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from tests.oracles.event_particles import Problem, particle_moments

DT = 0.5
MOVING = {"a": np.array([[1, DT], [0, 1]]), "q": 0.02 * np.array([[DT**3 / 3, DT**2 / 2], [DT**2 / 2, DT]]),
          "p": np.diag([1, 0.05]), "delta": 0.5}  # fmt: skip
RANGING = {"a": np.array([[0.95, 0.2], [0, 0.9]]), "q": np.diag([0.002, 0.02]), "p": np.diag([0.5, 0.1]), "delta": 0.4}
SURE = hg.perfect(), np.ones((1, 1)), np.ones(1), np.zeros(1)
LOSSY = hg.erasure(hg.perfect(), 0.8), np.ones((1, 1)), np.ones(1), np.array([0.2])
BURSTS = (
    hg.gilbert_elliott(hg.erasure(hg.perfect(), 1.0), hg.erasure(hg.perfect(), 0.0), 0.05, 0.2),
    np.array([[0.95, 0.05], [0.2, 0.8]]),
    np.array([0.8, 0.2]),
    np.array([0.0, 1.0]),
)


def distance(x):
    return jnp.sqrt(9 + (4 + x[0]) ** 2)[None]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("numbers", "link", "heartbeat"),
    [(MOVING, SURE, None), (MOVING, LOSSY, None), (MOVING, BURSTS, 10), (RANGING, SURE, None), (RANGING, LOSSY, None)],
    ids=["moving", "moving, lossy", "moving, bursts, heartbeat", "range", "range, lossy"],
)
def test_vectors_and_ranges_agree_with_forty_thousand_particles(numbers, link, heartbeat):
    """Error of x_1 within 3 %, NEES from 0.9 to 1.1; in expectation given the data, so that few runs are enough."""
    moving, runs, (channel, *modes) = numbers is MOVING, 12, link
    plant = hg.LinearPlant(numbers["a"], numbers["q"], [0.0, 0.0], numbers["p"])
    sensor = hg.LinearSensor([[1.0, 0.0]], 0.01) if moving else hg.Sensor(distance, 0.01)
    trigger = hg.SendOnDelta(numbers["delta"], heartbeat=heartbeat)
    filters = {"sum": hg.event_filter(plant, sensor, channel, trigger)}
    network = hg.Network(plant, {"a": hg.Node(sensor, channel, filters, trigger=trigger)})
    record = hg.monte_carlo(network, horizon=50, runs=runs, key=3)

    def measure(x):
        return x[0] if moving else np.sqrt(9 + (4 + x[0]) ** 2)

    problem = Problem(numbers["a"], numbers["q"], measure, 0.01, numbers["p"], numbers["delta"], *modes, heartbeat)
    results = [particle_moments(problem, record.measurements["a"][i, :, 0], 40_000, i) for i in range(runs)]
    mean, covariance = (np.array(part) for part in zip(*results, strict=True))
    estimate = record.estimates["a"]["sum"]
    apart = estimate.mean - mean
    square = covariance + apart[..., None] * apart[..., None, :]
    assert np.sqrt(square[..., 0, 0].mean() / covariance[..., 0, 0].mean()) < 1.03
    nees = np.einsum("rtij,rtji->rt", np.linalg.inv(estimate.covariance), square).mean() / 2
    assert 0.9 < nees < 1.1


A, C, R, Y = np.diag([0.8, 0.95]), np.array([[1.0, 1.0]]), 1.0, 1.0


def mixture_of_losses(z, loss):
    """Means and covariances of the exact mixture of 2^k Gaussians, z (steps,), NaN where nothing came."""
    weight, mean, cov = np.ones(1), np.zeros((1, 2)), np.eye(2)[None]
    means, covariances = [], []
    for value in z:
        mean, cov = mean @ A.T, A @ cov @ A.T + np.eye(2)
        noise = R if not np.isnan(value) else R + 1 / Y
        total = (C @ cov @ C.T)[:, 0, 0] + noise
        gain = (cov @ C.T)[..., 0] / total[:, None]
        error = np.nan_to_num(value) - (mean @ C.T)[:, 0]
        density = np.exp(-(error**2) / (2 * total)) / np.sqrt(total)
        updated = mean + gain * error[:, None], cov - total[:, None, None] * gain[:, :, None] * gain[:, None]
        if np.isnan(value):  # lost, or silent with the probability exp(-y^2 Y / 2)
            weight = np.concatenate([loss * weight, (1 - loss) * weight * density / np.sqrt(Y)])
            mean, cov = (np.concatenate([old, new]) for old, new in zip((mean, cov), updated, strict=True))
        else:
            weight, (mean, cov) = weight * density, updated
        weight = weight / weight.sum()
        means.append(weight @ mean)
        apart = mean - means[-1]
        covariances.append(np.einsum("a,aij->ij", weight, cov + apart[:, :, None] * apart[:, None]))
    return np.array(means), np.array(covariances)


@pytest.mark.parametrize("loss", [0.1, 0.4, 0.8])
def test_one_gaussian_behind_the_stochastic_trigger_is_near_the_mixture_of_all_losses(loss):
    plant = hg.LinearPlant(A, np.eye(2), [0.0, 0.0], np.eye(2))
    sensor, trigger, channel = hg.LinearSensor(C, R), hg.StochasticTrigger(Y), hg.erasure(hg.perfect(), 1 - loss)
    item = hg.event_filter(plant, sensor, channel, trigger)
    assert item.claim == "nominal"
    node = hg.Node(sensor, channel, {"one": item}, trigger=trigger)
    record = hg.monte_carlo(hg.Network(plant, {"a": node}), horizon=10, runs=200, key=4)
    results = [mixture_of_losses(z[:, 0], loss) for z in record.measurements["a"]]
    mean, covariance = (np.array(part) for part in zip(*results, strict=True))
    estimate = record.estimates["a"]["one"]
    apart = estimate.mean - mean
    square = covariance + apart[..., None] * apart[..., None, :]
    error = np.trace(square, axis1=-2, axis2=-1).mean() / np.trace(covariance, axis1=-2, axis2=-1).mean()
    assert np.sqrt(error) < 1.0003  # .006 % in the reference table
    nees = np.einsum("rtij,rtji->rt", np.linalg.inv(estimate.covariance), square).mean() / 2
    assert nees == pytest.approx(1, abs=0.005)
