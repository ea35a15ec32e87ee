"""System of state and estimation error of an H-infinity design: matrices, growth constants, channel moments."""

from typing import NamedTuple

import numpy as np
from typing_extensions import TypeAliasType

from heliograph.model.channel import Channel
from heliograph.model.over_time import OverTime, first, unstack
from heliograph.numerics.check import SYMMETRY_TOLERANCE, array, check_count, fail, rank, scalar, standard_deviations
from heliograph.numerics.module import readable
from heliograph.numerics.types import ArrayLike, Float
from heliograph.random_affine.base import check_maps
from heliograph.random_affine.moments.gain_and_disturbance_moments import DisturbedGain

LARGEST = 1e100  # of levels, gains and weights: products of three of them are numbers
ROUNDING = 1e-13  # relative to the largest eigenvalue, in units of each component: smaller ones are rounding


Varying = TypeAliasType("Varying", ArrayLike | OverTime)  # the same at all steps, or one for each
Constants = TypeAliasType("Constants", Varying | tuple[Varying, Varying])  # of a function, or also of its differences
Matrices = TypeAliasType("Matrices", Float[np.ndarray, "steps _ _"])
Moments = TypeAliasType("Moments", tuple[DisturbedGain, ...])  # of the channel at each step


@readable
class Growth(NamedTuple):
    """Growth constants of a function over the horizon: |f(x)| <= state |x| and |f(x) - f(xhat)| <= error |x - xhat|."""

    state: Float[np.ndarray, "steps"]
    error: Float[np.ndarray, "steps"]

    @property
    def absent(self) -> bool:
        """True if the function is zero throughout."""
        return not (np.any(self.state) or np.any(self.error))


@readable
class GrowthSystem(NamedTuple):
    """System x+ = A x + f(x) + B v, y = C x + h(x) + D v, z = M x, received = G y + N rho, at steps 0 ... steps - 1.

    f and h are known only by their growth, f(0) = h(0) = 0; v and rho are any sequences of finite energy; G and N are
    random.

    Args:
        transition: A (steps, n, n).
        disturbance: B (steps, n, v).
        output: C (steps, y, n).
        feedthrough: D (steps, y, v).
        target: M (steps, z, n), of the error that the level bounds.
        growth: constants of f, and of its differences f~.
        output_growth: constants of h, and of its differences h~.
        channel: moments of (G, N), one for each step.
        initial_weight: W (2n, 2n) of the stacked (x_0, e_0), which makes the third disturbance.
    """

    transition: Matrices
    disturbance: Matrices
    output: Matrices
    feedthrough: Matrices
    target: Matrices
    growth: Growth
    output_growth: Growth
    channel: Moments
    initial_weight: Float[np.ndarray, "n+n n+n"]

    @property
    def steps(self) -> int:
        """Number of steps of the horizon."""
        return len(self.channel)

    @property
    def states(self) -> int:
        """Dimension n of the plant's state."""
        return int(self.transition.shape[1])

    @property
    def received(self) -> int:
        """Number m of components that the filter receives."""
        return int(self.channel[0].mean.shape[0])


def growth_system(
    steps: int,
    disturbance: Varying,
    feedthrough: Varying,
    target: Varying,
    channel: Channel,
    growth: Constants,
    output_growth: Constants = 0.0,
    transition: Varying | None = None,
    output: Varying | None = None,
    initial_weight: "Float[ArrayLike, '...']" = 1.0,
) -> "GrowthSystem":
    """Return the description of x+ = A x + f(x) + B v, y = C x + h(x) + D v, z = M x behind a channel.

    Each matrix may be an `OverTime` of one for every step. A linear h is given by `output` and growth 0.

    Args:
        steps: number of steps of the horizon.
        disturbance: B (n, v).
        feedthrough: D (y, v).
        target: M (z, n), of the error that a level bounds.
        channel: the channel from the sensor to the filter, or an `OverTime` of channels; uncertain probabilities count
            as nominal.
        growth: constant of f, or a pair (of f itself, of its differences) where these differ; a number or an
            `OverTime`.
        output_growth: constant or constants of h in the same way; 0 by default.
        transition: A (n, n); zero by default.
        output: C (y, n); zero by default.
        initial_weight: W (2n, 2n) of (x_0, e_0), or a multiple of the identity; 1 by default.

    Raises:
        ValueError: shapes that do not fit, negative growth, a weight that is not positive definite, things that vary
            over fewer steps than `steps`.
    """
    check_count("steps", steps)
    # Sizes n, v, y from B and D; the channel must take y outputs.
    B = _repeat_over(steps, "disturbance matrix", disturbance, (None, None))
    n, v = B.shape[1:]
    D = _repeat_over(steps, "feedthrough matrix", feedthrough, (None, v))
    y = D.shape[1]
    links = _compute_link_moments(steps, channel)
    if links[0].inputs != y:
        raise fail("channel", f"one that takes the sensor's {y} outputs", f"{links[0].inputs} inputs")
    # Every matrix once for each step.
    A = np.zeros((n, n)) if transition is None else transition
    C = np.zeros((y, n)) if output is None else output
    return GrowthSystem(
        transition=_repeat_over(steps, "transition matrix", A, (n, n)),
        disturbance=B,
        output=_repeat_over(steps, "output matrix", C, (y, n)),
        feedthrough=D,
        target=_repeat_over(steps, "wanted matrix", target, (None, n)),
        growth=_check_growth(steps, "growth", growth),
        output_growth=_check_growth(steps, "output growth", output_growth),
        channel=links,
        initial_weight=_check_initial_weight(initial_weight, n),
    )


def _repeat_over(
    steps: int, name: str, value: Varying, shape: tuple[int | None, ...]
) -> Float[np.ndarray, "steps ..."]:
    """Return a matrix of given shape (None: any length) at every step, (steps, *shape).

    A constant one is repeated; of an `OverTime`, which must cover all steps, later ones are left out. `name` is for
    error messages.
    """
    if not isinstance(value, OverTime):
        matrix: np.ndarray = array(name, value, shape)
        return np.broadcast_to(matrix, (steps, *matrix.shape))
    if value.steps < steps:
        raise fail(f"{name} over time", f"at least {steps} steps", value.steps)
    # More steps than asked for are left out.
    matrices: np.ndarray = array(name, value.values, (None, *shape))
    return matrices[:steps]


def _compute_link_moments(steps: int, channel: Channel) -> tuple[DisturbedGain, ...]:
    """Return mean and second moments of (G, N), the channel's random gain and noise, at every step.

    Raises:
        ValueError: a channel with memory, one over too few steps, or one whose sizes change.
    """
    check_maps("channel", [first(channel)])
    if first(channel).remembers:
        expected = (
            "links that forget: its level is proved step by step, with gains that are independent of the steps before"
        )
        raise fail("channel of an H-infinity design", expected, "one that remembers")
    if not isinstance(channel, OverTime):
        return (channel.disturb_gain(),) * steps
    if channel.steps < steps:
        raise fail("channel over time", f"at least {steps} steps", channel.steps)
    links = tuple(c.disturb_gain() for c in unstack(channel)[:steps])
    if len({(link.mean.shape, link.inputs) for link in links}) != 1:
        raise fail("channel over time", "the same noise sources at each step", [link.disturbances for link in links])
    return links


def _check_growth(steps: int, name: str, value: Constants) -> Growth:
    """Return the growth constants at every step from a number, or from a pair (of the function, of its differences).

    The first constant a means |f(x)| <= a |x|, and the second |f(x) - f(y)| <= a |x - y|. One number stands for both.
    """
    pair = value if isinstance(value, tuple) else (value, value)
    if len(pair) != 2:
        raise fail(name, "a number, or a pair (of the function, of its differences)", value)
    constants = [_repeat_over(steps, name, constant, ()) for constant in pair]
    for constant in constants:
        if np.any(constant < 0):
            raise fail(name, "no negative constant", float(constant.min()))
    return Growth(*constants)


def _check_initial_weight(value: ArrayLike, n: int) -> Float[np.ndarray, "w w"]:
    """Return the initial weight (2n, 2n) from a number or a positive definite matrix.

    It is the weight of (x, e), the first state and error of n components each. A number a stands for the matrix a I.
    """
    name, size = "initial weight", 2 * n
    is_number = rank(name, value) == 0
    matrix: np.ndarray = scalar(name, value) * np.eye(size) if is_number else array(name, value, (size, size))
    # Judged in units of its largest entry: eigenvalues of the largest doubles would overflow.
    unit = float(np.max(np.abs(matrix), initial=0.0)) or 1.0
    symmetric = symmetric_weight("initial weight", matrix / unit)
    if smallest_eigenvalue(symmetric) <= 0:
        smallest = smallest_eigenvalue(symmetric) * unit
        raise fail("initial weight", "a positive definite matrix", f"smallest eigenvalue {smallest:.3g}")
    return matrix


def symmetric_weight(name: str, matrix: Float[np.ndarray, "*many w w"]) -> Float[np.ndarray, "*many w w"]:
    """Return the matrix made exactly symmetric; raise ValueError if it is not nearly so, or has too large entries.

    Entries across the diagonal may differ by SYMMETRY_TOLERANCE in units of each component. None may be above LARGEST,
    1e100.
    """
    largest = float(np.max(np.abs(matrix), initial=0.0))
    if largest > LARGEST:
        raise fail(name, f"entries of at most {LARGEST:g}", f"{largest:g}")
    unit = standard_deviations(matrix)
    asymmetry = np.abs(matrix - np.swapaxes(matrix, -1, -2))
    if np.any(asymmetry > SYMMETRY_TOLERANCE * unit[..., :, None] * unit[..., None, :]):
        raise fail(name, "a symmetric matrix", f"entries that differ by {np.max(asymmetry):.3g} across the diagonal")
    return np.asarray((matrix + np.swapaxes(matrix, -1, -2)) / 2)


def smallest_eigenvalue(matrix: Float[np.ndarray, "w w"], units: Float[np.ndarray, "w"] | None = None) -> float:
    """Return the smallest eigenvalue of a symmetric matrix in units of its components, so that these do not matter.

    Entry ij is divided by u_i u_j. The `units` u are roots of the diagonal's magnitudes unless given, which makes the
    diagonal 1 or -1. The sign of the eigenvalue does not depend on them.
    """
    unit = standard_deviations(matrix) if units is None else units
    return float(np.linalg.eigvalsh(matrix / np.outer(unit, unit))[0])
