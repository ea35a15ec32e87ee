"""The certificate against the paper's own matrix, by its weights and by enumeration; what it refuses."""

import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

import heliograph as hg
from heliograph.h_infinity import slope_bounds
from heliograph.h_infinity.certificate import make_theorem_matrix
from tests.h_infinity.h_infinity_problems import node
from tests.oracles import h_infinity_fusion as paper

START = 10 * np.eye(4)


def random_problem(seed):
    generator = np.random.default_rng(seed)
    roots = [generator.normal(size=(2, 2)) for _ in range(4)]
    P, P_next = (
        np.kron(np.diag([1, 0]), a @ a.T) + np.kron(np.diag([0, 1]), c @ c.T) for a, c in (roots[:2], roots[2:])
    )
    return generator.normal(size=(2, 2)), P, P_next, *generator.uniform(0.1, 2.0, size=3)


@given(st.integers(0, 10_000), st.integers(0, 3), st.tuples(*[st.sampled_from([0.0, 0.3, 0.75, 1.0])] * 3))
def test_theorem_1_three_times_over(seed, i, beta):
    """Rounding only: entries up to some 1e2."""
    K, P, P_next, l1, l2, g = random_problem(seed)
    ours = make_theorem_matrix(node(i, beta=beta), 0, K, P, P_next, np.array([l1, l1, l2, l2]), g)
    np.testing.assert_allclose(ours, paper.Phi(i, K, P, P_next, l1, l2, g, beta), atol=1e-11)
    np.testing.assert_allclose(ours, paper.Phi_by_enumeration(i, K, P, P_next, l1, l2, g, beta), atol=1e-11)


@pytest.mark.parametrize("i", range(4))
def test_designed_gains_satisfy_both_published_theorems(i):
    design, g = hg.h_infinity.recursive_design(node(i), paper.gamma[i], START), paper.gamma[i]
    for s in range(16):
        K, P, P_next, (l1, l2) = design.gains[s], design.weights[s], design.weights[s + 1], design.multipliers[s]
        assert np.linalg.eigvalsh(paper.Phi(i, K, P, P_next, l1, l2, g))[-1] < 0
        assert np.linalg.eigvalsh(paper.inequality_32(i, K, P, np.linalg.inv(P_next), l1, l2, g))[-1] < 0


def test_theorem_2_is_the_schur_complement_of_theorem_1():
    K, P, P_next, l1, l2, g = random_problem(3)
    lmi = paper.inequality_32(1, K, P, np.linalg.inv(P_next), l1, l2, g)
    schur = lmi[:14, :14] - lmi[:14, 14:] @ np.linalg.inv(lmi[14:, 14:]) @ lmi[14:, :14]
    np.testing.assert_allclose(schur, paper.Phi(1, K, P, P_next, l1, l2, g), atol=1e-11)


def certificate(design, level=None, growth=(), i=0):
    return hg.h_infinity.certify_level(
        node(i), design.gains, design.weights, design.multipliers, level or design.level, growth=growth
    )


def test_it_says_by_how_much_and_what_fails():
    design = hg.h_infinity.recursive_design(node(0), 1.8, START)
    assert certificate(design).margin > 0 and certificate(design).steps_certified == 16
    low = certificate(design, level=0.8)
    assert not low.certified and any(reason.startswith("initial condition") for reason in low.reasons)
    broken = design._replace(gains=design.gains + 50 * (np.arange(16) == 9)[:, None, None])
    assert certificate(broken).steps_certified == 9
    assert certificate(broken).reasons[0].startswith("step 9: the largest eigenvalue is")
    negative = design._replace(weights=-design.weights)
    assert not certificate(negative).certified


def f(s):
    return lambda x: jnp.array([0.7 * x[0] * jnp.cos(0.1 * x[1]), 0.7 * x[1] * jnp.sin(s * x[0])])


@pytest.mark.slow
def test_the_papers_growth_constant_is_false_and_the_certificate_is_refused(monkeypatch):
    monkeypatch.setattr(slope_bounds, "LIMIT", 0)  # what is refuted hangs on no proof
    design = hg.h_infinity.recursive_design(node(0), 1.8, START)
    findings = [hg.h_infinity.check_growth(f(s), 0.7, [-2.2, -2.2], [2.2, 2.2], name=f"f at step {s}") for s in (0, 15)]
    assert not findings[0].refuted and findings[1].refuted and findings[1].ratio > 15.7
    x, y = findings[1].pair
    ratio = np.linalg.norm(np.asarray(f(15)(x)) - np.asarray(f(15)(y))) / np.linalg.norm(x - y)
    np.testing.assert_allclose(ratio, findings[1].ratio, rtol=1e-2)  # recomputed in single precision
    refused = certificate(design, growth=findings)
    assert not refused.certified and "f at step 15: constant 0.7 is false" in refused.reasons[-1]
    assert not hg.h_infinity.check_growth(
        f(15), 0.7, [-2.2, -2.2], [2.2, 2.2], differences=False
    ).refuted  # |f(x)| <= .7 |x| alone is true


def test_true_constants_give_a_level_that_is_certified():
    """|f| <= .7 |x| everywhere; .8 bounds every slope over the visited box, so the level may be called certified."""
    system = node(0, growth=(0.7, 0.8))
    design = hg.h_infinity.horizon_design(system)
    finding = hg.h_infinity.check_growth(f(9), 0.8, [-0.1, -0.03], [0.12, 0.06])
    assert not finding.refuted and finding.slope > 0.7
    assert hg.h_infinity.certify_level(
        system, design.gains, design.weights, design.multipliers, design.level, growth=[finding]
    ).certified
    np.testing.assert_allclose(design.level, 0.0328, rtol=2e-3)


def test_a_guarantee_holds_in_simulation():
    """J1 < 0 over the eight-fold outcomes is the promise: energy ratios of 200 random disturbances."""
    system = node(0, growth=0.5)
    design = hg.h_infinity.horizon_design(system)
    generator = np.random.default_rng(0)
    worst = 0.0
    for _ in range(200):
        v, rho, x0, e0 = (generator.normal(size=s) for s in ((16,), (16, 3), (2,), (2,)))
        turn = generator.normal(size=(2, 2))
        turn *= 0.5 / np.linalg.norm(turn, 2)
        x, xhat, spent, energy = np.tile(x0, (500, 1)), np.tile(x0 - e0, (500, 1)), 0.0, 0.0
        for s in range(16):
            arrived = generator.random((500, 3)) < paper.beta
            spent += np.mean(((x - xhat) @ paper.M[0]) ** 2)
            energy += v[s] ** 2 + rho[s] @ rho[s]
            y, expected = paper.h[0] * x.sum(1) + paper.D[0] * v[s], paper.h[0] * xhat.sum(1)
            noise = np.diag(paper.C) * rho[s]
            r = arrived[:, 1] * (arrived[:, 0] * y + noise[0]) + noise[1]
            direct = np.sqrt(2) * arrived[:, 2] * y + noise[2]
            innovation = np.stack([r - 0.6 * expected, direct - np.sqrt(2) * 0.7 * expected], axis=1)
            x = x @ turn.T + paper.B[:, 0] * v[s]
            xhat = xhat @ turn.T + innovation @ design.gains[s].T
        weight = 15 * (x0 @ x0 + e0 @ e0)
        worst = max(worst, np.sqrt(spent / (energy + weight)))
    assert worst < design.level


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda d: certificate(d, level=-1.0), "level: expected a positive number"),
        (lambda d: certificate(d._replace(multipliers=d.multipliers[:, :1])), "multipliers: expected 2 or 4"),
        (lambda d: certificate(d._replace(weights=d.weights[1:])), r"weights: expected shape \(17, 4, 4\)"),
        (
            lambda d: hg.h_infinity.check_growth(f(0), 0.7, [1.0, 1.0], [0.0, 0.0]),
            "region: expected a low corner below",
        ),
        (lambda d: hg.h_infinity.check_growth(f(0), -0.7, [0.0, 0.0], [1.0, 1.0]), "growth constant"),
        (
            lambda d: hg.h_infinity.check_growth(f(0), 0.7, [1.0, 1.0], [2.0, 2.0], differences=False),
            "region: expected a box around 0",
        ),
    ],
)
def test_bad_input(call, message):
    design = hg.h_infinity.HInfinityDesign(
        1.8, np.zeros((16, 2, 2)), np.tile(START, (17, 1, 1)), np.ones((16, 2)), True, ""
    )
    with pytest.raises(ValueError, match=message):
        call(design)
