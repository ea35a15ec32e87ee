"""What only a product of gains tells, and what a step with a told gain costs."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph import random_affine

PLANT, SENSOR = hg.LinearPlant([[0.95]], 0.1, [0.0], 0.1 / (1 - 0.95**2)), hg.LinearSensor([[1.0]], 0.05)
FIRST, SECOND = 0.4, 0.05  # variances of the noises of both hops
LAW = hg.Discrete([1.0, 2.0, 4.0], [0.25, 0.5, 0.25])  # of g1 g2, both 1 or 2 with even chances


def given_the_product(about):
    """Two hops z = g2 (g1 y + n1) + n2: the second gain is 1 and 2 at a product of 1 and 4, either at 2."""
    low = jnp.clip((4 - about[0]) / 2 - jnp.where(about[0] == 2, 0.5, 0.0), 0.0, 1.0)
    hops = [hg.hop(hg.random_affine.Constant(about[0]), g2**2 * FIRST + SECOND) for g2 in (1.0, 2.0)]
    return random_affine.Mixture(hops, jnp.stack([low, 1 - low]))


def as_if_independent(about):
    """The noise of the first hop at E g2^2 = 2.5, whatever the product is."""
    return hg.hop(hg.random_affine.Constant(about[0]), 2.5 * FIRST + SECOND)


@pytest.mark.slow
def test_of_a_product_alone_the_noise_is_that_given_it():
    """E[g2^2 | g1 g2] is 1, 2.5 and 4: filters that know so are right, one that takes 2.5 is made for another world."""
    links = [hg.model.told(link, ["product"], LAW) for link in (given_the_product, as_if_independent)]
    filters = dict(
        zip(("given", "independent"), (hg.linear_filter(PLANT, SENSOR, link) for link in links), strict=True)
    )
    network = hg.Network(PLANT, {"a": hg.Node(SENSOR, links[0], filters)})
    assert network.claims()["a"] == {"given": "exact", "independent": "nominal"}
    scores = hg.monte_carlo(network, 40, 20_000, 3, keep=hg.Statistics())["a"]
    nees, low, high = scores["given"].nees_per_dimension(0.999)
    assert low < 1 < high, nees
    assert scores["independent"].mean_trace() > 1.002 * scores["given"].mean_trace()


@pytest.mark.slow
def test_a_step_with_told_gains_has_hardly_more_operations_than_one_with_known_ones():
    """Of four states and two outputs, at most a tenth more."""
    rng, r = np.random.default_rng(0), 0.2
    a = rng.normal(size=(4, 4))
    plant = hg.LinearPlant(0.9 * a / np.abs(np.linalg.eigvals(a)).max(), 0.1 * np.eye(4), np.zeros(4), np.eye(4))
    c, gains, z = rng.normal(size=(2, 4)), np.ones((8, 20, 2)), np.zeros((8, 20, 2))
    link = hg.parallel([hg.hop(hg.Rayleigh(1.0), r, known=True) for _ in range(2)])
    told = hg.linear_filter(plant, hg.LinearSensor(c, np.zeros((2, 2))), link)
    start = hg.extended_filter(plant, hg.LinearSensor(c, r * np.eye(2)), hg.perfect(2)).init()

    def run_told(gains, z):
        return jax.lax.scan(lambda x, row: _mean(told.step(x, jnp.concatenate(row))), told.init(), (z, gains))[1]

    def run_known(gains, z):
        def step(state, row):
            sensor = hg.LinearSensor(row[1][:, None] * c, r * np.eye(2))
            return _mean(hg.extended_filter(plant, sensor, hg.perfect(2)).step(state, row[0]))

        return jax.lax.scan(step, start, (z, gains))[1]

    counts = [int(re.findall(r"native: (\d+)", hg.engine.engine_of(run, gains, z))[0]) for run in (run_told, run_known)]
    assert counts[0] <= 1.1 * counts[1]


def _mean(step):
    return step[0], step[1].mean
