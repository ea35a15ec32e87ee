"""Bounds and certificates under observed losses, against published examples, brute force and Monte Carlo."""

import numpy as np
import pytest

from heliograph.linear.jump_system import JumpSystem
from heliograph.linear.known_loss_stability import KnownLossSystem, certify_radius, find_gains
from heliograph.random_affine.modes import long_run_law
from heliograph_studies.intermittent_observations import setting
from heliograph_studies.intermittent_observations.mean_error import mean_error
from tests.riccati import riccati

SCALAR = ([[-1.25]], [[1.0]], [[1.0]], [[2.5]])  # A, C, Q, R
COUPLED = ([[1.25, 0.0], [1.0, 1.1]], [[1.0, 1.0]], 20 * np.eye(2), [[2.5]])
THREE = ([[1.25, 1, 0], [0, 0.9, 7], [0, 0, 0.6]], [[1.0, 0, 2]], 20 * np.eye(3), [[2.5]])


def lossy(example, chain, start=(0.5, 0.5)):
    """Mode 0 delivers, mode 1 loses."""
    a, c, q, r = (np.asarray(item, dtype=float) for item in example)
    chain = np.asarray(chain, dtype=float)
    none = np.zeros((0, len(a)))
    return KnownLossSystem(
        a, q, chain, long_run_law(np.array(start), chain), np.array([0, 1]), (c, none), (r, none[:, :0])
    )


def independent(example, arrival):
    return lossy(example, [[arrival, 1 - arrival]] * 2)


def bound(system):
    return system.solve_steady_covariances(find_gains(system)).sum(axis=0)


def lower_bound(system):
    """What losses add is below E P of any filter: S_j = sum_i T_ij (A S_i A' + law_i Q), S_i left out where z comes."""
    lost = np.array([len(system.outputs[s]) == 0 for s in system.known])[:, None, None]
    noise = system.law[:, None, None] * system.process
    jumps = JumpSystem(system.chain[None], (lost * system.transition)[None], noise[None])
    return np.einsum("ij,iab->jab", system.chain, jumps.steady()[0])


@pytest.mark.parametrize(
    ("example", "upper", "lower", "radius"),
    [(SCALAR, 7.32659, 2.66667, 0.68568), (COUPLED, 703.246, 234.499, 0.88424), (THREE, 75850.75, 5165.91, 0.82864)],
    ids=["scalar", "coupled", "three states"],
)
def test_bounds_of_published_examples_at_arrival_0_6(example, upper, lower, radius):
    system = independent(example, 0.6)
    gains = find_gains(system)
    digits = {"rtol": 5e-6}  # the numbers have six digits
    np.testing.assert_allclose(np.trace(bound(system)), upper, **digits)
    np.testing.assert_allclose(np.trace(lower_bound(system).sum(axis=0)), lower, **digits)
    np.testing.assert_allclose(certify_radius(system, gains), radius, rtol=1e-5)


def test_the_bound_solves_the_modified_riccati_equation():
    a, c, q, r = (np.asarray(item) for item in COUPLED)
    v = bound(independent(COUPLED, 0.6))
    k = a @ v @ c.T @ np.linalg.inv(c @ v @ c.T + r)
    np.testing.assert_allclose(a @ v @ a.T + q - 0.6 * k @ c @ v @ a.T, v, rtol=1e-10)


@pytest.mark.parametrize(
    ("fail", "recover", "upper", "mean"),
    [(0.1, 0.6, 4.5801, 4.3818), (0.3, 0.6, 6.5848, 6.1303), (0.1, 0.9, 3.6612, 3.6096), (0.4, 0.6, 7.3266, 6.8095)],
)
def test_bursts_of_losses(fail, recover, upper, mean):
    system = lossy(SCALAR, [[1 - fail, fail], [recover, 1 - recover]])
    result = mean_error(setting.SCALAR, fail, recover)
    np.testing.assert_allclose((bound(system)[0, 0], result), (upper, mean), atol=5e-5)  # four decimals
    assert lower_bound(system).sum() < result < bound(system)[0, 0]


def test_bounds_enclose_the_mean_over_all_patterns():
    """E P_T over all 2^T patterns of losses, started where the bound stands, lies between the bounds at each step."""
    system = lossy(COUPLED, [[0.9, 0.1], [0.7, 0.3]])
    a, c, q, r = (np.asarray(item) for item in COUPLED)
    upper, lower = system.solve_steady_covariances(find_gains(system)), lower_bound(system)
    paths = [(system.law[i], i, u / p) for i, (u, p) in enumerate(zip(upper, system.law, strict=True))]
    for _ in range(9):
        paths = [
            (weight * system.chain[i, j], j, riccati(a, c, q, r, p, i == 0)) for weight, i, p in paths for j in (0, 1)
        ]
    for j in (0, 1):
        mean = sum(weight * p for weight, i, p in paths if i == j)
        assert np.linalg.eigvalsh(upper[j] - mean).min() > 0
        assert np.linalg.eigvalsh(mean - lower[j]).min() > 0


def test_independent_losses_are_a_chain_with_equal_rows():
    """The sum over modes has the radius of the operator by mode; a chain a hair off has the same to that hair."""
    chain = np.array([[0.6, 0.4], [0.6 + 1e-13, 0.4 - 1e-13]])
    by_mode, together = lossy(COUPLED, chain), independent(COUPLED, 0.6)
    sizes = [len(item.close_loop(find_gains(item)).operator()) for item in (by_mode, together)]
    assert sizes == [2 * 3, 3]
    np.testing.assert_allclose(bound(by_mode), bound(together), rtol=1e-9)


def test_permuting_modes_changes_nothing():
    chain = np.array([[0.8, 0.2], [0.7, 0.3]])
    item, other = lossy(COUPLED, chain), lossy(COUPLED, chain)
    other = other._replace(
        chain=chain[::-1, ::-1], law=item.law[::-1], known=item.known[::-1], noises=item.noises[::-1]
    )
    np.testing.assert_allclose(bound(item), bound(other), rtol=1e-11)


def test_a_certificate_does_not_trust_the_gains():
    system = independent(SCALAR, 0.6)
    good, none = find_gains(system), (np.zeros((1, 1)), np.zeros((1, 0)))
    assert certify_radius(system, good) < 1 < certify_radius(system, none)
    np.testing.assert_allclose(certify_radius(system, none), 1.25**2)
    closed = -1.25 - good[0][0, 0]
    np.testing.assert_allclose(certify_radius(system, good), 0.4 * 1.25**2 + 0.6 * closed**2)


def test_the_radius_is_the_growth_of_the_mean_square_under_the_gains():
    system = lossy(COUPLED, [[0.5, 0.5], [0.8, 0.2]])
    jumps = system.close_loop(find_gains(system), noise=0.0)
    parts = np.array([np.eye(2), np.eye(2)])
    for _ in range(400):
        before, (parts,) = parts, jumps.after(parts)
    np.testing.assert_allclose(parts.sum() / before.sum(), jumps.radius(), rtol=1e-9)


def test_modes_that_tell_the_same_share_their_gain():
    """Two modes that both deliver: what is hidden cannot choose the gain, and the bound holds for what is observed."""
    a, c, q, r = (np.asarray(item) for item in SCALAR)
    chain = np.array([[0.6, 0.2, 0.2], [0.1, 0.2, 0.7], [0.3, 0.3, 0.4]])
    law = long_run_law(np.ones(3) / 3, chain)
    none = np.zeros((0, 1))
    system = KnownLossSystem(a, q, chain, law, np.array([0, 0, 1]), (c, none), (r, r, none[:, :0]))
    gains = find_gains(system)
    assert len(gains) == 2
    assert certify_radius(system, gains) < 1
    rng = np.random.default_rng(0)
    mode, p, results = 0, q, []
    for _ in range(5000):
        p = riccati(a, c, q, r, p, mode < 2)
        mode = rng.choice(3, p=chain[mode])
        results.append(p[0, 0])
    assert np.mean(results) < bound(system)[0, 0]


def test_a_mode_that_is_left_for_good_has_its_gain_too():
    """It starts where z = x arrives and ends where z = 2 x does: while it is there, a gain of 0 would let P grow."""
    a, c, q, r = (np.asarray(item) for item in SCALAR)
    chain = np.array([[0.9, 0.1], [0.0, 1.0]])
    law = long_run_law(np.array([1.0, 0.0]), chain)
    np.testing.assert_allclose(law, (0, 1), atol=1e-15)
    system = KnownLossSystem(a, q, chain, law, np.array([0, 1]), (c, 2 * c), (r, r))
    gains = find_gains(system)
    assert certify_radius(system, gains) < 1
    always = KnownLossSystem(a, q, np.ones((1, 1)), np.ones(1), np.array([0]), (2 * c,), (r,))
    np.testing.assert_allclose(bound(system), bound(always), rtol=1e-9)


def test_size_is_refused_with_the_number():
    chain = np.full((40, 40), 1 / 40) + np.eye(40) * 0
    chain[0] = np.eye(40)[0]
    n = 11
    system = KnownLossSystem(
        np.eye(n), np.eye(n), chain, chain[1], np.zeros(40, dtype=int), (np.zeros((0, n)),), (np.zeros((0, 0)),) * 40
    )
    with pytest.raises(
        ValueError, match="chain of losses: expected at most 1024 entries of covariances over all modes, got 4840"
    ):
        find_gains(system)


@pytest.mark.parametrize("seed", range(6))
def test_bounds_enclose_the_mean_of_random_systems(seed):
    """Two states, three modes with outputs and chains at random: E P over all paths, started where the bound stands."""
    draw = np.random.default_rng(seed)
    a = draw.normal(size=(2, 2))
    a *= 1.2 / np.abs(np.linalg.eigvals(a)).max()
    chain = draw.dirichlet([2.0, 2.0, 1.0], size=3)
    law = long_run_law(np.ones(3) / 3, chain)
    outputs = (draw.normal(size=(2, 2)), draw.normal(size=(1, 2)), np.zeros((0, 2)))
    noises = (np.diag(draw.uniform(0.1, 2.0, 2)), np.eye(1), np.zeros((0, 0)))
    q = np.diag(draw.uniform(0.1, 2.0, 2))
    system = KnownLossSystem(a, q, chain, law, np.arange(3), outputs, noises)
    gains = find_gains(system)
    assert certify_radius(system, gains) < 1
    upper = system.solve_steady_covariances(gains)
    paths = [(p, i, u / p) for i, (u, p) in enumerate(zip(upper, law, strict=True))]
    for _ in range(5):
        paths = [
            (weight * chain[i, j], j, riccati(a, outputs[i], q, noises[i], p, len(outputs[i]) > 0))
            for weight, i, p in paths
            for j in range(3)
        ]
    lower = lower_bound(system)
    for j in range(3):
        mean = sum(weight * p for weight, i, p in paths if i == j)
        assert np.linalg.eigvalsh(upper[j] - mean).min() > 0
        assert np.linalg.eigvalsh(mean - lower[j]).min() > 0
