"""A search for the maximum says that it converged where it did, from far away, in any units, with variances at zero."""

import importlib
from pathlib import Path
from types import ModuleType

import jax
import numpy as np
import pytest

import heliograph as hg
from heliograph.learning.likelihood.trust_region import maximise_from_starts
from heliograph.learning.likelihood.trust_region_step import trust_region_step

NATS = 1e-3  # below another search
FOLDER = Path(__file__).resolve().parents[2] / "benchmarks"


@pytest.fixture
def fits(monkeypatch: pytest.MonkeyPatch) -> ModuleType:
    """benchmarks/fits.py, imported as it is when run."""
    monkeypatch.syspath_prepend(FOLDER)
    return importlib.import_module("fits")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "seed"),
    [
        ("level", 0),
        ("constant", 0),
        ("walk", 1),
        ("trend", 0),
        ("line", 0),
        ("line", 1),
        ("autoregression", 1),
        ("alternation", 1),
        ("gauss_markov", 0),
        ("mean", 0),
        ("shift", 1),
        ("bias", 1),
    ],
)
def test_it_ends_where_a_search_from_the_truth_ends_or_higher(fits, name, seed):
    one = fits.case(name, seed)
    found = fits.fitted(one)
    with jax.enable_x64(True):
        best = fits.reference(one, fits.likelihood(one.family), 2, seed)
    assert found.converged and found.best.total > best - NATS


def trend(start, units=1.0):
    noise = hg.random_affine.Independent([hg.Gaussian([[hg.free(start, name)]]) for name in ("level", "slope")])
    plant = hg.LinearPlant([[1.0, 1.0], [0.0, 1.0]], noise, [0.0, 0.0], 1e4 * units**2 * np.eye(2))
    return hg.Network(plant, {"a": hg.Node(hg.LinearSensor([[1.0, 0.0]], hg.free(start, "r")), hg.perfect(), {})})


LINE = 0.3 * np.arange(150) + np.random.default_rng(3).standard_normal(150)


@pytest.mark.parametrize("start", [1e-9, 1.0, 1e3, 1e6])
def test_a_start_far_away_gets_there(start):
    """By Nelder and Mead on a plain recursion: -240.242, with both variances of the plant at 0."""
    found = hg.fit(lambda: trend(start), LINE[:, None], starts=1)
    assert found.converged and found.best.total == pytest.approx(-240.242, abs=NATS)
    assert found.values["level"] == found.values["slope"] == 0
    level, slope, noise = found.rows()
    assert level.boundary and slope.boundary and not noise.boundary
    assert level.interval == "below 0.0057" and noise.low < 1.15 < noise.high
    assert "level: 0, below 0.0057 (95 %)." in found.sentences


def test_units_do_not_matter():
    """Of data a thousand million times as large, from the same starts: log-likelihoods differ by n log 1e9."""
    found = hg.fit(lambda: trend(1.0, 1e9), 1e9 * LINE[:, None], starts=1)
    assert found.best.total == pytest.approx(-240.242 - 150 * np.log(1e9), abs=NATS) and found.converged


def shifted(first):
    """A level whose step at one time is free."""
    plant = hg.LinearPlant([[1.0]], hg.free(1.0, "q"), [0.0], 1e4, [[hg.free(first, "shift", "real")]])
    return hg.Network(plant, {"a": hg.Node(hg.LinearSensor([[1.0]], hg.free(1.0, "r")), hg.perfect(), {})})


@pytest.mark.parametrize("far", [-300.0, 400.0])
def test_a_level_shift_far_from_its_start_is_reached(far):
    """Its estimate is off by about the spread of a mean of some neighbours."""
    rng = np.random.default_rng(2)
    at = (np.arange(100) == 50).astype(float)
    z = np.cumsum(0.1 * rng.normal(size=100) + far * at) + rng.normal(size=100)
    found = hg.fit(lambda: shifted(0.0), z[:, None], at[:, None], starts=1)
    row = next(row for row in found.rows() if row.name == "shift")
    assert found.converged and abs(row.estimate - far) < 3 and row.low < far < row.high


@pytest.mark.slow
def test_data_that_are_reproduced_exactly_leave_no_variance():
    """Of an exact line the likelihood grows as all variances fall, to where rounding is all: 0, below some eps^2."""
    found = hg.fit(lambda: trend(1.0), 0.3 * np.arange(100.0)[:, None], starts=1)
    assert all(row.estimate == 0 and 0 < row.high < 1e-26 for row in found.rows())
    assert "level: 0, below" in found.sentences[1]
    assert not found.converged and "the likelihood grows for ever" in str(found)


def test_an_alternation_that_is_reproduced_exactly_has_no_maximum():
    """A climb ends where rounding is all that is left, which is no maximum of the likelihood."""

    def network():
        plant = hg.LinearPlant([[hg.free(0.5, "a")]], hg.free(1.0, "q"), [0.0], 1.0)
        return hg.Network(plant, {"a": hg.Node(hg.LinearSensor([[1.0]], hg.free(1.0, "r")), hg.perfect(), {})})

    found = hg.fit(network, (-1.0) ** np.arange(60)[:, None], starts=1)
    assert not found.converged and "the likelihood grows for ever" in str(found)


def test_a_variance_of_measuring_at_zero_has_an_end_above():
    """A walk that is measured without noise; the likelihood has derivatives near 0, not there."""
    walk = np.cumsum(np.random.default_rng(0).normal(size=150))

    def network():
        plant = hg.LinearPlant([[hg.free(0.5, "a")]], hg.free(1.0, "q"), [0.0], 1.0)
        return hg.Network(plant, {"a": hg.Node(hg.LinearSensor([[1.0]], hg.free(1.0, "r")), hg.perfect(), {})})

    found = hg.fit(network, walk[:, None], starts=1)
    row = found.rows()[2]
    assert found.converged and row.boundary and row.estimate == 0 and 0 < row.high < 0.2
    assert "at the end of its domain" not in str(found)  # intervals that were asked for
    assert str(found).count("below") == 2 and np.isfinite(found.covariance[:2, :2]).all()
    assert "\n" not in repr(found.best) and "log-likelihood" in repr(found.best)


def test_a_number_that_is_hardly_known_has_an_interval_down_to_zero():
    """Where the likelihood at 0 is lower by less than half of chi-square's 95 % point, 0 is in the interval."""
    rng = np.random.default_rng(7)
    z = np.cumsum(0.03 * rng.normal(size=120)) + rng.normal(size=120)

    def network():
        plant = hg.LinearPlant([[1.0]], hg.free(1.0, "q"), [0.0], 1e4)
        return hg.Network(plant, {"a": hg.Node(hg.LinearSensor([[1.0]], hg.free(1.0, "r")), hg.perfect(), {})})

    found = hg.fit(network, z[:, None], starts=1)
    q = found.rows()[0]
    assert q.low == 0 and q.high < 0.1 and q.boundary == (q.estimate == 0)


def test_steps_go_up_where_single_coordinates_would_turn_them():
    """A ridge at 45 degrees whose coordinates are a thousand standard errors from its top: l = -x' H x / 2."""
    curvature = np.array([[1.0, -0.999], [-0.999, 1.0]])

    def evaluate(x):
        return -np.einsum("li,ij,lj->l", x, curvature, x) / 2, -x @ curvature, np.repeat(curvature[None], len(x), 0)

    seen = []
    end = maximise_from_starts(evaluate, np.array([[-1000.0, 400.0]]), None, lambda now: seen.append(now.total[0]))
    assert end.converged.all() and np.all(np.diff(seen) >= 0) and end.total[0] > -1e-12


def two_tops(counts):
    """l = -50 ((x^2 - 1)^2 + (y - x)^2): tops of 0 at x = y = 1 and -1, a saddle between them; counts what is asked."""

    def evaluate(x):
        counts.append(len(x))
        a, b = x.T
        slope = np.stack([-200 * a * (a**2 - 1) + 100 * (b - a), -100 * (b - a)], axis=1)
        return (
            -50 * ((a**2 - 1) ** 2 + (b - a) ** 2),
            slope,
            np.repeat(np.array([[[500.0, -100], [-100, 100]]]), len(x), 0),
        )

    return evaluate


@pytest.mark.parametrize("joining", [False, True])
def test_climbs_before_one_top_are_climbed_by_one(joining):
    """Three climbs end at one top and one at the other; those that are left to another one are asked no more."""
    counts, starts = [], np.array([[2.0, 2.0], [0.6, 0.7], [1.1, 0.9], [-2.0, -1.0]])
    found = maximise_from_starts(two_tops(counts), starts, joining=joining)
    assert found.converged.all() and found.total == pytest.approx(0.0, abs=1e-12)
    np.testing.assert_allclose(found.x[:, 0], [1, 1, 1, -1], atol=1e-6)
    assert (len({tuple(x) for x in found.x}) == 2) == joining
    assert (sum(counts) < 30) == joining  # 27, and 33 of all on their own


def test_climbs_on_both_sides_of_a_saddle_stay_apart():
    """They are a hundredth of a standard error from each other, as high and flat, and end at different tops."""
    found = maximise_from_starts(two_tops([]), np.array([[1e-4, 1e-4], [-1e-4, -1e-4]]), joining=True)
    np.testing.assert_allclose(found.x[:, 0], [1, -1], atol=1e-6)


def test_a_gradient_that_the_information_overstates_is_climbed_to_the_end():
    """Information a thousand times too large: the model learns from its steps, which Fisher's scoring does not."""

    def evaluate(x):
        return -np.sum(x**2, axis=1) / 2, -x, np.repeat(1000 * np.eye(2)[None], len(x), 0)

    end = maximise_from_starts(evaluate, np.array([[3.0, -2.0]]))
    assert end.converged.all() and np.abs(end.x).max() < 1e-4 and end.steps < 50


def test_a_model_of_which_two_directions_are_one_to_the_last_digit_has_a_step():
    """B = 1e6 [1 1; 1 1] and g = (1, 1): of all p with B p = g the shortest is g / 2e6."""
    one, model = np.eye(2)[None], 1e6 * np.ones((1, 2, 2))
    everything = np.ones((1, 2), dtype=bool)
    step, length, predicted = trust_region_step(np.ones((1, 2)), one, model, np.ones(1), everything, everything[0])
    np.testing.assert_allclose(step, 5e-7, rtol=1e-6)
    assert length[0] == pytest.approx(5e-7 * np.sqrt(2)) and predicted[0] == pytest.approx(5e-7)


@pytest.mark.slow
def test_intervals_of_a_step_hold_it_as_often_as_they_say():
    """A level that steps once: of 200 intervals 190 hold the step (by scores alone 92); of 40 here at least 34."""
    at = (np.arange(100) == 50).astype(float)
    held = 0
    for i in range(40):
        rng = np.random.default_rng([i, 7])
        level = 10 * rng.normal() + np.cumsum(np.sqrt(0.1) * rng.normal(size=100) + 3 * at)
        found = hg.fit(lambda: shifted(0.0), (level + rng.normal(size=100))[:, None], at[:, None], starts=1)
        row = next(row for row in found.rows() if row.name == "shift")
        held += row.low < 3 < row.high
    assert held >= 34  # of a binomial law with 0.95, 38 +- 1.4
