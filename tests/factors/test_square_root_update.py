"""Kalman's update of known covariances on their roots: against fractions, and what repeats."""

import jax
import numpy as np
import pytest

from heliograph.factors import (
    columns_of,
    condition_on_observation,
    covariance_of_root,
    from_covariance,
    observe_information,
    observe_root,
    roots_of,
)
from tests.factors.exact import after, congruence, exactly


def problem(n, m, seed=0):
    """A covariance, an output and a noise covariance."""
    g = np.random.default_rng(seed)
    p, h, r = g.normal(size=(n, n)), g.normal(size=(m, n)), g.normal(size=(m, m))
    return p @ p.T, h, r @ r.T


@pytest.mark.parametrize(("n", "m"), [(1, 1), (3, 1), (3, 2), (2, 5), (5, 3)])
def test_gain_and_covariance_are_those_of_fractions(n, m):
    p, h, r = problem(n, m)
    expected, gain = after(*map(exactly, (p, h, r)))
    result = observe_root(roots_of(p), h, roots_of(r))
    np.testing.assert_allclose(result.covariance, np.array(expected, dtype=float), rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(result.gain, np.array(gain, dtype=float), rtol=1e-9, atol=1e-11)


def test_many_at_once_are_each_alone():
    items = [problem(3, 2, seed) for seed in range(4)]
    p, h, r = (np.array(parts) for parts in zip(*items, strict=True))
    many = observe_root(roots_of(p), h, roots_of(r))
    for i, (p_i, h_i, r_i) in enumerate(items):
        single = observe_root(roots_of(p_i), h_i, roots_of(r_i))
        np.testing.assert_allclose(many.gain[i], single.gain, rtol=1e-12, atol=1e-14)
        np.testing.assert_allclose(many.covariance[i], single.covariance, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize("wide", [1e2, 1e8, 1e14])
@pytest.mark.parametrize("precise", [1.0, 1e-8, 1e-14])
def test_a_wide_prior_and_a_precise_output_leave_what_fractions_say(wide, precise):
    """A difference P - K C P is 1e-16 P wrong; the output's row of the root is known to some eps of its deviation."""
    p, h = np.diag([wide, wide / 7]), np.array([[1.0, 0.25]])
    expected, _ = after(*map(exactly, (p, h, [[precise]])))
    result = observe_root(np.sqrt(p), h, np.sqrt([[precise]]))
    np.testing.assert_allclose(result.covariance, np.array(expected, dtype=float), rtol=1e-12, atol=1e-14 * wide)
    left = congruence(exactly(h), expected)[0][0]
    off, reach = np.sqrt(np.sum((h @ result.root) ** 2)) - np.sqrt(float(left)), np.sqrt(1.1 * wide)
    assert abs(off) < 8 * np.finfo(float).eps * reach


@pytest.mark.parametrize("noisy", [True, False])
def test_an_output_that_repeats_another_says_nothing_and_takes_nothing_away(noisy):
    """z_3 = z_1 + 2 z_2, noise and all: the same state after it, whatever rounding leaves of the repetition."""
    p, h, r = problem(4, 2)
    r = r if noisy else np.zeros((2, 2))
    repeat = np.array([[1.0, 0.0], [0.0, 1.0], [1.0, 2.0]])
    plain = observe_root(roots_of(p), h, roots_of(r))
    result = observe_root(roots_of(p), repeat @ h, roots_of(repeat @ r @ repeat.T))
    np.testing.assert_allclose(result.covariance, plain.covariance, rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(result.gain @ repeat, plain.gain, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("order", [(0, 1, 2), (0, 2, 1), (2, 0, 1)])
@pytest.mark.parametrize("rounding", [0.0, 1e-15, 1e-14])
def test_what_rounding_left_of_a_repeated_output_takes_nothing_from_the_others(order, rounding):
    """z_3 = 0.85 z_1 with a noise known to 1e-14: of z_2, which comes after it, nothing may be lost.

    The covariance is that of the outputs without the repeated one, to what a noise wrong by 1e-14 of itself changes.
    """
    p, h, r = problem(4, 2)
    repeat = np.array([[1.0, 0.0], [0.85, 0.0], [0.0, 1.0]])[list(order)]
    sent = repeat @ r @ repeat.T
    sent = sent * (1 + rounding * np.random.default_rng(1).normal(size=sent.shape))
    plain = observe_root(roots_of(p), h, roots_of(r))
    result = observe_root(roots_of(p), repeat @ h, roots_of((sent + sent.T) / 2))
    np.testing.assert_allclose(result.covariance, plain.covariance, rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(result.gain @ repeat, plain.gain, rtol=1e-9, atol=1e-9)


def test_it_is_the_update_of_the_filters():
    """The same numbers as those of `condition_on_observation`, which takes components one after another."""
    p, h, r = problem(4, 3)
    result = observe_root(roots_of(p), h, roots_of(r))
    with jax.enable_x64(True):

        @jax.jit
        def update(innovation):
            x = from_covariance(np.zeros(4), p)
            after = condition_on_observation(x, h @ x.root, innovation, columns_of(r))[0]
            return after.mean, after.covariance

        others = [update(innovation) for innovation in np.eye(3)]
    for j, (mean, _) in enumerate(others):
        np.testing.assert_allclose(mean, result.gain[:, j], rtol=1e-10, atol=1e-12)
    np.testing.assert_allclose(others[0][1], result.covariance, rtol=1e-10, atol=1e-12)


def test_roots_are_those_of_the_nearest_covariance():
    p = problem(3, 1)[0] * np.outer([1e-8, 1.0, 1e8], [1e-8, 1.0, 1e8])
    np.testing.assert_allclose(covariance_of_root(roots_of(p)), p, rtol=1e-12)
    below = np.array([[1.0, 1.0 + 1e-9], [1.0 + 1e-9, 1.0]])
    np.testing.assert_allclose(covariance_of_root(roots_of(below)), below, atol=2e-9)
    np.testing.assert_allclose(
        covariance_of_root(roots_of(np.diag([-1e-20, 0.0, 2.0]))), np.diag([0.0, 0.0, 2.0]), rtol=1e-15
    )


def test_information_adds_to_that_of_the_prior_which_may_be_singular():
    p, h, _ = problem(3, 2)
    after = observe_information(roots_of(p), h.T @ h).covariance
    np.testing.assert_allclose(after, np.linalg.inv(np.linalg.inv(p) + h.T @ h), rtol=1e-9)
    known = observe_information(roots_of(np.diag([0.0, 1.0])), np.array([[3.0, 1.0], [1.0, 2.0]])).covariance
    np.testing.assert_allclose(known, [[0.0, 0.0], [0.0, 1 / 3]], atol=1e-15)
