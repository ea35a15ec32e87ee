"""Hundreds of networks side by side that are free of noise, or all but so: no claim is broken, and none is no number.

Plants and sensors with noises of any rank, priors over thirty-two decades, means up to 1e8, units of their own. A mean
squared error of eight runs may be a thousand times the claim's mean, which chance and rounding do not exceed in these
networks, or is within ten roundings of the state.
"""

from copy import deepcopy
from functools import cache

import numpy as np
import pytest

import heliograph as hg
from heliograph import filters
from tests.filters.test_noise_free import EPS, GAIN, chain, of_rank
from tests.follow import follow_each

STEPS, RUNS, NETWORKS = 15, 8, 400


def small(random, size):
    """A covariance of independent noises over twenty decades."""
    return np.diag(10.0 ** random.uniform(-24, -4, size=size))


def parts(random, n, m, nearly):
    a = random.normal(size=(n, n))
    a *= random.uniform(0.2, 1.25) / max(abs(np.linalg.eigvals(a)).max(), 1e-9)
    q = of_rank(random, n, random.integers(0, n)) if random.random() < 0.5 else np.zeros((n, n))
    r = of_rank(random, m, random.integers(0, m)) if random.random() < 0.4 else np.zeros((m, m))
    if nearly:
        q = q * 10.0 ** random.uniform(-20, 0) + small(random, n)
        r = r * 10.0 ** random.uniform(-20, 0) + small(random, m)
    mean = random.normal(size=n) * random.choice([0.0, 1.0, 1850.0, 1e8])
    start = of_rank(random, n, random.integers(1, n + 1)) * 10.0 ** random.choice([0, 0, -8, 8, -16])
    unit = 10.0 ** random.uniform(-3, 3, size=n) if random.random() < 0.3 else np.ones(n)
    both = np.outer(unit, unit)
    plant = hg.LinearPlant(unit[:, None] * a / unit, both * q, unit * mean, both * start)
    return plant, hg.LinearSensor(random.normal(size=(m, n)) / unit, r)


def drawn(random, noise):
    """Values of a noise for all runs."""
    return random.normal(size=(RUNS, len(noise.factor))) @ noise.factor.T


def simulated(random, plant, sensor):
    """States and outputs (runs, steps, ...), with noises exactly as singular as the library takes them to be."""
    x, states, outputs = plant.initial_mean + drawn(random, hg.Gaussian(plant.initial_covariance)), [], []
    for _ in range(STEPS):
        x = x @ plant.matrix.T + drawn(random, plant.noise)
        states.append(x)
        outputs.append(x @ sensor.matrix.T + drawn(random, sensor.noise))
    return np.stack(states, axis=1), np.stack(outputs, axis=1)


@cache
def networks(shape, nearly):
    """Plants, sensors, states, outputs, and a generator for what becomes of these: drawn once for all kinds."""
    n, m = shape
    generators = [np.random.default_rng([seed, n, m]) for seed in range(NETWORKS)]
    models = [parts(random, n, m, nearly) for random in generators]
    return [(*model, *simulated(random, *model), random) for model, random in zip(models, generators, strict=True)]


def dropped(y, random, chance, instead):
    return np.where((random.random(y.shape[:2]) < chance)[..., None], y, instead)


def faded(y, random):
    return random.choice([0.5, 1.0], size=y.shape[:2])[..., None] * y


def in_good_mode(random):
    """Whether the chain of `chain` is in its good mode (runs, steps), from its steady law."""
    good = random.random(RUNS) < 0.6
    result = [good]
    for _ in range(STEPS - 1):
        good = random.random(RUNS) < np.where(good, 0.8, 0.3)
        result.append(good)
    return np.stack(result, axis=1)[..., None]


def erasing(m):
    return chain(m, hg.perfect(m), hg.erasure(hg.perfect(m), 0.3))


def linear(channel):
    channel = cache(channel)  # one of each dimension, which has its moments computed once
    return lambda plant, sensor, m: hg.linear_filter(plant, sensor, channel(m))


def informed(channel):
    channel = cache(channel)
    return lambda plant, sensor, m: filters.side_information_filter(plant, sensor, channel(m))


def relay(m):
    return hg.amplify_and_forward([hg.hop(0.7, 0.0, dimension=m), hg.hop(GAIN, 0.0, dimension=m)])


KINDS = {  # by name, the filter of a plant, a sensor and its outputs, and what it receives of these
    "perfect": (linear(hg.perfect), lambda y, _: y),
    "dropout": (linear(lambda m: hg.dropout(hg.perfect(m), 0.6)), lambda y, r: dropped(y, r, 0.6, 0.0)),
    "hop": (linear(lambda m: hg.hop(GAIN, 0.0, dimension=m)), faded),
    "relay": (linear(relay), lambda y, r: 0.7 * faded(y, r)),
    "chain": (linear(chain), lambda y, r: np.where(in_good_mode(r), 1.0, 0.3) * y),
    "erasure": (informed(lambda m: hg.erasure(hg.perfect(m), 0.6)), lambda y, r: dropped(y, r, 0.6, np.nan)),
    "erasing chain": (informed(erasing), lambda y, r: np.where(in_good_mode(r), y, dropped(y, r, 0.3, np.nan))),
}


@pytest.mark.slow
@pytest.mark.parametrize("nearly", [False, True], ids=["free", "nearly"])
@pytest.mark.parametrize("shape", [(1, 2), (3, 2), (2, 3)], ids=str)
@pytest.mark.parametrize("kind", KINDS)
def test_no_claim_is_broken(kind, shape, nearly):
    build, received = KINDS[kind]
    items, data, truth, start = [], [], [], []
    for plant, sensor, states, outputs, random in networks(shape, nearly):
        items += [build(plant, sensor, shape[1])] * RUNS
        data += [*received(outputs, deepcopy(random))]
        truth.append(states)
        start.append(np.abs(plant.initial_mean))
    steps, truth = follow_each(items, np.stack(data)), np.stack(truth)
    squared = np.mean((steps.mean.reshape(truth.shape) - truth) ** 2, axis=1)
    variance = np.diagonal(steps.covariance, axis1=-2, axis2=-1).reshape(truth.shape)
    size = np.maximum(np.abs(truth).max(axis=(1, 2)), np.stack(start))[:, None]
    assert np.all(variance >= 0), np.flatnonzero(~np.all(variance >= 0, axis=(1, 2, 3)))
    holds = (squared <= 1e3 * variance.mean(axis=1)) | (squared <= (10 * EPS * size) ** 2)
    assert np.all(holds), np.flatnonzero(~holds.all(axis=(1, 2)))
