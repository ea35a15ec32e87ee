"""Precise sensors: what is left of a wide prior keeps its digits, against rational arithmetic."""

from fractions import Fraction

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.factors import WeightedColumns, condition_on_observation, from_covariance
from heliograph.factors.factored_gaussian import Gaussian
from tests.follow import follow

A, C = [[1, 1], [0, 1]], [[1, 0]]
STEPS = 4


def exact(transition, noise, measured, start):
    """Diagonals of P_1 ... P_STEPS in fractions, for one measured component with this variance."""
    a, q, p = ([[Fraction(x) for x in row] for row in m] for m in (transition, noise, start))
    r, results = Fraction(measured), []
    for _ in range(STEPS):
        moved = [[sum(a[i][k] * p[k][j] for k in range(2)) for j in range(2)] for i in range(2)]
        p = [[sum(moved[i][k] * a[j][k] for k in range(2)) + q[i][j] for j in range(2)] for i in range(2)]
        total = p[0][0] + r
        p = [[p[i][j] - p[i][0] * p[0][j] / total for j in range(2)] for i in range(2)]
        results.append([float(p[0][0]), float(p[1][1])])
    return np.array(results)


def claimed(item):
    """The same of a filter."""
    state, results = item.init(), []
    for k in range(STEPS):
        state, _ = item.correct(item.predict(state, (), k), [0.0], k)
        results.append(np.diag(np.asarray(item.estimate(state).covariance)))
    return np.array(results)


@pytest.mark.parametrize(("wide", "precise"), [(1e4, 1e-9), (1e8, 1e-12), (1e6, 1e-3), (1e2, 1.0)])
def test_a_precise_sensor_leaves_as_much_as_it_says(wide, precise):
    """A difference P - K C P is 1e-16 P wrong: 7e4 times what is left in the second case.

    What remains is the rounding of a prior with correlation 1 - 1e-11, of 1e-16 / 1e-11 at the second step.
    """
    start, noise = [[wide, 0.0], [0.0, wide / 10]], [[1e-3, 2e-3], [2e-3, 5e-3]]
    plant, sensor = hg.LinearPlant(A, noise, [0.0, 0.0], start), hg.LinearSensor(C, [[precise]])
    expected = exact(A, noise, precise, start)
    for item in (hg.kalman_filter(plant, sensor), hg.linear_filter(plant, sensor, hg.perfect(1))):
        np.testing.assert_allclose(claimed(item), expected, rtol=2e-5)
    system = hg.linear.lifted_system(plant, sensor, hg.perfect(1), 1, STEPS)
    covariance = hg.linear.lmmse(system).gains.covariance
    np.testing.assert_allclose(np.diagonal(covariance, axis1=1, axis2=2), expected, rtol=2e-5)


def test_a_run_takes_the_form_that_its_numbers_need():
    """Beside a precise one or alone, a run's bits are the same."""
    plant = hg.LinearPlant(A, 0.01, [0.0, 0.0], [[1e4, 0.0], [0.0, 1.0]])

    def variance(noise):
        item = hg.linear_filter(plant, hg.LinearSensor(C, noise), hg.perfect(1))
        return item.correct(item.predict(item.init()), np.zeros(1))[0].gaussian.covariance

    with jax.enable_x64(True):
        of_runs = jax.jit(jax.vmap(variance))
        together, apart = (of_runs(np.array([[[noise]], [[1.0]]])) for noise in (1e-9, 1.0))
    np.testing.assert_array_equal(together[1], apart[1])
    assert together[0][0, 0] == pytest.approx(1e-9, rel=1e-6)


def test_derivatives_pass_before_and_after_runs_are_put_side_by_side():
    """The gradient of a sum over runs is each run's gradient, to rounding."""
    item = hg.linear_filter(hg.LinearPlant(A, 0.01, [0.0, 0.0], 1.0), hg.LinearSensor(C, 0.1), hg.perfect(1))

    def moved(z):
        return item.correct(item.predict(item.init()), z)[0].gaussian.mean.sum()

    z = np.array([[1.0], [2.0]])
    with jax.enable_x64(True):
        together = jax.jit(jax.grad(lambda z: jax.vmap(moved)(z).sum()))(z)
        items = jax.jit(jax.vmap(jax.grad(moved)))(z)
    np.testing.assert_allclose(together, items, rtol=1e-14)


WIDE, PRECISE = 10.0 ** np.arange(0, 15, 2), 10.0 ** np.arange(-14, 1, 2)


def test_a_wide_prior_and_a_precise_sensor_leave_the_exact_variance():
    """A wide prior ties position and velocity to the last digit, and no digit is lost: within 2 % in every case.

    Rows of sums of squares are known to eps, so that variances are to eps^2 of the largest; 1e-28 of it is the least.
    """
    noise = [[1e-9, 0.0], [0.0, 1e-9]]
    for wide in WIDE:
        plant = hg.LinearPlant(A, noise, [0.0, 0.0], wide)
        for precise in PRECISE:
            expected = exact(A, noise, precise, [[wide, 0.0], [0.0, wide]])
            item = hg.linear_filter(plant, hg.LinearSensor(C, precise), hg.perfect(1))
            np.testing.assert_allclose(claimed(item), expected, rtol=0.02, err_msg=f"{wide} {precise}")


@pytest.mark.parametrize("tied", [0.0, 0.9])
def test_gains_of_two_precise_outputs_that_say_nearly_the_same(tied):
    """The condition of S is 1e9, its solution is that many times rounding off; one after another they are not.

    Of contradicting outputs the estimate is as wrong as the gain. K = P H' S^-1 in fractions.
    """
    h, noise = [[1.0, 1.0], [1.0, 1.0001]], [[1e-12, tied * 1e-12], [tied * 1e-12, 1e-12]]
    a, n = [[Fraction(x) for x in row] for row in h], [[Fraction(x) for x in row] for row in noise]
    s = [[sum(a[i][k] * a[j][k] for k in range(2)) + n[i][j] for j in range(2)] for i in range(2)]
    determinant = s[0][0] * s[1][1] - s[0][1] * s[1][0]
    inverse = [[s[1][1], -s[0][1]], [-s[1][0], s[0][0]]]
    exact_gain = [[sum(a[k][i] * inverse[k][j] for k in range(2)) / determinant for j in range(2)] for i in range(2)]
    item = hg.kalman_filter(hg.LinearPlant(np.eye(2), 0.0, [0.0, 0.0], 1.0), hg.LinearSensor(h, noise))
    gain = [np.asarray(item.estimate(item.correct(item.init(), z)[0]).mean) for z in np.eye(2)]
    np.testing.assert_allclose(np.transpose(gain), np.array(exact_gain, dtype=float), rtol=1e-10)


@pytest.mark.parametrize("outputs", [1, 2])
@pytest.mark.parametrize("seed", range(4))
def test_noise_free_outputs_of_states_that_are_tied_together(outputs, seed):
    """x = v a with one unknown a: the first output tells it, and what stays unknown is the rounding of z and of x.

    Four eps of what z is made of, through the gain v / (h v): at most a hundred eps of |I - K H| |v|, and no less than
    the error, which is of the same size.
    """
    random = np.random.default_rng(seed)
    v, h = random.normal(size=3), random.normal(size=(outputs, 3))
    plant = hg.LinearPlant(np.eye(3), 0.0, np.zeros(3), np.outer(v, v))
    item = hg.kalman_filter(plant, hg.LinearSensor(h, np.zeros((outputs, outputs))))
    estimate = item.estimate(item.correct(item.predict(item.init()), h @ v / (h[0] @ v))[0])
    error, claimed = np.abs(estimate.mean - v / (h[0] @ v)), np.sqrt(np.diagonal(estimate.covariance))
    left = np.abs(np.eye(3) - np.outer(v / (h[0] @ v), h[0])) @ np.abs(v)
    assert np.all(claimed <= 100 * np.finfo(float).eps * left) and np.all(error <= 30 * claimed)


def test_what_noise_that_ties_states_hides_stays_unknown():
    """One noise drives both states, the first is seen: what is unknown of the second falls by 1e-6 a step, unstopped.

    From the third step on Q has no digit of it. Taken for nothing, it left a filter that no longer corrects: of three
    states and two outputs its error was 900 where P was 2e-22.
    """
    a, noise = [[0.5, 1.0], [0.0625, 0.126]], [[1.0, 0.125], [0.125, 0.015625]]
    expected = exact(a, noise, 0.0, [[1.0, 0.0], [0.0, 1.0]])
    assert expected[-1, 1] < 1e-22
    plant = hg.LinearPlant(a, noise, [0.0, 0.0], 1.0)
    result = claimed(hg.kalman_filter(plant, hg.LinearSensor(C, 0.0)))[:, 1]
    assert np.all((result >= 0.95 * expected[:, 1]) & (result <= 1.05 * expected[:, 1] + 1e-13))


def test_a_state_that_is_known_stays_known_where_its_motion_enlarges_rounding():
    """One noise drives three states, two outputs tell it: the rounding that it does not reach grows 2.4 times a step.

    Left out where P says that nothing is unknown, it was 3e11 after 100 steps. A few roundings of states of size 1e3.
    """
    a = [[0.2804, -0.2573, -0.8358], [-0.4267, -0.9307, 0.0564], [1.2578, -0.4619, -0.5823]]
    v, w = np.array([0.457644, 1.901210, 1.289533]), np.array([2.9424e-2, 9.2502e-4, -2.1988e-2])
    plant = hg.LinearPlant(a, np.outer(w, w), [-0.2351, -1.2674, 0.2713], np.outer(v, v))
    sensor, channel = (
        hg.LinearSensor([[0.157, -0.187, -2.517], [-0.539, -0.049, 0.113]], np.zeros((2, 2))),
        hg.perfect(2),
    )
    items = {"k": hg.kalman_filter(plant, sensor), "l": hg.linear_filter(plant, sensor, channel)}
    record = hg.monte_carlo(hg.Network(plant, {"a": hg.Node(sensor, channel, items)}), 100, 20, 1)
    for name in items:
        assert np.abs(record.errors("a", name)).max() < 1e-13 * np.abs(record.truth).max()


def test_an_output_that_says_what_others_said_is_left_out():
    """Three outputs of one state and one noise behind one gain of .5 or 1: the third is what the first two say.

    What is left of its row is rounding, (n + 2) eps of |T| |H|, and a few more of T: used, it made 9e-3 of the squared
    error at the eleventh step, of which 2.6e-10 is exact. 300 runs, within six standard errors.
    """
    law, noise = hg.Discrete([0.5, 1.0], [0.5, 0.5]), np.array([0.37349699, 2.73958026, -0.11445523])
    plant = hg.LinearPlant([[-0.5]], 0.0, [511.844], 0.0011)
    sensor = hg.LinearSensor([[1.023], [-0.882], [2.652]], np.outer(noise, noise))
    channel = hg.hop(law, 0.0, dimension=3)
    node = hg.Node(sensor, channel, {"f": hg.linear_filter(plant, sensor, channel)})
    record = hg.monte_carlo(hg.Network(plant, {"a": node}), 12, 300, 14)
    squared = record.errors("a", "f")[..., 0] ** 2
    claimed = record.estimates["a"]["f"].covariance[0, :, 0, 0]
    deviation = squared.std(axis=0) / np.sqrt(300)
    assert np.all(np.abs(squared.mean(axis=0) - claimed) < 6 * deviation)


def test_more_precise_outputs_than_are_unrolled():
    """P+ = (1 + H'H / d)^-1 and K = P+ H' / d, for a prior of 1: both well conditioned, whatever d."""
    h, d = np.random.default_rng(0).normal(size=(9, 3)), 1e-14
    item = hg.kalman_filter(hg.LinearPlant(np.eye(3), 0.0, np.zeros(3), 1.0), hg.LinearSensor(h, d * np.eye(9)))
    z = np.arange(9.0)
    estimate = item.estimate(item.correct(item.init(), z)[0])
    left = d * np.linalg.inv(d * np.eye(3) + h.T @ h)
    np.testing.assert_allclose(estimate.covariance, left, rtol=1e-9, atol=1e-12 * left.max())
    np.testing.assert_allclose(estimate.mean, left @ h.T @ z / d, rtol=1e-9)


def test_a_noise_free_output_has_a_gradient():
    """dx/dP of x = P z / (P + 0) is 0, and of the state that is not received too."""

    def mean(wide):
        plant = hg.LinearPlant(A, 0.0, [0.0, 0.0], wide * jnp.eye(2))
        item = hg.linear_filter(plant, hg.LinearSensor(C, 0.0), hg.perfect(1))
        return item.correct(item.init(), jnp.ones(1))[0].gaussian.mean.sum()

    with jax.enable_x64(True):
        assert float(jax.jit(jax.grad(mean))(2.0)) == pytest.approx(0.0, abs=1e-15)


@pytest.mark.parametrize(
    ("channel", "left"), [(hg.perfect(1), 1e-28), (hg.hop(hg.Discrete([0.5, 1.0], [0.5, 0.5]), 1e-9), 1.0)]
)
def test_a_premise_about_the_mean_is_not_used_where_the_law_is_known(channel, left):
    """Then nothing hangs on it: the same numbers, and of a noise-free reading no rounding of the prior either."""
    plant, sensor = hg.LinearPlant([[-1.2]], 1e-5, [-7e-4], 5e-6), hg.LinearSensor([[-6.5e-3]], 0.0)
    results = []
    for update in (None, hg.filters.ZeroMean()):
        item = hg.cubature_filter(plant, sensor, channel, update)
        results.append(item.estimate(item.correct(item.predict(item.init()), [4e-6])[0]))
    np.testing.assert_array_equal(results[0].mean, results[1].mean)
    np.testing.assert_array_equal(results[0].covariance, results[1].covariance)
    assert 0 <= results[1].covariance[0, 0] < left * (1.2**2 * 5e-6 + 1e-5)  # of the prediction


@pytest.mark.parametrize(
    ("noise", "combined"), [([[1.0, 1.0], [1.0, 1.0]], [-1.0, 1.0]), ([[0.1, 0.3], [0.3, 0.9]], [3.0, -1.0])]
)
def test_a_combination_free_of_noise_is_known(noise, combined):
    """z_2 - z_1 = x, or 3 z_1 - z_2 = x: the state is known to the rounding of z, and no less than nothing.

    That is 4 eps of the signal's deviation and of the noise's, in each output. Of what is smoothed too. The error is a
    few roundings of states of size 5.
    """
    rounded = 4 * np.finfo(float).eps * (np.array([1.0, 2.0]) * np.sqrt(3.0) + np.sqrt(np.diag(noise)))
    most = np.square(combined) @ rounded**2
    plant, sensor = hg.LinearPlant([[0.9]], 0.16, [0.0], 3.0), hg.LinearSensor([[1.0], [2.0]], noise)
    items = {"linear": hg.linear_filter(plant, sensor, hg.perfect(2)), "kalman": hg.kalman_filter(plant, sensor)}
    network = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(2), items)})
    outcome = hg.monte_carlo(network, horizon=15, runs=20, key=1, smooth=hg.smoothing.FixedInterval())
    for record in (outcome, outcome.smoothed):
        assert record.failures() == []
        for name, estimate in record.estimates["a"].items():
            assert estimate.claim == "exact"
            assert np.all(estimate.covariance >= 0) and np.all(estimate.covariance < most)
            assert np.abs(record.errors("a", name)).max() < 1e-14


def test_where_noise_is_none_a_little_more_of_it_is_known_to_matter():
    """d P+ / d N at N = 0 of a combination without noise, against a difference of second order in 1e-5: 1e-4."""
    plant = hg.LinearPlant([[0.9]], 0.16, [0.0], 3.0)

    def variance(n):
        noise = jnp.array([[1.0, 1.0], [1.0, 1.0]]) + n * jnp.diag(jnp.array([0.0, 1.0]))
        item = hg.linear_filter(plant, hg.LinearSensor([[1.0], [2.0]], noise), hg.perfect(2))
        return item.correct(item.predict(item.init()), jnp.zeros(2))[0].gaussian.covariance[0, 0]

    with jax.enable_x64(True):
        with_slope = jax.jit(jax.value_and_grad(variance))
        slope, more = with_slope(0.0)[1], with_slope(1e-5)[0]
        np.testing.assert_allclose(slope, more / 1e-5, rtol=1e-4)


@pytest.mark.slow
def test_data_without_noise_leave_a_variance_above_the_rounding_of_the_mean():
    """Of a state that moves and is seen without noise the claim covers what rounding leaves, smoothed too.

    So do those of every filter of mean and covariance: squared errors are a few units of rounding, squared.
    """
    plant = hg.LinearPlant([[0.9]], 0.0, [0.0], 1.034)
    sensor, channel = hg.LinearSensor([[0.349], [-0.639]], np.zeros((2, 2))), hg.perfect(2)
    items = {
        "linear": hg.linear_filter(plant, sensor, channel),
        "kalman": hg.kalman_filter(plant, sensor),
        "cubature": hg.cubature_filter(plant, sensor, channel),
    }
    for smoothing in (hg.smoothing.FixedInterval(), hg.smoothing.FixedLag(3)):
        record = hg.monte_carlo(hg.Network(plant, {"a": hg.Node(sensor, channel, items)}), 12, 200, 1, smooth=smoothing)
        for part in (record, record.smoothed):
            for name, estimate in part.estimates["a"].items():
                squared = (estimate.mean - record.truth) ** 2
                assert (squared.mean(axis=0)[:, 0] <= np.reshape(estimate.covariance, (-1, 12))[0]).all(), name
                assert squared.max() < 1e-30 and estimate.covariance.max() < 1e-29


@pytest.mark.parametrize("make", [hg.kalman_filter, lambda p, s: hg.linear_filter(p, s, hg.perfect())])
def test_the_covariance_of_an_unstable_plant_held_by_its_inputs_stays(make):
    """P- = a^2 P + q and P = P- r / (P- + r) have the positive root of a^2 P^2 + (r - a^2 r + q) P - q r = 0.

    The moments before any data of such a plant are inf after 1950 steps: 1.2^(2 k).
    """
    a, q, r = 1.2, 0.1, 0.1
    plant = hg.LinearPlant([[a]], q, [0.0], 1.0, input_matrix=[[1.0]])
    item = make(plant, hg.LinearSensor([[1.0]], r))
    moved = follow(item, np.zeros((2200, 1)), np.zeros((2200, 1)))
    expected = np.roots([a**2, r - a**2 * r + q, -q * r]).max()
    np.testing.assert_allclose(moved.covariance[[100, 1000, 2199], 0, 0], expected, rtol=1e-12)
    assert all(np.isfinite(leaf).all() for leaf in jax.tree.leaves(moved.state))


def test_behind_a_random_gain_far_from_zero_a_combination_that_says_nothing_is_left_out():
    """Three outputs of two states are tied and so is the noise of the random gain, of which 1e-6 is not along the mean.

    What the elimination leaves of the tied combination, 1e-11 of the outputs, is no measurement without noise.
    """
    matrix = np.array([[2.5, 0.8], [0.25, -0.65], [1.4, -0.5]])
    plant = hg.LinearPlant(np.eye(2), 0.0, [1400.0, -50.0], 1.0)
    item = hg.linear_filter(plant, hg.LinearSensor(matrix, 0.0), hg.dropout(hg.perfect(3), 0.7))
    state, _ = item.correct(item.predict(item.init()), np.zeros(3))
    np.testing.assert_allclose(state.gaussian.covariance, exact_after_dropout(matrix, [1400, -50], 7), rtol=1e-6)


def exact_after_dropout(matrix, mean, tenths):
    """P+ of x with Cov x = I and z = g C x, P(g = 1) = tenths / 10: C^+ z = g x says what z does. In fractions."""
    p = Fraction(tenths, 10)
    a, b = (Fraction(x) for x in mean)
    # S = p^2 I + p (1 - p) (I + m m'), P+ = I - p^2 S^-1.
    s = [[p + p * (1 - p) * a * a, p * (1 - p) * a * b], [p * (1 - p) * a * b, p + p * (1 - p) * b * b]]
    det = s[0][0] * s[1][1] - s[0][1] ** 2
    inverse = [[s[1][1] / det, -s[0][1] / det], [-s[0][1] / det, s[0][0] / det]]
    return [[float(int(i == j) - p * p * inverse[i][j]) for j in range(2)] for i in range(2)]


def updated(x, rows, variances):
    """Gain, and x given what rows (m, n) with uncorrelated noises of these variances show of it."""
    noise = WeightedColumns(np.eye(len(rows)), jnp.asarray(variances))
    ways = jax.vmap(lambda z: condition_on_observation(x, rows @ x.root, z, noise)[0])(jnp.eye(len(rows)))
    return ways.mean.T, jax.tree.map(lambda leaf: leaf[0], ways)


def test_noise_counts_next_to_a_precise_output():
    """A prior twenty decades above: K is judged by (I - K H) P (I - K H)' + K R K' in exact fractions.

    What K leaves is what P+ says, to a quarter; all other digits of 1 - K H are gone.
    """
    numbers = [7.06384807e10, 0.0145333, 0.0114123, 5.1867e-23, 9.2411e-14]
    prior, first, second, noise, other = numbers
    for swap in (False, True):
        rows, variances = np.array([[first], [second]]), np.diag([noise, other])
        order = [1, 0] if swap else [0, 1]
        rows, variances = rows[order], variances[np.ix_(order, order)]
        with jax.enable_x64(True):
            gain, after = jax.jit(updated)(from_covariance(np.zeros(1), np.array([[prior]])), rows, np.diag(variances))
        k, h = [Fraction(float(x)) for x in gain[0]], [Fraction(float(x)) for x in rows[:, 0]]
        left = 1 - sum(a * b for a, b in zip(k, h, strict=True))
        of_noise = sum(a * a * Fraction(float(v)) for a, v in zip(k, np.diag(variances), strict=True))
        assert float(left**2 * Fraction(prior) + of_noise) == pytest.approx(float(after.covariance[0, 0]), rel=0.25)


def test_a_random_gain_of_noise_that_outputs_share_leaves_a_tenth():
    """z = G (H x + v), G 1/2 or 1, of v one combination of z is free, in which x is 1e-8 beside a noise of size 1.

    No linear filter leaves less than 1 - E[G]^2 / E[G^2] = 1/10 of the variance, though rounding of E[z z'] is more.
    """
    plant = hg.LinearPlant([[-0.6966]], 0.0, [0.0], 2.94e-16)
    root = np.array([[1.2848], [0.4707]])
    sensor = hg.LinearSensor([[-0.5465], [1.5783]], root @ root.T)
    hop = hg.hop(hg.Discrete([0.5, 1.0], [0.5, 0.5]), 0.0, dimension=2)
    steps = follow(hg.linear_filter(plant, sensor, hop), [[0.77, 0.28]])
    assert steps.covariance[0, 0, 0] >= 0.1 * 0.6966**2 * 2.94e-16


def test_outputs_that_say_the_same_of_a_tied_state_say_it_once():
    """A state of large noise tied to one that two outputs without noise see: the second corrects by no rounding.

    Gains of 300 such pairs on the tied state, as the seen one moves it: the ratio of the noises, to rounding of 1e-6.
    """
    rng = np.random.default_rng(0)
    ties, seen = 10.0 ** rng.uniform(-4, 4, size=(2, 300)), 10.0 ** rng.uniform(-4, 4, size=(2, 300))
    each = jax.jit(jax.vmap(lambda x, shown, noise: updated(x, jnp.stack([0 * shown, shown], axis=1), noise)[0]))
    with jax.enable_x64(True):
        state = Gaussian(np.zeros((300, 2)), (ties[1] / ties[0])[:, None], np.stack([ties[0] ** 2, 0 * ties[0]], 1))
        gain = each(state, seen.T, (1e-14 * seen * ties[1]).T ** 2)
    np.testing.assert_allclose(np.einsum("bio,ob->ib", gain, seen), ties / ties[1], rtol=1e-6)


def test_the_rounding_of_a_state_that_starts_at_zero_is_that_of_its_noise():
    """Known to be 0 at first, then moved by noise of deviation 1e3 and seen without noise: known to 4 eps of 1e3."""
    plant = hg.LinearPlant([[0.5]], 1e6, [0.0], 0.0)
    for item in (
        hg.kalman_filter(plant, hg.LinearSensor([[3.0]], 0.0)),
        hg.cubature_filter(plant, hg.LinearSensor([[3.0]], 0.0)),
    ):
        steps = follow(item, [[3e3], [1e3]])
        np.testing.assert_allclose(steps.covariance[:, 0, 0], (4 * np.finfo(float).eps * 1e3) ** 2, rtol=1e-9)
