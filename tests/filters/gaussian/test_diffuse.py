"""A start that nobody knows: the Nile's log-likelihood, least squares in fractions, and what is refused."""

import warnings
from fractions import Fraction
from functools import cache
from math import log, pi

import numpy as np
import pytest

import heliograph as hg

NILE = np.array([
    1120, 1160, 963, 1210, 1160, 1160, 813, 1230, 1370, 1140, 995, 935, 1110, 994, 1020, 960, 1180, 799, 958,
    1140, 1100, 1210, 1150, 1250, 1260, 1220, 1030, 1100, 774, 840, 874, 694, 940, 833, 701, 916, 692, 1020,
    1050, 969, 831, 726, 456, 824, 702, 1120, 1100, 832, 764, 821, 768, 845, 864, 862, 698, 845, 744, 796, 1040,
    759, 781, 865, 845, 944, 984, 897, 822, 1010, 771, 676, 649, 846, 812, 742, 801, 1040, 860, 874, 848, 890,
    744, 749, 838, 1050, 918, 986, 797, 923, 975, 815, 1020, 906, 901, 1170, 912, 746, 919, 718, 714, 740,
], float)  # fmt: skip


def test_the_niles_log_likelihood_is_that_of_kfas_and_of_statsmodels_by_the_formula():
    level = hg.LinearPlant([[1.0]], 1469.1, [0.0], hg.diffuse)
    likelihood = hg.kalman_filter(level, hg.LinearSensor([[1.0]], 15099.0)).run(NILE).log_likelihood
    np.testing.assert_allclose(likelihood, -632.545625, atol=1e-6)  # as published, to its digits
    np.testing.assert_allclose(likelihood - log(2 * pi) / 2, -633.464564, atol=1e-6)  # statsmodels, q = 1


TREND, SEASON = np.array([[1.0, 1.0], [0.0, 1.0]]), np.array([[-1.0, -1.0, -1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]])
MEMORY, HUNDREDS = np.array([[1.0, 0.5, 0.0], [0.0, 1.0, 0.3], [0.0, 0.0, 0.6]]), NILE / 100
GAPS, PAIRS = HUNDREDS[:12, None].copy(), np.stack([HUNDREDS[:10], HUNDREDS[10:20]], axis=1)
GAPS[[0, 3, 4]] = PAIRS[2] = PAIRS[1, 0] = PAIRS[5, 1] = np.nan
LEVEL_AND_SEASON = np.block([[TREND, np.zeros((2, 3))], [np.zeros((3, 2)), SEASON]])
OF_STATSMODELS = {  # F, H, Q, R, how many states nobody knows, the variance of one more, data: its number
    "trend": (TREND, [[1, 0]], np.diag([0.5, 0.1]), [[2]], 2, [], GAPS, -19.765399308678962),
    "damped trend": (
        [[1, 1], [0, 0.8]], [[1, 0]], [[0.5, 0.1], [0.1, 0.1]], [[2]], 2, [], HUNDREDS[:15, None], -29.15691805198216,
    ),
    "level and season": (
        LEVEL_AND_SEASON, [[1, 0, 1, 0, 0]], np.diag([0.5, 0.01, 0.2, 0, 0]), [[1]], 5, [], HUNDREDS[:20, None],
        -37.14821707919782,
    ),
    "beside a known state": (
        MEMORY, [[1, 0, 1]], np.diag([0.1, 0.2, 0.5]), [[1.5]], 2, [0.5 / 0.64], HUNDREDS[:15, None],
        -28.987700633236262,
    ),
    "two outputs": (
        MEMORY, [[1, 0, 1], [0.5, 1, 0]], np.diag([0.1, 0.2, 0.5]), [[1.5, 0.4], [0.4, 1]], 2, [0.5 / 0.64], PAIRS,
        -58.671572136724606,
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", OF_STATSMODELS)
def test_the_log_likelihood_is_that_of_statsmodels_by_the_formula(name):
    """Less half of log 2 pi for each of q states, and one step later: by |det F| of what is unknown, dx_1 for dx_0."""
    F, H, Q, R, unknown, known, z, number = OF_STATSMODELS[name]
    names = [f"s{i}" for i in range(len(F))]
    start = hg.diffuse(names[:unknown], np.diag([0.0] * unknown + known))
    plant = hg.LinearPlant(F, Q, np.zeros(len(F)), start, states=names)
    ours = hg.kalman_filter(plant, hg.LinearSensor(H, R)).run(z).log_likelihood
    scale = log(abs(np.linalg.det(np.array(F)[:unknown, :unknown])))
    # statsmodels 0.15.0 with an exact diffuse start of x_1: both round to 1e-14.
    np.testing.assert_allclose(ours - unknown / 2 * log(2 * pi) + scale, number, atol=1e-8)


def exact(values):
    """Return fractions near these numbers, of one denominator, so that those computed of them stay short."""
    return np.array([[Fraction(round(v * 1024), 1024) for v in row] for row in np.atleast_2d(values)], dtype=object)


def solve(a, b):
    """a^-1 b and det a, by elimination in fractions."""
    rows, n, det = np.concatenate([a, b], axis=1), len(a), Fraction(1)
    for i in range(n):
        pivot = next(j for j in range(i, n) if rows[j, i] != 0)
        if pivot != i:
            rows[[i, pivot]], det = rows[[pivot, i]], -det
        det *= rows[i, i]
        rows[i] = rows[i] / rows[i, i]
        for j in range(n):
            if j != i:
                rows[j] = rows[j] - rows[j, i] * rows[i]
    return rows[:, n:], det


def log_of(x):
    return log(x.numerator) - log(x.denominator)


def least_squares(f, h, q, r, known, unknown, mean, z):
    """Mean and covariance of each state given all rows, and the log of the integral of p(z | delta) d delta."""
    steps, eye = len(z), exact(np.eye(len(f)))
    powers = [eye]
    for _ in range(steps):
        powers.append(f @ powers[-1])

    @cache
    def cov(a, b):
        total = powers[a] @ known @ powers[b].T
        for j in range(1, min(a, b) + 1):
            total = total + powers[a - j] @ q @ powers[b - j].T
        return total

    rows = [(k, i) for k in range(steps) for i in range(len(h)) if z[k][i] is not None]
    a = np.array([(h @ powers[k + 1])[i][unknown] for k, i in rows], dtype=object)
    y = np.array([[z[k][i] - (h @ powers[k + 1] @ mean)[i, 0]] for k, i in rows], dtype=object)
    s = np.array([[(h @ cov(k + 1, t + 1) @ h.T)[i, j] + (r[i, j] if k == t else 0) for t, j in rows]
                  for k, i in rows], dtype=object)  # fmt: skip
    solved, size = solve(s, np.concatenate([a, y], axis=1))
    count = a.shape[1]
    inverse, gram = solve(a.T @ solved[:, :count], exact(np.eye(count)))
    delta = inverse @ (a.T @ solved[:, count:])
    left = solved[:, count:] - solved[:, :count] @ delta
    squares = ((y - a @ delta).T @ left)[0, 0]
    likelihood = -((len(rows) - count) * log(2 * pi) + log_of(size) + log_of(gram) + float(squares)) / 2
    results = []
    for k in range(1, steps + 1):
        cross = np.array([(cov(k, t + 1) @ h.T)[:, j] for t, j in rows], dtype=object).T
        enters = powers[k][:, unknown]
        shared = enters - cross @ solved[:, :count]
        told, _ = solve(s, cross.T)
        results.append((
            (powers[k] @ mean + enters @ delta + cross @ left)[:, 0].astype(float),
            (cov(k, k) - cross @ told + shared @ inverse @ shared.T).astype(float),
        ))  # fmt: skip
    return results, likelihood


def compare(seed):
    """Largest differences of a random system from least squares, relative: filtered, smoothed, log-likelihood."""
    draw = np.random.default_rng(seed)
    n, m = int(draw.integers(1, 4)), int(draw.integers(1, 3))
    f, h = exact(draw.normal(size=(n, n))), exact(draw.normal(size=(m, n)))
    half, other, third = (
        exact(draw.normal(size=(n, 1))),
        exact(draw.normal(size=(m, m))),
        exact(draw.normal(size=(n, n))),
    )
    q, r = half @ half.T, other @ other.T + exact(np.eye(m))
    unknown = draw.random(n) < 0.7
    unknown[draw.integers(n)] = True
    known = third @ third.T
    known[unknown, :], known[:, unknown] = Fraction(0), Fraction(0)
    mean, steps = exact(draw.normal(size=(n, 1))), n + 2
    z = exact(draw.normal(size=(steps, m)) * 3)
    z[draw.random((steps, m)) < 0.15] = None
    as_float = [matrix.astype(float) for matrix in (f, h, q, r, known)]
    names = [f"s{i}" for i in range(n)]
    start = hg.diffuse([name for name, far in zip(names, unknown, strict=True) if far], as_float[4])
    plant = hg.LinearPlant(as_float[0], as_float[2], mean[:, 0].astype(float), start, states=names)
    filter = hg.kalman_filter(plant, hg.LinearSensor(as_float[1], as_float[3]))
    data = z.astype(float)
    filtered = filter.run(data)
    if not np.isfinite(filtered.covariances[-1]).all():  # some direction was never measured
        return np.zeros(3)
    states, likelihood = least_squares(f, h, q, r, known, unknown, mean, z)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # numbers of no plant: innovations are not what the filter believes
        smoothed = hg.rts_smoother(filter, data)

    def apart(got, expected):
        return max(np.abs(g - e).max() / max(1.0, np.abs(e).max()) for g, e in zip(got, expected, strict=True))

    last = apart((filtered.means[-1], filtered.covariances[-1]), states[-1])
    whole = max(apart((smoothed.means[k], smoothed.covariances[k]), states[k]) for k in range(steps))
    return np.array([last, whole, abs(filtered.log_likelihood - likelihood) / max(1.0, abs(likelihood))])


def test_a_few_random_systems_are_least_squares():
    """To 1e-9 relative: the filter rounds, the fractions do not."""
    assert max(compare(seed).max() for seed in range(3)) < 1e-9


@pytest.mark.slow
def test_two_hundred_random_systems_are_least_squares():
    assert max(compare(seed).max() for seed in range(200)) < 1e-9


def test_what_was_not_measured_is_infinite_with_nothing_beside_it():
    plant = hg.LinearPlant([[1.0, 1.0], [0.0, 1.0]], 0.01, [0.0, 0.0], hg.diffuse, states=["at", "speed"])
    result = hg.kalman_filter(plant, hg.LinearSensor([[1.0, 0.0]], 1.0)).run([[1.0], [2.0], [np.nan], [4.0]])
    np.testing.assert_allclose(result.covariances[0], np.diag([1.0, np.inf]), atol=1e-12)
    assert np.isfinite(result.covariances[1:]).all()
    assert np.isnan(result.innovations[:2]).all()


def test_named_states_are_unknown_and_the_others_as_given():
    plant = hg.LinearPlant(np.eye(2), 0.0, [3.0, 0.0], hg.diffuse(["b"], 4.0), states=["a", "b"])
    result = hg.kalman_filter(plant, hg.LinearSensor(np.eye(2), np.eye(2))).run([[5.0, 7.0]])
    np.testing.assert_allclose(result.means[0], [3.0 + 2.0 * 4 / 5, 7.0], atol=1e-12)
    np.testing.assert_allclose(result.covariances[0], np.diag([0.8, 1.0]), atol=1e-12)


@pytest.mark.slow
def test_noises_are_learned_from_an_unknown_start():
    """The published maximum of the Nile's likelihood, to the digits in which it is flat."""

    def build():
        level, sensor = (hg.LinearPlant([[1.0]], hg.free(1000.0, "q"), [0.0], hg.diffuse),
                         hg.LinearSensor([[1.0]], hg.free(10000.0, "r")))  # fmt: skip
        return hg.Network(level, {"a": hg.Node(sensor, hg.perfect(1), {"f": hg.kalman_filter(level, sensor)})})

    found = [row.estimate for row in hg.fit(build, {"a": NILE[:, None]}).rows()]
    np.testing.assert_allclose(found, [1469.1, 15099.0], rtol=2e-2)


PLANT, SENSOR = hg.LinearPlant([[1.0]], 1.0, [0.0], hg.diffuse), hg.LinearSensor([[1.0]], 1.0)


@pytest.mark.parametrize(
    ("build", "said"),
    [
        (lambda: hg.linear_filter(PLANT, SENSOR, hg.hop(hg.Rayleigh(1.0), 0.1)), "a known law of x_0 here"),
        (lambda: hg.cubature_filter(PLANT, SENSOR, hg.perfect(1)), "a known law of x_0 here"),
        (lambda: hg.filters.imm_filter(PLANT, SENSOR, hg.gilbert_elliott(hg.perfect(1), hg.hop(1.0, 9.0), 0.1, 0.2)),
         "a known law of x_0 here"),
        (lambda: hg.filters.particle_filter(PLANT, SENSOR, hg.perfect(1)), "a known law of x_0 here"),
        (lambda: hg.simulate(hg.Network(PLANT, {"a": hg.Node(SENSOR, hg.perfect(1),
            {"f": hg.kalman_filter(PLANT, SENSOR)})}), 3, 0), "a known law of x_0 here"),
        (lambda: hg.Plant(lambda x, u: x, 1.0, [0.0], hg.diffuse), "of a plant that is not linear"),
        (lambda: hg.LinearPlant([[1.0]], 1.0, [0.0], hg.diffuse(["no"])), "some of"),
        (lambda: hg.kalman_filter(PLANT, SENSOR, initial_covariance=[[1.0]]), "none beside a plant"),
    ],
)  # fmt: skip
def test_what_cannot_take_an_unknown_start_says_so_in_one_line(build, said):
    with pytest.raises(ValueError, match=said) as error:
        build()
    assert "\n" not in str(error.value)


def test_what_was_told_of_an_unknown_direction_is_not_told_again_by_rounding():
    """Two sensors that show one sum of two unknown states: one direction is learned, and the other has no number.

    s_inf = 1.4^2 (.81^2 + .37^2) of the first sensor; the second is of the mean 1.67 / 1.4 times its value.
    """
    plant = hg.LinearPlant([[1.44, -0.63], [-0.81, -0.37]], np.zeros((2, 2)), [0.0, 0.0], hg.diffuse)
    both = hg.LinearSensor([[0.0, -1.4], [0.0, -1.67]], np.diag([0.1, 1.0]))
    found = hg.kalman_filter(plant, both).run([[1.0, 2.0]])
    information = 1.4**2 / 0.1 + 1.67**2
    expected = [[np.inf, 0.0], [0.0, 1 / information]]
    np.testing.assert_allclose(found.covariances[0], expected, rtol=1e-12)
    ratio = 1.67 / 1.4
    variance, error = 1 + ratio**2 * 0.1, 2 - ratio
    log_likelihood = (
        -np.log(1.4**2 * (0.81**2 + 0.37**2)) / 2 - (error**2 / variance + np.log(2 * np.pi * variance)) / 2
    )
    assert found.log_likelihoods[0] == pytest.approx(log_likelihood, rel=1e-12)


def test_a_state_that_was_measured_is_known_beside_one_that_was_not():
    plant = hg.LinearPlant([[-0.48, -0.35], [0.66, 0.14]], np.zeros((2, 2)), [0.0, 0.0], hg.diffuse)
    found = hg.kalman_filter(plant, hg.LinearSensor([[0.0, 0.6]], 0.1)).run([[1.0]])
    np.testing.assert_allclose(found.covariances[0], [[np.inf, 0.0], [0.0, 0.1 / 0.36]], rtol=1e-12)


def test_an_unknown_level_that_cancels_in_a_prediction_is_not_left_there():
    """x2+ = x0 - 3 x1 with x0 = 3 x1 unknown in thirds and tenths: known to be 0, though .3 - 3 x .1 is not."""
    move = [[0.3, 0.0, 0.0], [0.1, 0.0, 0.0], [1.0, -3.0, 0.0]]
    plant = hg.LinearPlant(
        move, np.diag([0.0, 0.0, 0.2]), np.zeros(3), hg.diffuse(["x0"], 0.0), states=["x0", "x1", "x2"]
    )
    found = hg.kalman_filter(plant, hg.LinearSensor([[0.0, 0.0, 1.0]], 0.1)).run([[np.nan], [np.nan], [0.5]])
    assert np.isinf(found.covariances[2, 0, 0])
    assert found.covariances[2, 2, 2] == pytest.approx(1 / (1 / 0.2 + 1 / 0.1), rel=1e-12)


def test_a_noise_free_sensor_of_an_unknown_state_leaves_what_it_does_not_hear():
    """It hears x0 alone: x1, which is known before with the variance 1, gains 1/2 a step."""
    plant = hg.LinearPlant(np.eye(2), np.diag([0.0, 0.5]), np.zeros(2), hg.diffuse(["x0"], known=np.diag([0.0, 1.0])))
    found = hg.kalman_filter(plant, hg.LinearSensor([[1.0, 0.0]], 0.0)).run([[0.3], [0.3]])
    np.testing.assert_allclose(found.covariances, [np.diag([0.0, 1.5]), np.diag([0.0, 2.0])], rtol=1e-12, atol=1e-25)
