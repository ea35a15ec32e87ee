"""Second moments by mode against the recursion run long enough, the adjoint against what it is the derivative of."""

import numpy as np
import pytest

from heliograph.linear.jump_system import JumpSystem

MODES, N = 3, 2


def jumps(steps, forgets, seed=0):
    draw = np.random.default_rng(seed)
    chain = draw.dirichlet(np.ones(MODES), size=(steps, MODES))
    if forgets:
        chain[0] = chain[0, 0]
    maps = 0.4 * draw.normal(size=(steps, MODES, N, N))
    root = draw.normal(size=(steps, MODES, N, N))
    return JumpSystem(chain, maps, root @ root.swapaxes(2, 3))


@pytest.mark.parametrize("forgets", [False, True])
@pytest.mark.parametrize("steps", [1, 3])
def test_the_steady_state_is_where_the_recursion_stays(steps, forgets):
    system, moments = jumps(steps, forgets), np.zeros((MODES, N, N))
    assert system.radius() < 0.9
    for _ in range(400):
        *_, moments = after = system.after(moments)
    np.testing.assert_allclose(system.steady(), after, rtol=1e-13)  # 0.9^400 is 1e-18
    sizes = 1 if forgets else MODES
    assert len(system.operator()) == sizes * N * (N + 1) // 2


def test_the_radius_is_that_of_all_entries():
    """sum_i T_ij F_j X_i F_j' as a matrix on X of every mode, the textbook's form."""
    system = jumps(1, forgets=False)
    squares = [np.kron(f, f) for f in system.maps[0]]
    whole = np.block([[system.chain[0, i, j] * squares[j] for i in range(MODES)] for j in range(MODES)])
    assert system.radius() == pytest.approx(np.abs(np.linalg.eigvals(whole)).max(), rel=1e-13)


@pytest.mark.parametrize("forgets", [False, True])
def test_a_chain_that_forgets_needs_only_the_sum_of_the_modes(forgets):
    system = jumps(2, forgets)
    moments = system.steady()[-1]
    by_mode, together = (system.after(start)[-1] for start in (moments, moments.sum(axis=0, keepdims=True)))
    assert np.allclose(by_mode, together, rtol=1e-13) is forgets


@pytest.mark.parametrize("forgets", [False, True])
@pytest.mark.parametrize("forever", [False, True])
def test_the_adjoint_is_the_derivative(forever, forgets):
    """X is affine in the noise, so that a difference of any size is exact."""
    steps = 3
    system, change = jumps(steps, forgets), jumps(steps, forgets, seed=1).added
    weights = jumps(steps, forgets, seed=2).added[:, 0]

    def cost(added):
        now = system._replace(added=added)
        moments = now.steady() if forever else np.array(now.after(np.zeros(now.shape)))
        return np.sum(weights * moments.sum(axis=1))

    slope = cost(system.added + change) - cost(system.added)
    assert slope == pytest.approx(np.sum(system.adjoint(weights, forever) * change), rel=1e-12)


@pytest.mark.parametrize("exponent", [4, 8])
def test_units_cost_no_digits(exponent):
    system = jumps(2, forgets=False)
    unit = 10.0 ** np.array([-exponent, exponent])
    other = JumpSystem(system.chain, unit[:, None] * system.maps / unit, unit[:, None] * system.added * unit)
    np.testing.assert_allclose(other.steady() / (unit[:, None] * unit), system.steady(), rtol=1e-11)
    assert other.radius() == pytest.approx(system.radius(), rel=1e-11)
