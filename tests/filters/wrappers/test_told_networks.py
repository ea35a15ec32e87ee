"""Claims of filters behind random links of which something is told: exact, by the errors of simulated networks."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.model import Pilot, told


def draw_gain(generator):
    laws = [hg.Rayleigh(generator.uniform(0.4, 1.2)), hg.Discrete(generator.normal(size=2), [0.4, 0.6])]
    return laws[generator.integers(2)]


def draw_link(generator):
    """A hop that is told its gain, a pilot's reading, its noise or nothing; and the same with losses."""
    noise = generator.uniform(0.05, 0.5)
    kind = generator.integers(4)
    if kind == 0:
        link = hg.hop(draw_gain(generator), noise, known=True)
    elif kind == 1:
        link = hg.hop(hg.Rayleigh(generator.uniform(0.4, 1.2)), noise, known=Pilot(generator.uniform(0.02, 0.5)))
    elif kind == 2:
        gain = draw_gain(generator)
        link = told(lambda a: hg.hop(gain, a[0]), ["variance"], hg.Discrete([0.1, 2.0], [0.5, 0.5]))
    else:
        link = hg.hop(draw_gain(generator), noise)
    if generator.integers(2):
        link = hg.amplify_and_forward([hg.hop(draw_gain(generator), generator.uniform(0.05, 0.3)), link])
    return link, hg.erasure(link, 0.7) if generator.integers(3) == 0 else link


def judge_claim(seed, runs=4000, steps=4):
    """Return (q - n) over its standard error, q the mean of e' P^-1 e at the last step, n where the claim is exact."""
    generator = np.random.default_rng(seed)
    n, m = int(generator.integers(1, 4)), int(generator.integers(1, 3))
    root, mean = generator.normal(size=(n, n)), generator.normal(size=n)
    plant = hg.LinearPlant(0.6 * generator.normal(size=(n, n)), root @ root.T + 0.1 * np.eye(n), mean, np.eye(n))
    sensor = hg.LinearSensor(generator.normal(size=(m, n)), np.diag(generator.uniform(0.05, 0.5, m)))
    drawn = [draw_link(generator) for _ in range(m)]
    received, channel = (links[0] if m == 1 else hg.parallel(links) for links in zip(*drawn, strict=True))
    filter = hg.linear_filter(plant, sensor, received)
    assert filter.claim == "exact"
    record = hg.monte_carlo(hg.Network(plant, {"a": hg.Node(sensor, channel, {"f": filter})}), steps, runs, key=seed)
    estimate = record.estimates["a"]["f"]
    error = (record.truth - estimate.mean)[:, -1]
    q = np.einsum("ri,rij,rj->r", error, np.linalg.inv(np.asarray(estimate.covariance)[:, -1]), error)
    return (q.mean() - n) / (q.std() / np.sqrt(runs))


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(8))
def test_the_claim_is_exact_behind_links_of_which_something_is_told(seed):
    """Given all that is told, an estimate's error has the covariance claimed, so that e' P^-1 e has the mean n.

    4.5 standard errors: one of 150,000 such numbers is beyond.
    """
    assert abs(judge_claim(seed)) < 4.5
