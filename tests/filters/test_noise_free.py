"""Networks that are free of noise, wholly or in part: whatever a filter or smoother claims covers what rounding leaves.

Random plants, sensors and priors of any rank, states in units of their own and far from zero; hundreds of such networks
were searched for errors beyond the claim, which rounding made. A squared error may be a thousand times the claim's mean
over the runs only where it is within ten roundings of the state.
"""

import warnings

import numpy as np
import pytest

import heliograph as hg
from heliograph import filters

HORIZON, RUNS, SEEDS = 15, 8, 3
EPS = np.finfo(float).eps
GAIN = hg.Discrete([0.5, 1.0], [0.5, 0.5])


def of_rank(random, n, rank):
    root = random.normal(size=(n, rank))
    return root @ root.T


def parts(random, n, m):
    """Plant and sensor: noises that are zero or of less than full rank."""
    a = random.normal(size=(n, n))
    a *= random.uniform(0.2, 1.25) / max(abs(np.linalg.eigvals(a)).max(), 1e-9)
    q = of_rank(random, n, random.integers(0, n)) if random.random() < 0.5 else np.zeros((n, n))
    r = of_rank(random, m, random.integers(0, m)) if random.random() < 0.4 else np.zeros((m, m))
    mean, start = (
        random.normal(size=n) * random.choice([0.0, 1.0, 1850.0]),
        of_rank(random, n, random.integers(1, n + 1)),
    )
    unit = 10.0 ** random.uniform(-3, 3, size=n) if random.random() < 0.3 else np.ones(n)
    both = np.outer(unit, unit)
    plant = hg.LinearPlant(unit[:, None] * a / unit, both * q, unit * mean, both * start)
    return plant, hg.LinearSensor(random.normal(size=(m, n)) / unit, r)


def gaussian(plant, sensor, channel):
    return {
        "linear": hg.linear_filter(plant, sensor, channel),
        "cubature": hg.cubature_filter(plant, sensor, channel),
        "unscented": hg.unscented_filter(plant, sensor, channel),
        "zero mean": hg.cubature_filter(plant, sensor, channel, filters.ZeroMean()),
    }


def chain(m, good=None, bad=None):
    good, bad = good or hg.hop(1.0, 0.0, dimension=m), bad or hg.hop(0.3, 0.0, dimension=m)
    return hg.gilbert_elliott(good, bad, 0.2, 0.3)


def filters_of(kind, plant, sensor):
    """What is received, and the filters of it."""
    m = len(sensor.outputs)
    perfect = hg.perfect(m)
    match kind:
        case "perfect":
            return perfect, {"kalman": hg.kalman_filter(plant, sensor), **gaussian(plant, sensor, perfect)}
        case "erasure":
            return hg.erasure(perfect, 0.6), gaussian(plant, sensor, perfect)
        case "dropout":
            channel = hg.dropout(perfect, 0.6)
            return channel, gaussian(plant, sensor, channel)
        case "hop":
            channel = hg.hop(GAIN, 0.0, dimension=m)
            return channel, gaussian(plant, sensor, channel)
        case "relay":
            channel = hg.amplify_and_forward([hg.hop(0.7, 0.0, dimension=m), hg.hop(GAIN, 0.0, dimension=m)])
            return channel, gaussian(plant, sensor, channel)
        case "chain":
            return chain(m), {"linear": hg.linear_filter(plant, sensor, chain(m))}
        case "side information":
            channel = chain(m, perfect, hg.erasure(perfect, 0.3))
            return channel, {"informed": filters.side_information_filter(plant, sensor, channel)}
        case "mode known":
            channel = chain(m, bad=hg.dropout(hg.hop(0.3, 0.0, dimension=m), 0.5))
            return hg.model.with_flag(channel), {"known": filters.mode_known_filter(plant, sensor, channel)}
        case "mode late":
            late = hg.model.with_flag(chain(m), late=True)
            return late, {"late": filters.mode_late_filter(plant, sensor, chain(m))}
        case "polynomial":
            return perfect, {"polynomial": hg.polynomial_filter(plant, sensor, perfect, HORIZON, 1)}
    channel = hg.dropout(perfect, 0.6)
    return channel, {"mixture": filters.mixture_filter(plant, sensor, channel)}


def beyond(record, size):
    """Estimates that are no numbers, or whose squared error is far beyond the claim and rounding."""
    for name, estimate in record.estimates["a"].items():
        squared = np.mean((estimate.mean - record.truth) ** 2, axis=0)
        claimed = np.diagonal(estimate.covariance, axis1=-2, axis2=-1).mean(axis=0)
        assert np.all(claimed >= 0), name
        assert np.all((squared <= 1e3 * claimed) | (squared <= (10 * EPS * size) ** 2)), name


KINDS = [
    ("perfect", (1, 2)), ("erasure", (2, 2)), ("dropout", (2, 2)), ("hop", (2, 2)), ("relay", (2, 2)),
    ("chain", (2, 2)), ("side information", (1, 2)), ("mode known", (2, 2)), ("mode late", (2, 2)),
    ("polynomial", (2, 1)), ("mixture", (2, 1)),
]  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(("kind", "shape"), KINDS, ids=[kind for kind, _ in KINDS])
def test_no_claim_is_below_what_rounding_leaves(kind, shape):
    for seed in range(SEEDS):
        plant, sensor = parts(np.random.default_rng([seed, *shape]), *shape)
        smooth = hg.smoothing.FixedInterval() if kind in ("perfect", "erasure", "dropout", "hop", "chain") else None
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # of innovations that rounding makes, and of claims lowered by it
            channel, items = filters_of(kind, plant, sensor)
            network = hg.Network(plant, {"a": hg.Node(sensor, channel, items)})
            record = hg.monte_carlo(network, HORIZON, RUNS, seed, smooth=smooth)
        size = np.abs(record.truth).max(axis=(0, 1))
        beyond(record, size)
        if smooth is not None:
            beyond(record.smoothed, size)
