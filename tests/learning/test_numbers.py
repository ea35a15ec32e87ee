"""Climbing, intervals and ridges on functions whose answers are known; nothing is compiled."""

import numpy as np
import pytest
from scipy import optimize

import heliograph as hg
from heliograph.learning.likelihood.trust_region import maximise_from_starts
from heliograph.learning.long_run_covariance import (
    bootstrap_block_sums,
    estimate_by_bartlett,
    estimate_by_cosines,
    estimate_if_white,
    find_numbers_in_few_stretches,
    remove_predicted_scores,
)
from heliograph.learning.unidentified_directions import (
    find_confounded,
    find_information_rank,
    format_product,
    format_sum,
)

RNG = np.random.default_rng(0)


def residuals(x):
    """Of the curve a exp(-b t) at 30 times, (lanes, 30), with derivatives (lanes, 30, 2)."""
    t = np.linspace(0.0, 3.0, 30)
    seen = 2.0 * np.exp(-0.7 * t) + 0.1 * np.random.default_rng(1).normal(size=30)
    curve = np.exp(x[:, :1] - np.exp(x[:, 1:]) * t)
    slope = np.stack([curve, -curve * np.exp(x[:, 1:]) * t], axis=2)
    return seen - curve, slope


def evaluate(x):
    r, slope = residuals(x)
    information = np.einsum("lti,ltj->lij", slope, slope)
    return -np.sum(r**2, axis=1) / 2, np.einsum("lt,lti->li", r, slope), information


def test_the_climb_ends_where_another_package_ends():
    start = np.array([[0.0, 0.0], [1.0, 1.0], [-1.0, -2.0]])
    result = maximise_from_starts(evaluate, start)
    theirs = optimize.least_squares(lambda x: residuals(x[None])[0][0], start[0], xtol=1e-15, ftol=1e-15, gtol=1e-15)
    assert result.converged.all()
    np.testing.assert_allclose(result.x, np.repeat(theirs.x[None], 3, axis=0), atol=1e-7)


def test_what_does_not_move_stays_and_the_impossible_is_given_up():
    fixed = maximise_from_starts(evaluate, np.array([[0.0, 0.3]]), np.array([[True, False]]))
    assert fixed.converged[0] and fixed.x[0, 1] == 0.3
    assert abs(evaluate(fixed.x)[1][0, 0]) < 1e-6
    impossible = maximise_from_starts(
        lambda x: (np.full(len(x), -np.inf), 0 * x, np.zeros((len(x), 2, 2))), np.zeros((1, 2))
    )
    assert not impossible.converged[0]


def test_long_run_covariances_of_an_autoregression():
    """s_t = .5 s_(t-1) + e_t has the long-run variance 1 / .25 = 4, and 4/3 at each step."""
    steps, runs = 20_000, 3
    scores = []
    for _ in range(runs):
        s, e = np.zeros(steps), RNG.normal(size=steps)
        for t in range(1, steps):
            s[t] = 0.5 * s[t - 1] + e[t]
        scores.append(s[:, None])
    whole = runs * steps
    spread = 4 * 4 * np.sqrt(2 / (runs * 0.4 * steps ** (2 / 3)))  # four standard errors
    assert estimate_by_cosines(scores).covariance[0, 0] / whole == pytest.approx(4.0, abs=spread)
    assert estimate_if_white(scores).covariance[0, 0] / whole == pytest.approx(4 / 3, rel=0.05)
    assert (
        3.2 < estimate_by_bartlett(scores).covariance[0, 0] / whole < 4.2
    )  # its weights take off lag / (L + 1), L = 13
    drawn = bootstrap_block_sums(scores, 2000, 0)
    assert np.var(drawn) / whole == pytest.approx(4.0, rel=0.2)
    assert estimate_by_cosines(scores[:1]).freedom == int(0.4 * steps ** (2 / 3))
    assert estimate_by_cosines(scores).freedom == pytest.approx(3 * int(0.4 * steps ** (2 / 3)))


def parameters(*kinds):
    """Free numbers of these kinds that start at 1/2, with nothing that depends on them."""

    def build():
        for name, kind in zip("abcdefg", kinds, strict=False):
            hg.free(0.5, name, kind)
        plant, sensor = hg.state_space([[0.9]], [[1.0]], 1.0, 1.0, [0.0], 1.0)
        return hg.Network(plant, {"node": hg.Node(sensor, hg.perfect(), {})})

    return hg.learning.describe(build).parameters


def informed(known, parameters, points):
    """Ranks of the information of what is identified, functions of the values, at points of the line."""
    ranks = []
    for x in points:
        values, turned = parameters.entries_at(x), parameters.jacobian(x)
        step = 1e-6 * np.eye(len(values))
        rows = np.stack([(known(values + h) - known(values - h)) / 2e-6 for h in step], axis=1) @ turned
        ranks.append(find_information_rank(rows.T @ rows + 0.0))
    return ranks


def groups_of(known, *kinds):
    local = parameters(*kinds)
    points = [np.random.default_rng(i).uniform(0.3, 1.0, len(kinds)) for i in range(3)]
    with np.errstate(all="ignore"):
        return find_confounded(local, points, informed(known, local, points))


def test_a_product_is_found_and_put_in_words():
    (group,) = groups_of(lambda v: np.array([v[0] * v[1], v[2]]), "real", "positive", "positive")
    assert group.coordinates == (0, 1) and group.fix == 1
    assert format_product(["a", "b"], group.exponents[0]) == "a * b"


def test_a_power_and_a_sum():
    (group,) = groups_of(lambda v: np.array([v[0] ** 2 * v[1]]), "real", "positive")
    assert format_product(["a", "b"], group.exponents[0]) == "a^2 * b"
    (group,) = groups_of(lambda v: np.array([0.5 * v[0] + v[1]]), "positive", "positive")
    assert not len(group.exponents)
    assert format_sum(["a", "b"], group.weights[0]) == "a + 2 b"


def test_two_ridges_apart_one_that_is_neither_and_nothing_at_all():
    first, second = groups_of(lambda v: np.array([v[0] * v[1], v[2] / v[3]]), *("positive",) * 4)
    assert (first.coordinates, second.coordinates) == ((0, 1), (2, 3))
    assert format_product(["c", "d"], second.exponents[0]) == "c / d"
    (group,) = groups_of(lambda v: np.array([v[0] * v[1] + v[2]]), *("positive",) * 3)
    assert group.fix == 2 and not len(group.exponents) and not len(group.weights)
    (group,) = groups_of(lambda v: np.array([v[0], 0 * v[1]]), *("positive",) * 2)
    assert group.coordinates == (1,) and group.fix == 1
    assert groups_of(lambda v: v, *("positive",) * 3) == []


def test_a_step_is_told_of_by_few_rows_and_a_mean_by_all():
    """Of 100 rows: all at one, all alike, as a chi-square tells, and in the second half."""
    step, half = (np.arange(100) == 50).astype(float), (np.arange(100) >= 50).astype(float)
    columns = [step, np.ones(100), np.random.default_rng(0).normal(size=100) ** 2, half]
    assert find_numbers_in_few_stretches([np.stack(columns, axis=1)]).tolist() == [True, False, False, False]
    assert not find_numbers_in_few_stretches([np.ones((40, 1)), np.ones((60, 1))]).any()


def test_of_a_true_model_the_parts_of_scores_add_up_to_its_information():
    """s = L e, e white: of s - H_.K H_KK^-1 s_K and of what the model says of the rest the sum is H = L L'."""
    lower = np.array([[1.0, 0.0, 0.0], [0.7, 1.2, 0.0], [-0.4, 0.3, 0.8]])
    rows = np.linalg.qr(np.random.default_rng(1).normal(size=(50, 3)))[0] @ lower.T
    rest, known = remove_predicted_scores([rows], lower @ lower.T, np.array([False, True, False]))
    np.testing.assert_allclose(estimate_if_white(rest).covariance + known, lower @ lower.T, atol=1e-14)
    np.testing.assert_allclose(rest[0][:, 1], 0.0, atol=1e-15)
