"""Laws that hold for every network: tried on dozens of random ones at once."""

from functools import cache

import numpy as np
import pytest

import heliograph as hg
from tests.as_code import as_code
from tests.follow import follow, follow_each

ROUNDING = 1e-9  # relative to the largest entry, over four steps of small matrices
STEPS = 4
COUNT = 24  # networks of one size; filters of one size are one program, whatever chain of hops is in front of them
SIZES = [(1, 2), (2, 1), (3, 2)]  # states and outputs


@cache
def networks(n, m, seed=0):
    """Random plants, sensors, lists of scalar channels, one per output, known or uncertain, and received signals."""
    rng = np.random.default_rng([seed, n, m])
    return [network(rng, n, m, 0.05 * (i % 2)) for i in range(COUNT)]


def network(rng, n, m, radius):
    a = rng.normal(size=(n, n))
    plant = hg.LinearPlant(a / max(1, np.abs(np.linalg.eigvals(a)).max()), 0.1, rng.normal(size=n), np.eye(n))
    sensor = hg.LinearSensor(rng.normal(size=(m, n)), 0.1)
    laws = [
        hg.Discrete(rng.uniform(-0.5, 1.5, 3), [0.2, 0.3, 0.5], radius),
        hg.Rayleigh(0.8),
        hg.random_affine.bernoulli(0.7),
    ]
    chains = [[(laws[rng.integers(3)], rng.uniform(0.01, 0.3)) for _ in range(rng.integers(1, 4))] for _ in range(m)]
    return plant, sensor, chains, rng.normal(size=(STEPS, m))


def channel(chains, scale=1.0, off=None):
    """The chains in parallel; every signal and noise deviation times `scale`; component `off` silent."""
    parts = []
    for i, chain in enumerate(chains):
        hops = [
            hg.hop(law, noise * scale**2, amplification=scale if k == 0 else 1.0)
            for k, (law, noise) in enumerate(chain)
        ]
        parts.append(hg.model.silent(1, 1, 2.0) if i == off else hg.amplify_and_forward(hops))
    return hg.parallel(parts)


def uncertain(chains):
    return any(np.any(getattr(law, "radius", 0)) for chain in chains for law, _ in chain)


def certain(chains):
    """The same chains without their uncertain laws."""
    return [[(hg.Rayleigh(0.5) if uncertain([[hop]]) else hop[0], hop[1]) for hop in chain] for chain in chains]


@cache
def followed(build, n, m):
    """What filters of one kind say of the networks of one size."""
    cases = networks(n, m)
    return follow_each([build(plant, sensor, channel(chains)) for plant, sensor, chains, _ in cases], rows(cases))


def rows(cases):
    return np.stack([case[3] for case in cases])


def hold(cases, off, most, **others):
    """Fail with the network as code where `off`, one number for each case, exceeds `most`."""
    wrong = np.flatnonzero(~(off <= most))
    if wrong.size:
        plant, sensor, chains, z = cases[first := int(wrong[0])]
        parts = {"plant": plant, "sensor": sensor, "channel": channel(chains), "z": z}
        more = {name: value[first] for name, value in others.items()}
        raise AssertionError(
            f"{wrong.size} of {len(cases)} networks are off, the first by {off[first]:g} where {most:g} is allowed:\n"
            + as_code(**parts, **more)
        )


def apart(first, second):
    """The largest difference of means and of covariances, relative to the largest entry."""
    gaps = [
        np.abs(a - b).max(axis=(1, *range(2, a.ndim))) / np.maximum(np.abs(b).max(axis=(1, *range(2, b.ndim))), 1e-300)
        for a, b in ((first.mean, second.mean), (first.covariance, second.covariance))
    ]
    return np.maximum(*gaps)


@pytest.mark.slow
@pytest.mark.parametrize(("n", "m"), SIZES)
@pytest.mark.parametrize("build", [hg.cubature_filter, hg.extended_filter, hg.linear_filter])
def test_bounds_stay_positive_semidefinite(build, n, m):
    cases, bounds = networks(n, m), followed(build, n, m)
    smallest = np.linalg.eigvalsh(bounds.covariance)[..., 0].min(axis=1)
    hold(cases, -smallest / np.abs(bounds.covariance).max(axis=(1, 2, 3)), ROUNDING)


@pytest.mark.parametrize(("n", "m"), SIZES)
def test_units_of_the_received_signal_do_not_matter(n, m):
    cases, scales = networks(n, m), np.random.default_rng(1).uniform(0.3, 3.0, COUNT)
    scaled = [
        hg.cubature_filter(plant, sensor, channel(chains, scale))
        for (plant, sensor, chains, _), scale in zip(cases, scales, strict=True)
    ]
    result = follow_each(scaled, scales[:, None, None] * rows(cases))
    hold(cases, apart(result, followed(hg.cubature_filter, n, m)), ROUNDING, scale=scales)


@pytest.mark.parametrize(("n", "m"), [size for size in SIZES if size[1] == 2])
def test_missing_data_equal_a_channel_that_is_off(n, m):
    cases = [(plant, sensor, certain(chains), z) for plant, sensor, chains, z in networks(n, m)]
    whole, off = (
        [hg.linear_filter(plant, sensor, channel(chains, off=i)) for plant, sensor, chains, _ in cases]
        for i in (None, 1)
    )
    missing = rows(cases)
    missing[:, :, 1] = np.nan
    hold(cases, apart(follow_each(whole, missing), follow_each(off, rows(cases))), ROUNDING)


@pytest.mark.parametrize(("n", "m"), SIZES)
def test_recordings_step_by_step(n, m):
    """Of ten networks with one list of chains, whose numbers differ: a network's channel is part of its program."""
    template = networks(n, m, seed=2)[0][2]
    rng, cases = np.random.default_rng(3), []
    for plant, sensor, _, z in networks(n, m)[:10]:
        cases.append((plant, sensor, [[(law, rng.uniform(0.01, 0.3)) for law, _ in chain] for chain in template], z))
    off = []
    for plant, sensor, chains, z in cases:
        item = hg.cubature_filter(plant, sensor, channel(chains))
        network = hg.Network(plant, {"node": hg.Node(sensor, channel(chains), {"f": item})})
        together = hg.run(network, {"node": z}).estimates["node"]["f"]
        alone = follow(item, z)
        pairs = ((together.mean, alone.mean), (together.covariance, alone.covariance))
        off.append(max(np.abs(a - b).max() / np.abs(b).max() for a, b in pairs))
    hold(cases, np.array(off), ROUNDING)


@pytest.mark.parametrize(("n", "m"), SIZES)
def test_more_noise_never_lowers_the_best_linear_error(n, m):
    cases = networks(n, m)
    noisy = np.random.default_rng(4).integers(0, 4, COUNT)
    louder = [
        hg.linear_filter(plant, sensor, channel([[(law, q * (4 if k == hop % len(c) else 1))
                                                 for k, (law, q) in enumerate(c)] for c in chains]))
        for (plant, sensor, chains, _), hop in zip(cases, noisy, strict=True)
    ]  # fmt: skip
    quiet, loud = followed(hg.linear_filter, n, m).covariance, follow_each(louder, rows(cases)).covariance
    size = np.abs(loud).max(axis=(1, 2, 3))
    known = np.array([not uncertain(chains) for _, _, chains, _ in cases])
    gap = np.linalg.eigvalsh(loud - quiet)[..., 0].min(axis=1)
    hold(cases, np.where(known, -gap / size, 0.0), ROUNDING, hop=noisy)
    traces = np.trace(loud - quiet, axis1=2, axis2=3).min(axis=1)
    hold(cases, -traces / size, 1e-7, hop=noisy)
