"""Laws that hold for every network: tried on random ones."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

import heliograph as hg

FEW = settings(max_examples=6)  # every example compiles its own network
ROUNDING = 1e-9  # relative to the largest entry, over four steps of small matrices
STEPS = 4


@st.composite
def networks(draw):
    """A random plant, sensor and list of scalar channels, one per output, known or uncertain."""
    rng = np.random.default_rng(draw(st.integers(0, 10**6)))
    n, m = draw(st.integers(1, 3)), draw(st.integers(1, 2))
    a = rng.normal(size=(n, n))
    plant = hg.LinearPlant(a / max(1, np.abs(np.linalg.eigvals(a)).max()), 0.1, rng.normal(size=n), np.eye(n))
    sensor = hg.LinearSensor(rng.normal(size=(m, n)), 0.1)
    radius = draw(st.sampled_from([0.0, 0.05]))
    laws = [
        hg.Discrete(rng.uniform(-0.5, 1.5, 3), [0.2, 0.3, 0.5], radius),
        hg.Rayleigh(0.8),
        hg.random_affine.bernoulli(0.7),
    ]
    chains = [
        [(laws[rng.integers(3)], rng.uniform(0.01, 0.3)) for _ in range(draw(st.integers(1, 3)))] for _ in range(m)
    ]
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


def follow(item, z):
    state, result = item.init(), []
    for k, row in enumerate(z):
        state, estimate = item.step(state, row, (), k)
        result.append(estimate)
    return np.array([e.mean for e in result]), np.array([e.covariance for e in result])


def close(first, second):
    for a, b in zip(first, second, strict=True):
        np.testing.assert_allclose(a, b, rtol=0, atol=ROUNDING * max(np.abs(b).max(), 1e-300))


@FEW
@given(networks(), st.sampled_from([hg.cubature_filter, hg.extended_filter, hg.linear_filter]))
def test_bounds_stay_positive_semidefinite(case, build):
    plant, sensor, chains, z = case
    _, bounds = follow(build(plant, sensor, channel(chains)), z)
    assert np.all(np.linalg.eigvalsh(bounds)[:, 0] >= -ROUNDING * np.abs(bounds).max())


@FEW
@given(networks(), st.floats(0.3, 3.0))
def test_units_of_the_received_signal_do_not_matter(case, scale):
    plant, sensor, chains, z = case
    ours = hg.cubature_filter(plant, sensor, channel(chains))
    scaled = hg.cubature_filter(plant, sensor, channel(chains, scale))
    close(follow(scaled, scale * z), follow(ours, z))


@FEW
@given(networks())
def test_missing_data_equal_a_channel_that_is_off(case):
    plant, sensor, chains, z = case
    if len(chains) < 2:
        chains, sensor = chains * 2, hg.LinearSensor(np.vstack([sensor.matrix] * 2), 0.1)
        z = np.hstack([z, z])
    chains = [[(law if not np.any(getattr(law, "radius", 0)) else hg.Rayleigh(0.5), q) for law, q in c] for c in chains]
    missing = z.copy()
    missing[:, 1] = np.nan
    whole = hg.linear_filter(plant, sensor, channel(chains))
    close(follow(whole, missing), follow(hg.linear_filter(plant, sensor, channel(chains, off=1)), z))


@FEW
@given(networks())
def test_recordings_step_by_step(case):
    plant, sensor, chains, z = case
    item = hg.cubature_filter(plant, sensor, channel(chains))
    network = hg.Network(plant, {"node": hg.Node(sensor, channel(chains), {"f": item})})
    together = hg.run(network, {"node": z}).estimates["node"]["f"]
    close((together.mean, together.covariance), follow(item, z))


@FEW
@given(networks(), st.integers(0, 3))
def test_more_noise_never_lowers_the_best_linear_error(case, hop):
    plant, sensor, chains, z = case
    louder = [[(law, q * (4 if k == hop % len(c) else 1)) for k, (law, q) in enumerate(c)] for c in chains]
    quiet, loud = (follow(hg.linear_filter(plant, sensor, channel(c)), z)[1] for c in (chains, louder))
    gap = np.linalg.eigvalsh(loud - quiet)[:, 0]
    if not any(np.any(getattr(law, "radius", 0)) for c in chains for law, _ in c):
        assert np.all(gap >= -ROUNDING * np.abs(loud).max())
    assert np.all(np.trace(loud - quiet, axis1=1, axis2=2) >= -1e-7 * np.abs(loud).max())
