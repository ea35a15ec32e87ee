"""A Gaussian by mean and factors: its operations against textbook formulas and exact fractions."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import multivariate_normal

from heliograph.factors import (
    WeightedColumns,
    add_noise_to_image,
    append_rows,
    columns_of,
    condition_on_next_state,
    condition_on_observation,
    from_columns,
    from_covariance,
    gain_of,
    image_by_slopes,
    impose_moments_of_combination,
    merge_mixture,
    predict_affine,
    rounding_of,
    rts_step,
    take_leading,
    triangularise,
    zero_covariance,
)
from heliograph.factors.factored_gaussian import Gaussian, from_summed_covariance
from heliograph.numerics import write_short_programs
from tests.factors.exact import after, congruence, exactly, total

# One program for each size, not one for each of its hundred operations.
condition_on_next_state, predict_affine, condition_on_observation, impose_moments_of_combination = (
    jax.jit(f)
    for f in (condition_on_next_state, predict_affine, condition_on_observation, impose_moments_of_combination)
)
rts_step, add_noise_to_image, append_rows = (jax.jit(f) for f in (rts_step, add_noise_to_image, append_rows))
triangularise, gain_of, from_traced_covariance = (jax.jit(f) for f in (triangularise, gain_of, from_covariance))


@jax.jit
def log_density(seen, present, size):
    return seen.log_density(present, size)


EXACT = {"rtol": 1e-11, "atol": 1e-12}  # some twenty products of numbers of order 1, and a solution
SIZES = [(1, 1), (3, 2), (5, 3), (9, 4)]  # all written out, which 24 rows are


@pytest.fixture(autouse=True)
def double():
    with jax.enable_x64(True):
        yield


def covariance(rng, n):
    root = rng.normal(size=(n, n))
    return root @ root.T + 0.1 * np.eye(n)


def problem(n, m):
    rng = np.random.default_rng(n)
    return rng.normal(size=n), covariance(rng, n), rng.normal(size=(m, n)), covariance(rng, m), rng.normal(size=m)


@pytest.mark.parametrize(("n", "m"), SIZES)
def test_moving_adds_the_noise(n, m):
    mean, p, _, _, _ = problem(n, m)
    rng = np.random.default_rng(0)
    f, b, q = rng.normal(size=(n, n)), rng.normal(size=n), covariance(rng, n)
    x = from_covariance(mean, p)
    np.testing.assert_allclose(x.covariance, p, **EXACT)
    by_rows = predict_affine(x, f, b, columns_of(q))
    by_image = add_noise_to_image(image_by_slopes(f @ x.mean + b, f @ x.root, x), columns_of(q))
    for moved in (by_rows, by_image):
        np.testing.assert_allclose(moved.mean, f @ mean + b, **EXACT)
        np.testing.assert_allclose(moved.covariance, f @ p @ f.T + q, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("missing", [False, True])
@pytest.mark.parametrize(("n", "m"), SIZES)
def test_observing_is_kalman_s_update(n, m, missing):
    """With correlated noises, whether the first component arrives or not; its density is the joint Gaussian's."""
    mean, p, h, r, z = problem(n, m)
    used = np.arange(m) >= (1 if missing else 0)
    innovation = np.where(used, z, np.nan)
    x = from_covariance(mean, p)
    known, seen = condition_on_observation(x, h @ x.root, jnp.asarray(innovation), columns_of(r))
    h, r, z = h[used], r[np.ix_(used, used)], z[used]
    s = h @ p @ h.T + r
    gain = np.linalg.solve(s, h @ p).T
    np.testing.assert_allclose(known.mean, mean + gain @ z, **EXACT)
    np.testing.assert_allclose(known.covariance, p - gain @ s @ gain.T, **EXACT)
    density = multivariate_normal(np.zeros(len(z)), s).logpdf(z) if len(z) else 0.0
    np.testing.assert_allclose(log_density(seen, used, jnp.abs(innovation)), density, **EXACT)


def added_in_a_loop(slopes, weights, noise):
    """The law of slopes xi + w, its columns added one by one."""
    x = Gaussian(jnp.zeros(len(weights)), jnp.zeros(len(weights) * (len(weights) - 1) // 2), jnp.asarray(weights))
    with write_short_programs():
        return jax.jit(lambda *given: add_noise_to_image.__wrapped__(*given))(
            image_by_slopes(jnp.zeros(len(slopes)), jnp.asarray(slopes), x), noise
        )


@pytest.mark.parametrize("known", [0.0, 0.3])
@pytest.mark.parametrize("n", [1, 2, 5])
def test_columns_added_in_a_loop_give_the_sum(n, known):
    """Beside factors of a known covariance, or of none."""
    rng = np.random.default_rng(n)
    slopes, weights = rng.normal(size=(n, n + 3)), rng.uniform(0.1, 2.0, n + 3)
    noise = triangularise(columns_of(covariance(rng, n))).times(known)
    total = added_in_a_loop(slopes, weights, noise)
    right = (slopes * weights) @ slopes.T + WeightedColumns(*noise).covariance
    np.testing.assert_allclose(total.covariance, right, **EXACT)


def test_columns_added_in_a_loop_keep_what_their_squares_would_lose():
    """Of weights 1e-24 to 1e24: each root of d to 4 eps of its row, against fractions."""
    rng = np.random.default_rng(0)
    slopes, weights = rng.normal(size=(4, 7)), 10.0 ** rng.uniform(-24, 24, 7)
    got = added_in_a_loop(slopes, weights, WeightedColumns(jnp.eye(4), jnp.zeros(4)))
    rows, parts = exactly(slopes), exactly([weights])[0]
    left = [[sum(a * b * w for a, b, w in zip(x, y, parts, strict=True)) for y in rows] for x in rows]
    size, right = np.sqrt([float(left[i][i]) for i in range(4)]), []
    for j in range(4):
        right.append(float(left[j][j]))
        share = [x[j] / left[j][j] for x in left]
        left = [[a - s * b for a, b in zip(x, left[j], strict=True)] for x, s in zip(left, share, strict=True)]
    assert np.max(np.abs(np.sqrt(got.variances) - np.sqrt(right)) / size) < 4 * np.finfo(float).eps


@pytest.mark.parametrize("missing", [False, True])
def test_measured_in_a_loop_it_is_the_same(missing):
    """Components that are correlated, one of them twice the one before it, whose slopes are rounding then."""
    mean, p, h, r, z = problem(4, 4)
    root = np.linalg.cholesky(r)
    h[2], root[2], z[2] = 2 * h[1], 2 * root[1], 2 * z[1]
    x, innovation = from_covariance(mean, p), np.where(missing & (np.arange(4) == 1), np.nan, z)

    def condition(short):
        with write_short_programs(short):
            noise = WeightedColumns(jnp.asarray(root), np.ones(4))
            return jax.jit(lambda *given: condition_on_observation.__wrapped__(*given))(
                x, h @ x.root, jnp.asarray(innovation), noise
            )

    for a, b in zip(jax.tree.leaves(condition(True)), jax.tree.leaves(condition(False)), strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-15)


def test_nothing_that_arrives_changes_nothing():
    mean, p, h, r, _ = problem(3, 2)
    x = from_covariance(mean, p)
    known, seen = condition_on_observation(x, h @ x.root, jnp.full(2, jnp.nan), columns_of(r))
    for a, b in zip(known, x, strict=True):
        np.testing.assert_array_equal(a, b)
    assert log_density(seen, np.zeros(2, bool), jnp.zeros(2)) == 0


def test_nothing_known_and_nothing_said_changes_nothing():
    x = Gaussian(jnp.ones(2), jnp.zeros(1), jnp.zeros(2))
    known, _ = condition_on_observation(x, jnp.eye(2), jnp.ones(2), zero_covariance(2))
    assert np.all(known.mean == 1) and np.all(known.variances == 0)


def test_an_output_that_others_determine_is_judged_by_them():
    """The same noise-free output twice: the density is that of one where they agree, and 0 where they do not."""
    x, rows = from_covariance(np.zeros(1), np.eye(1)), jnp.ones((2, 1))
    both = np.ones(2, bool)
    alone = -0.5 * (0.3**2 + np.log(2 * np.pi))
    agrees, differs = (
        log_density(condition_on_observation(x, rows, jnp.asarray(z), zero_covariance(2))[1], both, jnp.ones(2))
        for z in ([0.3, 0.3], [0.3, 0.4])
    )
    assert agrees == pytest.approx(alone) and differs == -np.inf


@pytest.mark.parametrize("precise", [1e-14, 1e-10, 1e-4, 1.0])
@pytest.mark.parametrize("wide", [1.0, 1e6, 1e10, 1e14])
def test_a_wide_prior_and_a_precise_sensor_keep_their_digits(wide, precise):
    """Four steps of position and velocity in fractions: every variance within 2 % of the exact one."""
    a, q, h = np.array([[1.0, 1.0], [0.0, 1.0]]), 1e-9 * np.eye(2), np.array([[1.0, 0.0]])
    x, p = from_covariance(np.zeros(2), wide * np.eye(2)), exactly(wide * np.eye(2))
    process = columns_of(q)
    for _ in range(4):
        x = predict_affine(x, a, np.zeros(2), process)
        x, _ = condition_on_observation(x, h @ x.root, jnp.zeros(1), columns_of(np.array([[precise]])))
        p = total(congruence(exactly(a), p), exactly(q))
        p, _ = after(p, exactly(h), [[Fraction(precise)]])
        np.testing.assert_allclose(np.diagonal(x.covariance), [float(p[0][0]), float(p[1][1])], rtol=0.02)


@pytest.mark.parametrize("unit", [1e-30, 1.0, 1e30])
def test_units_do_not_matter(unit):
    mean, p, h, r, z = problem(3, 2)
    x = from_covariance(unit * mean, unit**2 * p)
    known, _ = condition_on_observation(x, h @ x.root, jnp.asarray(unit * z), columns_of(unit**2 * r))
    alone = from_covariance(mean, p)
    expected, _ = condition_on_observation(alone, h @ alone.root, jnp.asarray(z), columns_of(r))
    np.testing.assert_allclose(known.mean / unit, expected.mean, rtol=1e-11)
    np.testing.assert_allclose(known.covariance / unit**2, expected.covariance, rtol=1e-11)


def test_gains_of_two_precise_outputs_that_say_nearly_the_same():
    """The condition of S is 1e9; one after another the outputs keep their digits. In fractions."""
    h, noise = np.array([[1.0, 1.0], [1.0, 1.0001]]), 1e-12 * np.array([[1.0, 0.9], [0.9, 1.0]])
    _, gain = after(exactly(np.eye(2)), exactly(h), exactly(noise))
    x = from_covariance(np.zeros(2), np.eye(2))
    found = [
        condition_on_observation(x, jnp.asarray(h) @ x.root, jnp.asarray(z), columns_of(noise))[0].mean
        for z in np.eye(2)
    ]
    np.testing.assert_allclose(np.transpose(found), np.array(gain, dtype=float), rtol=1e-10)


@pytest.mark.parametrize(("n", "state_noise"), [(4, 0.0), (4, 1.0), (9, 1.0)])
def test_smoothing_is_rauch_s(n, state_noise):
    """Of x given x+ known better: m + J (m_s - m+), P + J (P_s - P+) J' with J = P F' (P+)^-1."""
    mean, p, _, _, _ = problem(n, 1)
    rng = np.random.default_rng(3)
    f, q = rng.normal(size=(n, n)), state_noise * covariance(rng, n)
    x = from_covariance(mean, p)
    ahead = predict_affine(x, f, np.zeros(n), columns_of(q))
    back = condition_on_next_state(x, f @ x.root, ahead.mean, triangularise(columns_of(q)))
    later = from_covariance(np.asarray(ahead.mean) + 0.3, 0.4 * np.asarray(ahead.covariance))
    known = rts_step(back, later)
    prior = f @ p @ f.T + q
    gain = np.linalg.solve(prior, f @ p).T
    np.testing.assert_allclose(known.mean, mean + gain @ np.full(n, 0.3), rtol=1e-9)
    np.testing.assert_allclose(known.covariance, p + gain @ (0.4 * prior - prior) @ gain.T, rtol=1e-8, atol=1e-9)


@pytest.mark.parametrize("n", [3, 9])
def test_a_part_that_others_determine_says_nothing_of_the_state_before(n):
    """The last part of x+ is the sum of the first two, to rounding: its innovation is that, and its gain is zero."""
    mean, p, _, _, _ = problem(n, 1)
    rng = np.random.default_rng(5)
    f, x = rng.normal(size=(n, n)), from_covariance(mean, p)
    f[-1] = f[0] + f[1]
    rounding = triangularise(rounding_of(np.diagonal(f @ p @ f.T)))
    back = condition_on_next_state(x, f @ x.root, f @ mean, rounding)
    assert np.all(np.asarray(back.gain)[:, -1] == 0) and np.all(np.any(np.asarray(back.gain)[:, :-1], axis=0))
    known = rts_step(back, Gaussian(jnp.asarray(f @ mean), back.lower, jnp.zeros(n)))
    part = f[:-1]  # x given its first parts exactly
    gain = np.linalg.solve(part @ p @ part.T, part @ p).T
    np.testing.assert_allclose(known.covariance, p - gain @ part @ p, rtol=0, atol=1e-10)


def test_a_mixture_has_its_moments():
    rng = np.random.default_rng(0)
    means, spreads = rng.normal(size=(3, 2)), np.stack([covariance(rng, 2) for _ in range(3)])
    weights = np.array([0.2, 0.5, 0.3])
    whole = jax.jit(lambda *law: merge_mixture(jax.vmap(from_covariance)(*law), weights))(means, spreads)
    middle = weights @ means
    apart = means - middle
    np.testing.assert_allclose(whole.mean, middle, **EXACT)
    expected = np.einsum("i,ijk->jk", weights, spreads) + np.einsum("i,ij,ik->jk", weights, apart, apart)
    np.testing.assert_allclose(whole.covariance, expected, **EXACT)


def test_rounding_keeps_a_noise_free_filter_from_knowing_more_than_it_can():
    """A state that moves and is seen without noise: its variance stays above the square of its rounding."""
    x, rounding = from_covariance(np.zeros(1), 1.034 * np.eye(1)), rounding_of(np.array([1.034]))
    for _ in range(20):
        x = predict_affine(x, np.array([[0.9]]), np.zeros(1), rounding)
        x, _ = condition_on_observation(x, 0.349 * x.root, jnp.zeros(1), rounding_of(np.array([0.349**2 * 1.034])))
    assert 1e-33 < float(x.variances[0]) < 1e-30


def test_derivatives_pass_a_known_state_and_a_noise_free_output():
    """d P+ / d P_0 and / dr at 0, with q the process noise: P+ = P- r / (P- + r), P- = P_0 + q."""
    q = 0.7

    def variance(start, noise):
        x = Gaussian(jnp.zeros(1), jnp.zeros(0), jnp.asarray(start)[None])
        x = predict_affine(x, jnp.eye(1), jnp.zeros(1), WeightedColumns(jnp.eye(1), jnp.full(1, q)))
        return condition_on_observation(x, x.root, jnp.zeros(1), WeightedColumns(jnp.eye(1), noise[None]))[0].variances[
            0
        ]

    slopes = jax.jit(jax.grad(variance, (0, 1)))
    of_noise, of_start = slopes(0.0, 0.0)[1], slopes(0.0, 0.3)[0]
    assert of_noise == pytest.approx(1.0) and of_start == pytest.approx((0.3 / (q + 0.3)) ** 2)


def test_of_correlated_noises_at_zero_the_scale_has_a_derivative():
    """R = r C at r = 0: given as factors of C and r times their weights, the derivative is that at a small r."""
    x = from_covariance(np.zeros(2), np.array([[2.0, 0.3], [0.3, 1.0]]))
    correlated = columns_of(np.array([[1.0, 0.5], [0.5, 1.0]]))

    def variance(r):
        return jnp.trace(condition_on_observation(x, x.root, jnp.zeros(2), correlated.times(r))[0].covariance)

    slope, near = float(jax.jit(jax.grad(variance))(0.0)), float(variance(1e-7) - variance(0.0)) / 1e-7
    assert slope == pytest.approx(near, rel=1e-5)


def test_several_at_once_are_each_alone():
    """Under vmap and with leading axes, bit for bit as alone."""
    rng = np.random.default_rng(1)
    spreads = np.stack([covariance(rng, 3) for _ in range(4)])
    many = jax.vmap(from_traced_covariance)(np.zeros((4, 3)), spreads)
    for i in range(4):
        np.testing.assert_allclose(many.covariance[i], spreads[i], **EXACT)
    assert from_summed_covariance(jnp.zeros(3), columns_of(spreads[0])).root.shape == (3, 3)


@pytest.mark.parametrize("ratio", [0.0, 1e-9, 0.3, 1.0, 7.0])
@pytest.mark.parametrize("n", [1, 3, 5])
def test_revising_a_scalar_changes_its_law_and_not_that_of_x_given_it(n, ratio):
    """P - (1 - ratio) K V K' and mean + K shift; no variance is negative, whether t is known better then or worse."""
    mean, p, rows, _, _ = problem(n, 1)
    x, h = from_covariance(mean, p), rows[0]
    v = h @ p @ h
    gain = p @ h / v
    after = impose_moments_of_combination(x, h @ x.root, 0.7, ratio)
    np.testing.assert_allclose(after.mean, mean + 0.7 * gain, **EXACT)
    np.testing.assert_allclose(after.covariance, p - (1 - ratio) * v * np.outer(gain, gain), rtol=1e-11, atol=1e-11)
    # To the last digits: after a ratio of 1e-9 too, where the difference has half of its digits.
    assert h @ after.covariance @ h == pytest.approx(ratio * v, rel=1e-6 if ratio else 0, abs=1e-14)
    assert np.all(np.asarray(after.variances) >= 0)


def test_revising_a_scalar_keeps_the_digits_of_a_small_ratio():
    """Against fractions: relative errors of a few eps of a variance that becomes 1e-20 of what it was."""
    x, h, ratio = from_covariance(np.zeros(2), np.diag([1e8, 1.0])), np.array([1.0, 0.0]), 1e-20
    after = impose_moments_of_combination(x, h @ x.root, 0.0, ratio)
    np.testing.assert_allclose(np.diagonal(after.covariance), [1e-12, 1.0], rtol=1e-14)


def test_revising_what_has_no_variance_leaves_all_as_it_is():
    x = from_covariance(np.ones(2), np.diag([0.0, 2.0]))
    after = impose_moments_of_combination(x, np.array([1.0, 0.0]), 3.0, 0.5)
    for before, now in zip(x, after, strict=True):
        np.testing.assert_array_equal(now, before)


def test_rows_below_a_gaussian_are_the_joint_law_and_its_first_components_the_same_again():
    mean, p, h, r, _ = problem(3, 2)
    x = from_covariance(mean, p)
    both = append_rows(x, h @ x.mean, h @ x.root, triangularise(columns_of(r)))
    np.testing.assert_allclose(both.covariance[3:, 3:], h @ p @ h.T + r, **EXACT)
    np.testing.assert_allclose(both.covariance[3:, :3], h @ p, **EXACT)
    for before, now in zip(x, take_leading(both, 3), strict=True):
        np.testing.assert_array_equal(now, before)


@pytest.mark.parametrize("size", [1e-154, 1e-155, 1e-160, 1e-170])
def test_squares_below_the_normal_numbers_count_as_zero(size):
    """1 / 1e-310 is no number: the column stays as it is, and nothing is learned of what it hides in."""
    x = Gaussian(np.zeros(2), np.array([0.5]), np.array([1.0, 2.0]))
    both = from_columns(np.zeros(2), WeightedColumns(np.array([[size, 0.0], [size, 1.0]]), np.ones(2)))
    np.testing.assert_allclose(both.covariance, [[0.0, 0.0], [0.0, 1.0]], atol=1e-300)
    after, _ = condition_on_observation(x, np.array([[size, 0.0]]), np.zeros(1), zero_covariance(1))
    revised = impose_moments_of_combination(x, np.array([size, 0.0]), 0.0, 0.5)
    for part in (*both, *after, *revised):
        assert np.isfinite(part).all()
    if size < 1e-154:
        for now in (after, revised):
            np.testing.assert_array_equal(now.variances, x.variances)


def test_gain_is_that_of_the_covariance_form_and_of_observe():
    """P C' (C P C' + R)^-1 with a correlated noise, and what `condition_on_observation` moves the mean by: to 1e-12."""
    draw = np.random.default_rng(5)
    p, r = (root @ root.T for root in (draw.normal(size=(4, 4)), draw.normal(size=(3, 3))))
    c, e = draw.normal(size=(3, 4)), draw.normal(size=3)
    x, noise = from_traced_covariance(np.zeros(4), p), triangularise(columns_of(r))
    gain = gain_of(x, c @ x.root, noise)
    np.testing.assert_allclose(gain, p @ c.T @ np.linalg.inv(c @ p @ c.T + r), rtol=1e-12, atol=1e-13)
    np.testing.assert_allclose(gain @ e, condition_on_observation(x, c @ x.root, e, noise)[0].mean, rtol=1e-12)
