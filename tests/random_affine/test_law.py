import jax
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import integrate, optimize
from scipy import stats as laws

import heliograph as hg
from heliograph.random_affine.laws.law import Discrete
from tests.draws import draw

CONTINUOUS = {
    "rayleigh": (hg.Rayleigh(0.7), laws.rayleigh(scale=0.7)),
    "rician": (hg.random_affine.Rician(1.5, 0.4), laws.rice(1.5 / 0.4, scale=0.4)),
    "nakagami": (hg.random_affine.Nakagami(1.7, 2.0), laws.nakagami(1.7, scale=np.sqrt(2.0))),
    "log-normal": (hg.random_affine.LogNormal(-0.2, 0.3), laws.lognorm(0.3, scale=np.exp(-0.2))),
}


@pytest.mark.parametrize("name", CONTINUOUS)
@pytest.mark.parametrize("order", [1, 2, 3, 4])
def test_moments_are_integrals_of_the_density(name, order):
    ours, density = CONTINUOUS[name]
    value, _ = integrate.quad(lambda g: g**order * density.pdf(g), 0, 60, limit=400, points=[0.5, 1, 2, 4])
    assert ours.moment(order) == pytest.approx(value, rel=1e-7)  # quad's own accuracy


@pytest.mark.parametrize("name", CONTINUOUS)
def test_samples_follow_the_distribution_function(name):
    ours, density = CONTINUOUS[name]
    drawn = draw(ours.sample, 5000, seed=3)
    assert laws.kstest(drawn, density.cdf).pvalue > 1e-4  # one draw in 10,000 would fail by chance; the seed is fixed


@st.composite
def uncertain_laws(draw):
    n = draw(st.integers(2, 5))
    weights = np.array(draw(st.lists(st.floats(0.05, 1), min_size=n, max_size=n)))
    p = weights / weights.sum()
    radius = np.array(draw(st.lists(st.floats(0, 0.3), min_size=n, max_size=n))) * np.maximum(p, 1 - p)
    values = np.array(draw(st.lists(st.floats(-2, 2), min_size=n, max_size=n)))
    return values, p, radius


@given(uncertain_laws(), st.integers(1, 4))
def test_worst_case_is_the_linear_programme(given_law, order):
    law = Discrete(*given_law)
    payoff = law.values**order
    low, high = np.maximum(law.probabilities - law.radius, 0), np.minimum(law.probabilities + law.radius, 1)
    # The sum of the probabilities may be off by what the solver calls feasible, 1e-7 by default.
    best = optimize.linprog(-payoff, A_eq=np.ones((1, len(payoff))), b_eq=[1], bounds=list(zip(low, high, strict=True)),
                            options={"primal_feasibility_tolerance": 1e-10})  # fmt: skip
    assert law.worst(payoff) == pytest.approx(-best.fun, abs=1e-8)  # the solver's own tolerance


@given(uncertain_laws(), st.integers(1, 4))
def test_corners_attain_the_worst_case_and_stay_inside(given_law, order):
    law = Discrete(*given_law)
    corners = law.extremes()
    payoff = law.values**order
    # A probability of a corner may lie beyond its end by 1e-12, which another one lacks then.
    allowed = 2e-12 * max(1.0, np.abs(payoff).max())
    assert max(c.moment(order) for c in corners) == pytest.approx(law.worst(payoff), abs=allowed)
    for corner in corners:
        assert np.all(np.abs(corner.probabilities - law.probabilities) <= law.radius + 1e-12)
        assert corner.probabilities.sum() == pytest.approx(1, abs=1e-12)


@pytest.mark.parametrize("radius", [[5e-13, 2.4e-54], [1e-15, 0.1]])
def test_the_corners_of_an_almost_known_law_are_almost_it(radius):
    corners = Discrete([0.0, 2.0], [0.5, 0.5], radius).extremes()
    assert all(np.abs(corner.probabilities - 0.5).max() <= min(radius) + 1e-12 for corner in corners)


def test_a_known_law_is_its_own_corner():
    assert len(Discrete([0.5, 1.0], [0.4, 0.6]).extremes()) == 1


def test_one_uncertain_probability_alone_cannot_move():
    (only,) = Discrete([0.5, 1.0], [0.4, 0.6], [0.1, 0.0]).extremes()
    assert np.array_equal(only.probabilities, [0.4, 0.6])


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Discrete([1, 2], [0.5, 0.6]), "sum to 1, got .* with sum 1.1"),
        (lambda: Discrete([1, 2], [-0.5, 1.5]), "no negative probability"),
        (lambda: Discrete([1, 2, 3], [0.5, 0.5]), r"shape \(3\), got shape \(2,\)"),
        (lambda: Discrete([1, 2], [0.5, 0.5], 0.6), "what its probability allows"),
        (lambda: Discrete([1, np.nan], [0.5, 0.5]), "finite numbers"),
        (lambda: hg.random_affine.bernoulli(1.2), "from 0 to 1, got 1.2"),
        (lambda: hg.random_affine.GivenMoments([1.0, 0.5]), "which none has"),
        (lambda: hg.random_affine.Nakagami(0.2), "Nakagami shape"),
    ],
)
def test_impossible_laws_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()


def test_given_moments_design_but_do_not_sample():
    law = hg.random_affine.GivenMoments([1.0, 1.2])
    assert law.moment(2) == 1.2
    with pytest.raises(ValueError, match="law that can be sampled"):
        law.sample(jax.random.key(0))
    with pytest.raises(ValueError, match="moments up to order 3"):
        law.moment(3)
