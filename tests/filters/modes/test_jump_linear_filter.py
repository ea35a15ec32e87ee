"""The best linear filter behind links that remember, against all paths of the modes, limits, and simulation."""

from itertools import product

import numpy as np
import pytest

import heliograph as hg
from heliograph.random_affine import second_order
from tests.filters.modal_problems import BAD, CHAIN_A, GOOD, LAW_A, RELAY, chain_a
from tests.follow import follow
from tests.oracles import links_with_memory as oracle

Series, Stack, Mixture, Modes = (getattr(hg.random_affine, n) for n in ("Series", "Stack", "Mixture", "Modes"))
EXACT = dict(rtol=1e-11, atol=1e-13)  # sums of a few hundred products

STEPS = 4
A = np.array([[0.9, 0.3], [-0.2, 0.8]])
SHIFT = np.array([0.3, -0.1])
Q, P0, X0 = np.array([[0.2, 0.05], [0.05, 0.3]]), np.array([[1.0, 0.2], [0.2, 0.5]]), np.array([1.0, -0.5])
C, R, V = np.array([[1.0, 0.5]]), np.array([[0.1]]), np.array([0.2])
INPUT = np.array([[0.5], [0.2]])
U = np.array([[1.0], [-0.5], [0.0], [2.0]])
PLANTS = [
    hg.LinearPlant((1 + 0.1 * k) * A, hg.Gaussian((1 + k) * Q, SHIFT), X0, P0, input_matrix=INPUT) for k in range(STEPS)
]
SENSORS = [hg.LinearSensor((1 - 0.2 * k) * C, hg.Gaussian(R, V)) for k in range(STEPS)]
MEASURES = [np.block([[s.matrix, V[:, None]], [np.zeros((1, 2)), np.ones((1, 1))]]) for s in SENSORS]
SECOND = oracle.plant_moments(
    [p.matrix for p in PLANTS], [SHIFT + INPUT @ u for u in U], [p.noise.covariance for p in PLANTS], X0, P0
)

CHAIN_B = np.array([[0.7, 0.2, 0.1], [0.1, 0.6, 0.3], [0.25, 0.25, 0.5]])
LAW_B = np.array([0.2, 0.5, 0.3])  # not stationary
THREE = [hg.hop(g, 0.1) for g in (0.3, -0.6, 1.2)]


def errors(item, horizon=STEPS, written_out=True):
    """Covariances of the filter's errors, which no data change."""
    u = U[:horizon] if item.inputs else None
    return follow(item, np.ones((horizon, item.received)), u, written_out).covariance


def expected(initial, transitions, maps):
    """maps[k][i]: the channel in mode i at step k, made without any memory."""
    means = [[np.asarray(m.moments(1).mean[:-1]) for m in row] for row in maps]
    spreads = [[second_order(m).nominal.center for m in row] for row in maps]
    return oracle.by_all_paths(
        SECOND,
        MEASURES,
        [s.noise.covariance for s in SENSORS],
        initial,
        transitions,
        means,
        spreads,
    )


def filtered(channel, written_out=True):
    item = hg.linear_filter(hg.model.over_time(PLANTS), hg.model.over_time(SENSORS), channel)
    return errors(item, written_out=written_out)


def constant(maps):
    return [maps] * STEPS


A_AND_B = list(product(range(2), range(3)))
BOTH_LAWS, BOTH_CHAINS = np.kron(LAW_A, LAW_B), [np.kron(a, CHAIN_B) for a in CHAIN_A]


def one_chain(k, name=None):
    return Modes(chain_a(k, name), [GOOD, BAD])


def other(name=None):
    return Modes(hg.random_affine.MarkovChain(CHAIN_B, LAW_B, name), THREE)


CASES = {  # channel at step k; law, transitions and the same channel in each mode, written out
    "a chain that varies": (one_chain, LAW_A, CHAIN_A, [GOOD, BAD]),
    "two hops, chains of their own": (
        lambda k: hg.amplify_and_forward([one_chain(k), RELAY, other()]), BOTH_LAWS, BOTH_CHAINS,
        [Series([[GOOD, BAD][i], RELAY, THREE[j]]) for i, j in A_AND_B],
    ),
    "two hops in one shadow": (
        lambda k: hg.amplify_and_forward([one_chain(k, "a"), Modes(chain_a(k, "a"), [RELAY, BAD])]), LAW_A, CHAIN_A,
        [Series([GOOD, RELAY]), Series([BAD, BAD])],
    ),
    "a direct link in the shadow of the first hop": (
        lambda k: hg.model.with_direct_link(
            hg.amplify_and_forward([one_chain(k, "a"), other("b")]), Modes(chain_a(k, "a"), [BAD, GOOD])
        ),
        BOTH_LAWS, BOTH_CHAINS,
        [Stack([Series([[GOOD, BAD][i], THREE[j]]), [BAD, GOOD][i]]) for i, j in A_AND_B],
    ),
    "a loss that is not observed": (
        lambda k: hg.dropout(hg.model.with_direct_link(one_chain(k), RELAY), 0.7), LAW_A, CHAIN_A,
        [hg.dropout(Stack([m, RELAY]), 0.7) for m in (GOOD, BAD)],
    ),
    "a choice between two shadows": (
        lambda k: Mixture([one_chain(k), other()], [0.3, 0.7]), BOTH_LAWS, BOTH_CHAINS,
        [Mixture([[GOOD, BAD][i], THREE[j]], [0.3, 0.7]) for i, j in A_AND_B],
    ),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_it_is_the_best_over_all_paths(name):
    at_step, law, transitions, maps = CASES[name]
    channel = hg.model.over_time([at_step(k) for k in range(STEPS)])
    result = filtered(channel, written_out=len(law) < len(BOTH_LAWS))
    np.testing.assert_allclose(result, expected(law, transitions, constant(maps)), **EXACT)


def test_maps_may_vary_while_the_chain_does_not():
    chain = hg.random_affine.MarkovChain(CHAIN_B, LAW_B)
    maps = [[hg.hop((1 + k) * g, 0.1 + 0.1 * k) for g in (0.3, -0.6, 1.2)] for k in range(STEPS)]
    result = filtered(hg.model.over_time([Modes(chain, row) for row in maps]))
    np.testing.assert_allclose(result, expected(LAW_B, [CHAIN_B] * 3, maps), **EXACT)


def drifts(correlations, steps, points):
    """All paths of drifting gains on a grid of what drives them: weight, c of shape (steps, gains).

    Exact to degree 2 `points` - 1 in each drawn number: second moments have degree 2 for each hop that is driven by it.
    """
    nodes, weights = np.polynomial.hermite_e.hermegauss(points)
    weights = weights / weights.sum()
    rho = np.asarray(correlations)
    for choice in product(range(points), repeat=steps * len(rho)):
        e = nodes[np.array(choice)].reshape(steps, len(rho))
        c = [e[0]]
        for row in e[1:]:
            c.append(rho * c[-1] + np.sqrt(1 - rho**2) * row)
        yield float(np.prod(weights[np.array(choice)])), np.array(c)


DRIFTING = {  # gains' correlations, channel, the channel for c
    "one hop": ([0.9], lambda f: f(0), lambda g, c: g(c[0])),
    "two hops and a direct link": (
        [0.9, 0.5],
        lambda f: hg.model.with_direct_link(hg.amplify_and_forward([f(0), f(1)]), RELAY),
        lambda g, c: Stack([Series([g(c[0]), g(c[1])]), RELAY]),
    ),
    "three hops": (
        [0.9, 0.5, 0.7],
        lambda f: hg.amplify_and_forward([f(0), f(1), f(2)]),
        lambda g, c: Series([g(c[0]), g(c[1]), g(c[2])]),
    ),
    "two hops that drift together": (
        [0.8],
        lambda f: hg.amplify_and_forward([f(0), RELAY, f(0)]),
        lambda g, c: Series([g(c[0]), RELAY, g(c[0])]),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", DRIFTING)
def test_drifting_gains_need_no_grid(name):
    """Their covariance is that over all paths of c, though the filter knows but one or two functions of it."""
    correlations, build, at_c = DRIFTING[name]
    steps, total = 3 if len(correlations) == 1 else 2, None
    sent = oracle.sent_moments(SECOND[:steps, :steps], MEASURES, [s.noise.covariance for s in SENSORS])
    for weight, c in drifts(correlations, steps, 3 if name == "two hops that drift together" else 2):
        maps = [at_c(lambda value: hg.hop(1.1 + 0.4 * value, 0.2), row) for row in c]
        parts = oracle.path_moments(
            sent, [np.asarray(m.moments(1).mean[:-1]) for m in maps], [second_order(m).nominal.center for m in maps]
        )
        total = (
            [weight * p for p in parts]
            if total is None
            else [t + weight * p for t, p in zip(total, parts, strict=True)]
        )
    channel = build(lambda i: hg.model.autoregressive_fading(1.1, 0.4, correlations[i], 0.2, name=f"drift {i}"))
    item = hg.linear_filter(hg.model.over_time(PLANTS), hg.model.over_time(SENSORS), channel)
    result = errors(item, steps, written_out=name != "three hops")
    np.testing.assert_allclose(result, oracle.best_linear(SECOND[:steps, :steps], *total), **EXACT)


def test_a_gain_that_never_changes_but_is_unknown():
    """Pi = I against the two known gains weighed, by all paths (there are two)."""
    channel = Modes(hg.random_affine.MarkovChain(np.eye(2), [0.3, 0.7]), [GOOD, BAD])
    np.testing.assert_allclose(filtered(channel), expected([0.3, 0.7], [np.eye(2)] * 3, constant([GOOD, BAD])), **EXACT)
