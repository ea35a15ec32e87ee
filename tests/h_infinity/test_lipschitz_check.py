"""A growth constant: refuted by its own evidence, proved by intervals, or said to be assumed."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.h_infinity import certify_level, check_growth
from heliograph.h_infinity.interval_arithmetic import ARITHMETIC, Interval, bound_program
from heliograph.h_infinity.slope_bounds import prove_slope_bound

REFUTED = {
    "a slope above it": (lambda x: 0.5 * x + jnp.array([1e-5 * jnp.sin(1e5 * x[0])]), 0.7, "slope 1.5"),
    "no number": (lambda x: jnp.where(x > 0.9, jnp.nan, 3 * x), 0.7, "is false"),
    "no number far out": (lambda x: jnp.where(x > 0.9, jnp.nan, 0.1 * x), 0.7, "is false"),
    "not zero at zero": (lambda x: 0.5 * x + 1, 0.7, "f(0) has the norm 1, not 0"),
}


@pytest.mark.parametrize("name", REFUTED)
def test_local_evidence_refutes(name):
    function, constant, text = REFUTED[name]
    result = check_growth(function, constant, [-1.0], [1.0])
    assert result.refuted and not result.proved
    assert text in result.text


@pytest.mark.parametrize(("low", "high"), [(-0.5, 0.9), (0.2, 0.7), (-3.0, -1.0)])
def test_one_less_a_square_holds_every_sample(low, high):
    """JAX 0.12 writes a slope of tanh so; earlier releases never do."""
    result = ARITHMETIC["one_minus_square"](Interval(np.array(low), np.array(high)))
    points = np.linspace(low, high, 1001)
    assert result.low <= np.min(1 - points**2) and np.max(1 - points**2) <= result.high
    nearest, farthest = (0.0 if low < 0 < high else min(abs(low), abs(high))), max(abs(low), abs(high))
    np.testing.assert_allclose((result.low, result.high), (1 - farthest**2, 1 - nearest**2), rtol=1e-14, atol=1e-15)


SMOOTH = {
    "linear": (lambda x: jnp.array([[0.6, -0.8], [0.8, 0.6]]) @ x, 1.0),
    "pendulum": (lambda x: jnp.stack([x[0] + 0.1 * x[1], x[1] - 0.1 * jnp.sin(x[0]) - 0.05 * jnp.tanh(x[1])]), 1.2),
    "rational": (lambda x: x[0] ** 3 / (1 + x[1] ** 2) + x[1] * jnp.exp(-(x[0] ** 2)) / 4, 4.0),
    "kinks": (lambda x: 0.5 * jnp.abs(x) - 0.3 * jnp.maximum(x, 0.2) + 0.06, 0.9),
    "roots": (lambda x: jnp.sqrt(2 + x) - 2**0.5 + jnp.log(1 + x**2) / 4 + jax.nn.sigmoid(x) - 0.5, 1.2),
    "reductions": (lambda x: jnp.sum(jnp.concatenate([x, x[::-1]])) * 0.2 + x @ x / 10 + jnp.cos(x[0]) - 1, 2.5),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", SMOOTH)
def test_a_true_constant_is_proved_and_no_sample_exceeds_the_bound(name):
    function, constant = SMOOTH[name]
    result = check_growth(function, constant, [-1.0, -1.0], [1.0, 1.0])
    assert result.proved and "is proved in the box" in result.text
    points = np.random.default_rng(0).uniform(-1, 1, size=(4000, 2))
    with jax.enable_x64(True):
        slopes = np.asarray(jax.jit(jax.vmap(jax.jacfwd(lambda x: jnp.atleast_1d(function(x)))))(points))
    assert np.linalg.norm(slopes, 2, axis=(1, 2)).max() <= result.bound <= result.limit
    false = check_growth(function, 0.9 * np.linalg.norm(slopes, 2, axis=(1, 2)).max(), [-1.0, -1.0], [1.0, 1.0])
    assert false.refuted


def test_values_are_inside_their_intervals():
    """Every operation that is followed, at random boxes and random points in them."""
    operations = [
        lambda x: x[0] * x[1] - x[1] / (3 + x[0]),
        lambda x: jnp.sin(x) + jnp.cos(3 * x) * jnp.tanh(x),
        lambda x: jnp.exp(-x) + jnp.log(4 + x) + jnp.sqrt(4 + x) + jnp.log1p(x**2) + jnp.expm1(x) + jnp.arctan(x),
        lambda x: jnp.maximum(x, 0.3) - jnp.minimum(x[0], x[1]) + jnp.abs(x) + x**4 - x**3 + 1 / (x + 4) ** 2,
        lambda x: jnp.where(x > 100, 1.0, x) @ jnp.arange(4.0).reshape(2, 2) + jnp.square(x) + jax.lax.rsqrt(x + 4),
        lambda x: jnp.concatenate([x, -x]).reshape(2, 2).T[0] + jnp.stack([x, x]).sum(axis=1),
    ]
    random = np.random.default_rng(1)
    with jax.enable_x64(True):
        for function in operations:
            jaxpr, values_ = jax.make_jaxpr(function)(jnp.zeros(2)), jax.jit(jax.vmap(jax.vmap(function)))
            for width in (0.0, 0.1, 3.0):
                middle = random.uniform(-1.5, 1.5, size=(20, 2))
                lows, highs = np.maximum(middle - width, -3), np.minimum(middle + width, 3)
                sampled = np.asarray(values_(random.uniform(lows, highs, size=(50, 20, 2))))
                for low, high, values in zip(lows, highs, np.moveaxis(sampled, 1, 0), strict=True):
                    (result,) = bound_program(jaxpr, [Interval(low, high)], continuous=True)
                    assert np.all(values >= result.low) and np.all(values <= result.high)


@pytest.mark.parametrize(
    ("function", "reason"),
    [
        (lambda x: jnp.where(x > 0.2, x, 0.0) / 2, "a decision that depends on where"),
        (lambda x: jnp.sign(x) * 0.1 * x, "a decision that depends on where"),
        (lambda x: jax.scipy.special.erf(x) / 4, "erf"),
    ],
    ids=["a jump", "a sign", "an operation"],
)
def test_what_cannot_be_followed_is_assumed_and_says_so(function, reason):
    result = prove_slope_bound(function, np.array([-1.0]), np.array([1.0]), 1.0)
    assert result.value == np.inf and reason in result.reason


def test_a_stopped_slope_proves_nothing():
    def spike(x):
        return 0.5 * x + 0.4 * jax.lax.stop_gradient(jnp.exp(-(((x - 0.3) / 1e-12) ** 2)))

    finding = check_growth(spike, 0.5, [-1.0], [1.0])
    assert not finding.refuted and not finding.proved and "a slope that is stopped" in finding.text
    assert prove_slope_bound(lambda x: x * jax.lax.stop_gradient(2.0), -np.ones(1), np.ones(1), 2.0).value <= 2 + 1e-9


@pytest.mark.parametrize(
    ("function", "got"),
    [
        (lambda x: np.sin(x), "one that calls NumPy or math"),
        (lambda x: x if x[0] > 0 else -x, "one that decides by a value"),
        (lambda x: None, "got TypeError"),
        (lambda x, y: x, "missing 1 required positional argument"),
        (lambda x: x[None], "got 2 axes"),
    ],
)
def test_a_function_that_cannot_be_traced_is_refused_in_one_line(function, got):
    with pytest.raises(ValueError, match=r"function: expected one of the state in operations of jax\.numpy") as raised:
        check_growth(function, 1.0, [-1.0], [1.0])
    assert got in str(raised.value) and "\n" not in str(raised.value)


def growing(constant, of_output=0.0):
    system = hg.h_infinity.growth_system(
        6, [[0.1]], [[0.2]], [[1.0]], hg.hop(1.0, 0.01), constant, of_output, output=[[1.0]], initial_weight=5.0
    )
    return system, hg.h_infinity.horizon_design(system)


@pytest.mark.slow
def test_a_certificate_says_what_it_rests_on_and_refuses_what_does_not_fit():
    system, design = growing(0.7)
    parts = design.gains, design.weights, design.multipliers, design.level

    def certificate(*growth):
        return certify_level(system, *parts, growth)

    alone = certificate()
    assert alone.certified and len(alone.assumed) == 2 and "assumed: |f(x)| <= a |x| with a = 0.7" in alone.text
    proof = check_growth(lambda x: 0.7 * jnp.sin(x), 0.7, [-5.0], [5.0])
    assert certificate(proof).certified and not certificate(proof).assumed and "proved" in certificate(proof).text
    assert not proof._replace(bound=None).proved and certificate(proof._replace(bound=None)).assumed
    smaller = check_growth(lambda x: 0.6 * jnp.sin(x), 0.6, [-5.0], [5.0])
    assert certificate(smaller).certified and not certificate(smaller).assumed
    other = certificate(check_growth(lambda x: 0.8 * jnp.sin(x), 0.8, [-5.0], [5.0]))
    assert not other.certified and "the constant 0.8, the system has 0.7" in other.text
    false = certificate(check_growth(lambda x: 0.5 * x + 1, 0.7, [-5.0], [5.0]))
    assert not false.certified and "f(0)" in false.text
    only_size = certificate(check_growth(lambda x: 0.7 * jnp.sin(x), 0.7, [-5.0], [5.0], differences=False))
    assert only_size.certified and not only_size.assumed  # its slopes are bounded as well
    # f grows by 100 between 0 and a box, in which its slopes are small: differences alone are proved.
    step = check_growth(lambda x: jnp.clip(100 * x, 0, 0.9) + 0.1 * jnp.maximum(x - 1, 0), 0.7, [1.0], [2.0])
    assert step.proved and certificate(step).assumed == ("|f(x)| <= a |x| with a = 0.7",)


def test_a_finding_is_about_one_function():
    system, design = growing(0.5, 0.2)
    parts = design.gains, design.weights, design.multipliers, design.level
    of_f = check_growth(lambda x: 0.5 * jnp.sin(x), 0.5, [-5.0], [5.0])
    of_h = check_growth(lambda x: 0.2 * jnp.sin(x), 0.2, [-5.0], [5.0], name="h")
    assert all("h(x)" in what for what in certify_level(system, *parts, [of_f]).assumed)
    assert all("f(x)" in what for what in certify_level(system, *parts, output_growth=[of_h]).assumed)
    both = certify_level(system, *parts, [of_f], [of_h])
    assert both.certified and not both.assumed and both.growth == (of_f, of_h)
    assert not certify_level(system, *parts, output_growth=[of_f]).certified  # .5 is more than h is given


@pytest.mark.slow
def test_weights_that_are_not_symmetric_are_refused():
    system = hg.h_infinity.growth_system(
        1, np.zeros((2, 1)), [[0.0]], np.eye(2), hg.hop(1.0, 0.1), 0.0, transition=0.1 * np.eye(2)
    )
    first = np.diag([0.5, 0.5, 1.08, 1.08])
    first[2, 3] = 2.0
    weights = np.stack([first, 1e-3 * np.eye(4)])
    with pytest.raises(ValueError, match="weights: expected a symmetric matrix"):
        certify_level(system, np.zeros((1, 2, 1)), weights, np.zeros((1, 2)), 1.06)
    tiny = np.kron(np.eye(2), np.array([[1e-9, 1e-9], [0.0, 2e-9]]))
    with pytest.raises(ValueError, match="initial weight: expected a symmetric matrix"):
        hg.h_infinity.growth_system(
            1, np.zeros((2, 1)), [[0.0]], np.eye(2), hg.hop(1.0, 0.1), 0.0, transition=0.1 * np.eye(2),
            initial_weight=tiny,
        )  # fmt: skip
