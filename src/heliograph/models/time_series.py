"""Components of a time series: level, trend, season, cycle and ARMA, each a plant and what of it is seen."""

from collections.abc import Sequence
from typing import Any

import equinox as eqx
import numpy as np

from heliograph.model.diffuse_start import DiffuseStart
from heliograph.model.plant import LinearPlant
from heliograph.models.motion import WIDE
from heliograph.numerics.check import array, check_count, fail, instance, items, name_list, scalar, text
from heliograph.numerics.module import Module, readable
from heliograph.numerics.numpy_or_jax import block_diagonal, is_traced, library
from heliograph.numerics.types import Array, ArrayLike, Float, Names

STATIONARY = 1 - 1e-9  # largest modulus of a root that still counts as stationary


@readable
class Component(Module):
    """A part of a time series: a plant, and the combination of its states that is the part.

    Args:
        name: of the part.
        plant: how its states move.
        loading: weights of the states (n,).
        inputs: of a regression, the input of the plant by which the weight of each state is multiplied, n names; none
            by default.

    Raises:
        ValueError: no name, no linear plant, another number of weights, an input that the plant does not have.
    """

    name: str
    plant: LinearPlant
    loading: Array
    inputs: tuple[str, ...] = eqx.field(static=True)

    def __init__(self, name: str, plant: LinearPlant, loading: "Float[ArrayLike, ' n']", inputs: Sequence[str] = ()):
        """Check and hold a component of a series: `loading` @ (states of the plant).

        `inputs`: for a regression, the input by which each state's weight is multiplied; none of all others.
        """
        self.name = text("name of a component", name)
        self.plant = instance("plant of a component", plant, LinearPlant, "a LinearPlant")
        self.loading = array("loading of a component", loading, (len(plant.states),))
        self.inputs = tuple(str(name) for name in items("inputs of a component", inputs, "names"))
        if self.inputs and (len(self.inputs) != len(self.loading) or set(self.inputs) - set(plant.inputs)):
            expected = f"one of {list(plant.inputs)} for each of {len(self.loading)} states"
            raise fail("inputs of a component", expected, list(self.inputs))


def level(
    variance: "Float[ArrayLike, '']",
    initial_mean: "Float[ArrayLike, '']" = 0.0,
    initial_variance: "Float[ArrayLike, ''] | DiffuseStart" = WIDE,
    name: str = "level",
) -> Component:
    """Return a level that follows a random walk, as in the local level model.

    Args:
        variance: variance of a step of the level; 0 for a constant.
        initial_mean: mean before the first step; 0 by default.
        initial_variance: its variance, or `hg.diffuse` if it is unknown; 1e8 by default, so give more if data are
            larger than 1,000.
        name: name of the component and of its state; "level" by default.

    Raises:
        ValueError: a negative variance.

    Source: Harvey, Forecasting, structural time series models and the Kalman filter (1989), 2.1.
    """
    q = scalar("variance of the level", variance, 0.0)
    mean = scalar("initial mean", initial_mean)
    start = _read_initial_variance(initial_variance)
    plant = LinearPlant([[1.0]], q, library(mean).reshape(mean, (1,)), start, states=[name])
    return Component(name, plant, loading=[1.0])


def trend(
    level_variance: "Float[ArrayLike, '']",
    slope_variance: "Float[ArrayLike, '']",
    initial_mean: "Float[ArrayLike, '2']" = (0.0, 0.0),
    initial_variance: "Float[ArrayLike, ''] | DiffuseStart" = WIDE,
    name: str = "trend",
) -> Component:
    """Return a trend: a level that grows by a slope, both of which wander: the local linear trend.

    level+ = level + slope + w, slope+ = slope + s with white noises w and s. Its states are "level" and "slope", with
    "NAME_" before them where the name is another than "trend"; the series observes the level.

    Args:
        level_variance: variance of w; 0 for a smooth trend.
        slope_variance: variance of s; 0 for a slope that does not change.
        initial_mean: level and slope before the first step; 0 by default.
        initial_variance: of both, or `hg.diffuse`; 1e8 by default.
        name: of the component; "trend" by default.

    Raises:
        ValueError: a negative variance.

    Source: Harvey, Forecasting, structural time series models and the Kalman filter (1989), 2.3.
    """
    variances = [
        scalar("variance of the level", level_variance, 0.0),
        scalar("variance of the slope", slope_variance, 0.0),
    ]
    named = text("name of a component", name)
    prefix = "" if named == "trend" else f"{named}_"
    plant = LinearPlant(
        matrix=[[1.0, 1.0], [0.0, 1.0]],
        noise=_make_diagonal(variances),
        initial_mean=array("initial mean", initial_mean, (2,)),
        initial_covariance=_read_initial_variance(initial_variance),
        states=[f"{prefix}level", f"{prefix}slope"],
    )
    return Component(named, plant, loading=[1.0, 0.0])


def seasonal(
    period: int,
    variance: "Float[ArrayLike, '']",
    initial_variance: "Float[ArrayLike, ''] | DiffuseStart" = WIDE,
    name: str = "season",
) -> Component:
    """Return a season of dummies: what it adds over a period sums to a noise, s+ = -(s + ... + s_(period-2) ago) + w.

    States: NAME, "NAME_1_ago", ..., period - 1 of them.

    Args:
        period: steps after which it returns, at least 2.
        variance: variance of w; 0 for a season that is always the same.
        initial_variance: variance of each state before the first step, or `hg.diffuse`; 1e8 by default.
        name: name of the component; "season" by default.

    Raises:
        ValueError: a period below 2, a negative variance.

    Source: Harvey, Forecasting, structural time series models and the Kalman filter (1989), 2.3.4.
    """
    n = check_count("period", period, 2) - 1
    q, start = scalar("variance of the season", variance, 0.0), _read_initial_variance(initial_variance)
    # The state holds the last n = period - 1 seasons: the first row is s+ = -(their sum) + w, the others move them on.
    matrix = np.eye(n, k=-1)
    matrix[0] = -1.0
    noise = _make_diagonal([q] + [0.0] * (n - 1))
    named = text("name of a component", name)
    states = [named, *(f"{named}_{i}_ago" for i in range(1, n))]
    return Component(named, LinearPlant(matrix, noise, np.zeros(n), start, states=states), np.eye(n)[0])


def trigonometric_seasonal(
    period: float,
    variance: "Float[ArrayLike, '']",
    harmonics: int | None = None,
    initial_variance: "Float[ArrayLike, ''] | DiffuseStart" = WIDE,
    name: str = "season",
) -> Component:
    """Return a season as a sum of waves of period, period / 2, ..., each of which wanders.

    Each wave turns by 2 pi j / period a step, and gains a noise of the same variance in both of its states,
    "NAME_j" and "NAME_j_shifted"; of period 2 there is the first alone.

    Args:
        period: steps after which it returns, at least 2; it need not be whole.
        variance: variance of each wave's noise.
        harmonics: number of waves; by default all that differ at whole steps.
        initial_variance: variance of each state before the first step, or `hg.diffuse`; 1e8 by default.
        name: name of the component; "season" by default.

    Raises:
        ValueError: a period below 2, more waves than differ, a negative variance.

    Source: Harvey, Forecasting, structural time series models and the Kalman filter (1989), 2.3.4.
    """
    # A wave of less than two steps looks at whole steps like a longer one.
    length = float(scalar("period", period, 2.0))
    most = int(length // 2)
    count = most if harmonics is None else check_count("harmonics", harmonics)
    if not 1 <= count <= most:
        raise fail("harmonics", f"from 1 to {most}, which differ at whole steps", count)
    # For each wave a block of the plant's matrix, its two states, and the weight of each state in the observed sum.
    q, start = scalar("variance of the season", variance, 0.0), _read_initial_variance(initial_variance)
    named = text("name of a component", name)
    blocks, states, loading = [], [], []
    for j in range(1, count + 1):
        if 2 * j == length:  # cos(pi t), of which the shifted wave is 0: one state
            blocks.append(np.array([[-1.0]]))
            states.append(f"{named}_{j}")
            loading.append(1.0)
        else:
            blocks.append(_make_rotation(2 * np.pi * j / length))
            states += [f"{named}_{j}", f"{named}_{j}_shifted"]
            loading += [1.0, 0.0]
    plant = LinearPlant(block_diagonal(blocks), q, np.zeros(len(states)), start, states=states)
    return Component(named, plant, loading)


def cycle(
    period: "Float[ArrayLike, '']",
    damping: "Float[ArrayLike, '']",
    variance: "Float[ArrayLike, '']",
    name: str = "cycle",
) -> Component:
    """Return a stochastic cycle: a damped wave that noise keeps going, stationary from the start.

    Its variance is variance / (1 - damping^2) at all times. Its states are NAME and "NAME_shifted".

    Args:
        period: steps in a turn, at least 2.
        damping: factor of each step, from 0 to below 1 (at 1 use a `trigonometric_seasonal` of one harmonic).
        variance: variance of the noise in each of the two states.
        name: name of the component; "cycle" by default.

    Raises:
        ValueError: a period below 2, a damping of 1 or more, a negative variance.

    Source: Harvey, Forecasting, structural time series models and the Kalman filter (1989), 2.3.3.
    """
    length, q = scalar("period", period, 2.0), scalar("variance of the cycle", variance, 0.0)
    factor = scalar("damping", damping, 0.0, STATIONARY)
    name = text("name of a component", name)
    matrix = factor * _make_rotation(2 * np.pi / length)
    # x+ = damping (rotation) x + w has the variance v = damping^2 v + q.
    stationary_variance = q / (1 - factor**2)
    plant = LinearPlant(matrix, q, np.zeros(2), stationary_variance, states=[name, f"{name}_shifted"])
    return Component(name, plant, loading=[1.0, 0.0])


def arma(
    ar: "Float[ArrayLike, ' p']",
    ma: "Float[ArrayLike, ' q']",
    variance: "Float[ArrayLike, '']",
    name: str = "arma",
) -> Component:
    """Return an ARMA process y = ar_1 y_1ago + ... + e + ma_1 e_1ago + ..., stationary from the start.

    The plant's states are the present value, NAME, and the parts of later ones that are known now, "NAME_1_ahead", ...

    Args:
        ar: coefficients of past values (p,); to estimate them take `stationary(x)` of free x.
        ma: coefficients of past noises (q,).
        variance: variance of the noise e.
        name: name of the component; "arma" by default.

    Raises:
        ValueError: coefficients that are not stationary, a negative variance.

    Source: Harvey, Forecasting, structural time series models and the Kalman filter (1989), 3.3 and 4.1.3.
    """
    # Harvey's state: the present value, and the known parts of later ones. F = [phi, [I; 0]]: the first column has the
    # autoregression's coefficients, the others move each part one place up.
    phi, theta = array("ar", ar, (None,)), array("ma", ma, (None,))
    q = scalar("variance of the noise", variance, 0.0)
    size = max(len(phi), len(theta) + 1)
    xp = library(phi, theta, q)
    first = xp.concatenate([phi, np.zeros(size - len(phi))])
    matrix = xp.concatenate([first[:, None], np.eye(size)[:, :-1]], axis=1)
    if not is_traced(matrix) and np.max(np.abs(np.linalg.eigvals(matrix))) > STATIONARY:
        raise fail("ar", "coefficients of a stationary process, all roots inside the circle", phi.tolist())
    # e enters the present value, and with the coefficients of the moving average the later ones.
    enters = xp.concatenate([np.ones(1), theta, np.zeros(size - 1 - len(theta))])
    noise = q * xp.outer(enters, enters)
    named = text("name of a component", name)
    states = [named, *(f"{named}_{i}_ahead" for i in range(1, size))]
    plant = LinearPlant(matrix, noise, np.zeros(size), stationary_covariance(matrix, noise), states=states)
    return Component(named, plant, np.eye(size)[0])


def regression(
    regressors: Names,
    variance: "Float[ArrayLike, '']" = 0.0,
    initial_variance: "Float[ArrayLike, ''] | DiffuseStart" = WIDE,
    name: str = "regression",
) -> Component:
    """Return a regression on inputs: y = sum of coefficient times input, and the coefficients may wander.

    The inputs are those of the model; states are "INPUT_coefficient". For an intercept add a `level` of variance 0.

    Args:
        regressors: names of the inputs.
        variance: variance of each coefficient's step; 0 by default: constants.
        initial_variance: variance of each coefficient before the first step, or `hg.diffuse`; 1e8 by default.
        name: name of the component; "regression" by default.

    Raises:
        ValueError: no regressors, a negative variance.

    Source: Harvey, Forecasting, structural time series models and the Kalman filter (1989), 7.7.
    """
    inputs = name_list("regressors", regressors)
    if not inputs:
        raise fail("regressors", "at least one name", "none")
    n = len(inputs)
    q, start = scalar("variance of the coefficients", variance, 0.0), _read_initial_variance(initial_variance)
    states = [f"{regressor}_coefficient" for regressor in inputs]
    # Coefficients are random walks, which the inputs do not move; they enter as factors in y, with the weights 1.
    plant = LinearPlant(np.eye(n), q, np.zeros(n), start, np.zeros((n, n)), states, inputs)
    return Component(name, plant, np.ones(n), inputs)


def stationary(x: "Float[ArrayLike, ' p']") -> Any:
    """Return the coefficients of a stationary autoregression from real numbers x, one to one.

    The partial autocorrelations are x / sqrt(1 + x^2), and Durbin and Levinson's recursion makes coefficients of them.
    With the opposite sign they are coefficients of an invertible moving average.

    Args:
        x: any numbers (p,), such as free ones of a fit.

    Raises:
        ValueError: x is no array of numbers.

    Source: Monahan, A note on enforcing stationarity in autoregressive-moving average models (1984).
    """
    numbers = array("x", x, (None,))
    xp = library(numbers)
    partial = numbers / xp.sqrt(1 + numbers**2)
    coefficients = partial[:0]  # order 0 has no coefficients
    for k in range(len(partial)):
        # phi_k+1,j = phi_k,j - r phi_k,k+1-j for j <= k, and the new one, r, the partial autocorrelation of this order.
        coefficients = xp.concatenate([coefficients - partial[k] * coefficients[::-1], partial[k : k + 1]])
    return coefficients


def stationary_covariance(matrix: Any, noise: Any) -> Any:
    """Return the stationary covariance P = F P F' + Q, with F = `matrix` and Q = `noise`.

    It solves the linear equations (I - F kron F) vec P = vec Q.
    """
    xp, n = library(matrix, noise), len(matrix)
    equations = np.eye(n * n) - xp.kron(matrix, matrix)
    vec_P = xp.linalg.solve(equations, xp.reshape(noise, (n * n,)))
    P = xp.reshape(vec_P, (n, n))
    return (P + P.T) / 2


def _read_initial_variance(variance: "ArrayLike | DiffuseStart") -> Any:
    """Return the variance of states before the first step as a number, or `hg.diffuse`, where nothing is known.

    Raises:
        ValueError: a negative variance.
    """
    return variance if isinstance(variance, DiffuseStart) else scalar("initial variance", variance, 0.0)


def _make_rotation(angle: Any) -> Any:
    """Return the matrix [[cos, sin], [-sin, cos]] that turns a wave's pair of states by an angle in radians."""
    xp = library(angle)
    c, s = xp.cos(angle), xp.sin(angle)
    return xp.stack([xp.stack([c, s]), xp.stack([-s, c])])


def _make_diagonal(variances: list[Any]) -> Any:
    """Return the diagonal matrix of variances, of NumPy's or, where some are traced by JAX, of JAX's arrays."""
    xp = library(variances)
    return xp.diag(xp.stack([xp.asarray(value) for value in variances]))
