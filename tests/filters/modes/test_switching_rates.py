"""Modes whose transition follows from the time between rows: chains by steps, all paths, and what is refused."""

from itertools import product

import jax.numpy as jnp
import numpy as np
import pytest
from scipy.linalg import expm

import heliograph as hg

RATES = np.array([[-0.1, 0.1], [0.4, -0.4]])
RING = np.array([[-1.0, 1.0, 0.0], [0.0, -1.0, 1.0], [1.0, 0.0, -1.0]])  # of complex eigenvalues
SENSOR, LINK, FIRST = hg.LinearSensor([[1.0]], 0.5), hg.perfect(1), [0.8, 0.2]
DT, Z = np.array([[0.5], [2.0], [0.1]]), np.array([[0.4], [1.5], [-0.3]])
DECAYS, NOISES = [0.1, 1.0], [0.2, 2.0]


def law(decay, noise):
    """A state that decays at a rate, with a noise in proportion to the time."""
    return hg.LinearPlant(
        lambda u: jnp.exp(-decay * u[:1, None]), lambda u: noise * u[:1, None], [0.0], 1.0, inputs=["dt"]
    )


def laws(count=2):
    return [law(d, q) for d, q in zip([*DECAYS, 0.5], [*NOISES, 1.0], strict=True)][:count]


def by_all_paths(steps):
    """Mean and the last mode's probabilities after so many rows, by a Kalman filter for each path of modes."""
    total = []
    for path in product(range(2), repeat=steps):
        m, p, weight = 0.0, 1.0, FIRST[path[0]]
        for k, j in enumerate(path):
            dt = DT[k, 0]
            weight *= expm(RATES * dt)[path[k - 1], j] if k else 1.0
            f = np.exp(-DECAYS[j] * dt)
            m, p = f * m, f * p * f + NOISES[j] * dt
            s, e = p + 0.5, Z[k, 0] - m
            weight *= np.exp(-e * e / s / 2) / np.sqrt(2 * np.pi * s)
            m, p = m + p / s * e, p - p * p / s
        total.append((weight, m, path[-1]))
    weights = np.array([w for w, *_ in total])
    modes = [sum(w for w, _, j in total if j == mode) for mode in (0, 1)]
    return weights @ np.array([m for _, m, _ in total]) / weights.sum(), np.array(modes) / weights.sum()


def test_two_rows_of_gpb2_are_those_of_all_paths():
    plant = hg.markov_plant(laws(), rates=RATES, initial=FIRST)
    run = hg.filters.gpb2_filter(plant, SENSOR, LINK).run(Z[:2], DT[:2])
    mean, modes = by_all_paths(2)
    np.testing.assert_allclose(run.means[-1, 0], mean, rtol=1e-12)  # exact up to rounding
    np.testing.assert_allclose(run.modes[-1], modes, rtol=1e-12)


@pytest.mark.slow
def test_over_equal_times_it_is_the_chain_of_steps_smoothed_too_beside_a_chain_of_the_sensor():
    """Of three modes in a ring, whose rates have complex eigenvalues, and a sensor that fails by a chain of its own."""
    u, first = np.full((6, 1), 0.7), [0.5, 0.3, 0.2]
    z = np.random.default_rng(0).normal(size=(6, 1))
    sensor = hg.markov_sensor([SENSOR, hg.LinearSensor([[0.0]], 2.0)], [[0.9, 0.1], [0.3, 0.7]], [1.0, 0.0])
    plants = (
        hg.markov_plant(laws(3), rates=RING, initial=first),
        hg.markov_plant(laws(3), expm(RING * 0.7), first),
    )
    filters = [hg.filters.imm_filter(plant, sensor, LINK) for plant in plants]
    for run in (lambda filter: filter.run(z, u), lambda filter: hg.rts_smoother(filter, z, u)):
        rates, steps = map(run, filters)
        np.testing.assert_allclose(rates.means, steps.means, rtol=1e-10, atol=1e-12)
        np.testing.assert_allclose(rates.modes, steps.modes, rtol=1e-10, atol=1e-12)


@pytest.mark.parametrize(
    ("build", "said"),
    [
        (lambda p: hg.linear_filter(p, SENSOR, LINK), "imm_filter, gpb1_filter and gpb2_filter take rates"),
        (lambda p: hg.filters.particle_filter(p, SENSOR, LINK, 10), "imm_filter, gpb1_filter and gpb2_filter take"),
        (lambda p: hg.simulate(hg.Network(p, {"a": hg.Node(SENSOR, LINK, {})}), 3, 0, inputs=np.ones((3, 1))),
         "simulation: expected transitions of a plant's modes by steps"),
        (lambda p: hg.markov_plant(laws(), rates=[[0.1, -0.1], [0.4, -0.4]], initial=FIRST), "0 or more beside"),
        (lambda p: hg.markov_plant(laws(), rates=RATES), "initial=, the law of the mode of the first row"),
        (lambda p: hg.markov_plant(laws(), RATES, FIRST, rates=RATES), "no transition= and no modes= .* got tr"),
        (lambda p: hg.markov_plant(laws(3), rates=RATES, initial=FIRST), "models: expected 2"),
        (lambda p: hg.markov_plant([hg.LinearPlant([[1.0]], 1.0, [0.0], 1.0)] * 2, rates=RATES, initial=FIRST),
         "plants with the input 'dt'"),
    ],
)  # fmt: skip
def test_what_cannot_be_is_refused_in_one_line(build, said):
    with pytest.raises(ValueError, match=said) as error:
        build(hg.markov_plant(laws(), rates=RATES, initial=FIRST))
    assert "\n" not in str(error.value)
