"""Linear systems whose noises are white, and schedules: filters of them computed before any data."""

from collections.abc import Sequence
from pathlib import Path
from typing import NamedTuple, cast

import equinox as eqx
import numpy as np
from typing_extensions import TypeAliasType

from heliograph.linear.jump_system import propagate_by_mode
from heliograph.model.assumed.assumed_model import NOTHING, StaticAssumedModel
from heliograph.model.estimate import STRENGTH, Claim
from heliograph.numerics import check
from heliograph.numerics.check import array, fail, file_path, instance, show_value
from heliograph.numerics.module import Module, readable
from heliograph.numerics.types import ArrayLike, Float

Rounding = TypeAliasType("Rounding", Float[ArrayLike, "*time _"])  # of the diagonal of a matrix


@readable
class Steps(NamedTuple):
    """Steps of a linear system y+ = A y + a + w, z = C y+ + c + v, with a leading time axis (one step: none).

    transition A, drift a, process Cov(w), output C, offset c, noise Cov(v).
    """

    transition: Float[np.ndarray, "*time N N"]
    drift: Float[np.ndarray, "*time N"]
    process: Float[np.ndarray, "*time N N"]
    output: Float[np.ndarray, "*time m N"]
    offset: Float[np.ndarray, "*time m"]
    noise: Float[np.ndarray, "*time m m"]


@readable
class LinearSystem(Module):
    """Linear system y+ = A y + a + w, z = C y+ + c + v, with x = W y to be estimated.

    w and v have mean zero given all earlier y and are uncorrelated with each other. A random coefficient H fits too:
    its mean is A or C, and E[(H - EH) y y' (H - EH)'] counts as part of Cov(w) or Cov(v). A measurement that shares the
    step's noise (a relay that listens while it sends) is made a component of y and read with v = 0.

    Args:
        steps: matrices of each step.
        mean: mean of y before the first step (N,).
        covariance: its covariance (N, N).
        projection: W (q, N).
        rounding: absolute rounding error of the diagonal of `process` (time, N), where it came out of a subtraction;
            zero unless given, like the next two.
        received_rounding: the same of `noise` (time, m).
        start_rounding: the same of `covariance` (N,).

    Raises:
        ValueError: shapes that do not fit, or a start that has no covariance.
    """

    steps: Steps
    mean: Float[np.ndarray, "N"]
    covariance: Float[np.ndarray, "N N"]
    projection: Float[np.ndarray, "q N"]
    rounding: Float[np.ndarray, "time N"]
    received_rounding: Float[np.ndarray, "time m"]
    start_rounding: Float[np.ndarray, "N"]
    kept: StaticAssumedModel = eqx.field(
        static=True, default=NOTHING, init=False, repr=False, compare=False
    )  # models that it was made of

    def __init__(
        self,
        steps: Steps,
        mean: "Float[ArrayLike, ' N']",
        covariance: "Float[ArrayLike, 'N N']",
        projection: "Float[ArrayLike, 'q N']",
        rounding: Rounding | None = None,
        received_rounding: Rounding | None = None,
        start_rounding: Rounding | None = None,
    ):
        """Check all arrays against the numbers of steps, of states N and of outputs m that `steps` has, and hold them.

        The system is y+ = A y + a + w, z = C y+ + c + v, x = W y; the class says what each argument is. Roundings are
        zero where None is given.
        """
        instance("steps of a system", steps, Steps, "Steps")
        time, n = np.shape(steps.drift)
        m = np.shape(steps.offset)[-1]
        # Shapes of one step in the order of `Steps`: A, a, Cov w of the state, and C, c, Cov v of the measurement.
        shapes: tuple[tuple[int, ...], ...] = ((n, n), (n,), (n, n), (m, n), (m,), (m, m))
        named = zip(Steps._fields, steps, shapes, strict=True)
        self.steps = Steps(*(array(f"system {name}", value, (time, *shape)) for name, value, shape in named))
        self.mean = array("mean of the start", mean, (n,))
        self.covariance = check.covariance("covariance of the start", covariance, n)
        self.projection = array("what is to be known", projection, (None, n))
        self.rounding = _rounding_or_zero(rounding, (time, n))
        self.received_rounding = _rounding_or_zero(received_rounding, (time, m))
        self.start_rounding = _rounding_or_zero(start_rounding, (n,))

    @property
    def horizon(self) -> int:
        """Number of steps."""
        return len(self.steps.drift)

    def step(self, k: int) -> Steps:
        """Return the matrices of one step, without time axis."""
        return Steps(*(field[k] for field in self.steps))

    @property
    def steady_from(self) -> int:
        """The first step from which on all steps have the same matrices and roundings; 0 if all steps are equal."""
        last_changes = [0]  # of each field: the last step at which it differs from the step before
        for field in (*self.steps, self.rounding, self.received_rounding):
            differs = field[1:] != field[:-1]
            step_differs = np.any(differs, axis=tuple(range(1, differs.ndim)))
            differing_steps = 1 + np.flatnonzero(step_differs)
            if len(differing_steps):
                last_changes.append(int(differing_steps[-1]))
        return max(last_changes)


def repeat_last_step(first_steps: Sequence[np.ndarray], horizon: int) -> np.ndarray:
    """Return arrays of the first steps stacked (horizon, ...), the last one repeated for all later steps."""
    values = np.array(first_steps)
    return np.concatenate([values, np.repeat(values[-1:], horizon - len(values), axis=0)])


def _rounding_or_zero(rounding: ArrayLike | None, shape: tuple[int, ...]) -> np.ndarray:
    """Return rounding errors as an array of this shape, zeros if none are given; raise ValueError for another shape."""
    numbers: np.ndarray = np.zeros(shape) if rounding is None else array("rounding", rounding, shape)
    return numbers


class StateMoments(NamedTuple):
    """Mean and covariance of the state y before any data, at each time; entry 0 is the start."""

    mean: Float[np.ndarray, "time+1 N"]
    covariance: Float[np.ndarray, "time+1 N N"]


def state_moments(system: LinearSystem) -> StateMoments:
    """Return the mean and covariance X_k of y without data, at the start and after each step: X+ = A X A' + Cov(w).

    Data can only lower the error covariance P_k of the best filter, so P_k <= X_k.

    Args:
        system: a linear system.
    """
    instance("system", system, LinearSystem, "a LinearSystem")
    mean, covariance = system.mean, system.covariance
    means, covariances = [mean], [covariance]
    for k in range(system.horizon):
        step = system.step(k)
        mean = step.transition @ mean + step.drift
        covariance = propagate_by_mode(step.transition, covariance, step.process)
        means.append(mean)
        covariances.append(covariance)
    return StateMoments(np.array(means), np.array(covariances))


Matrices = TypeAliasType("Matrices", Float[np.ndarray, "*time _ _"])  # one for each step; one step: no axis
Vectors = TypeAliasType("Vectors", Float[np.ndarray, "*time _"])


@readable
class Gains(NamedTuple):
    """Gains of a linear filter, s+ = F s + K z + c and xhat = L s + J z + d with s the state before the step.

    The prediction of z is G s + g: it replaces what did not arrive. Every array has a leading axis of time, but for
    the gains of one step.

    Args:
        transition: F (time, N, N).
        gain: K (time, N, m).
        offset: c (time, N).
        output: L (time, q, N).
        direct: J (time, q, m).
        output_offset: d (time, q).
        expected: G (time, m, N).
        expected_offset: g (time, m).
        covariance: covariance of x - xhat (time, q, q).
        predicted: covariance of x - L s - J (G s + g) - d, before z (time, q, q); NaN where unknown.
        innovation: covariance of z - G s - g (time, m, m); NaN where unknown.
    """

    transition: Matrices
    gain: Matrices
    offset: Vectors
    output: Matrices
    direct: Matrices
    output_offset: Vectors
    expected: Matrices
    expected_offset: Vectors
    covariance: Matrices
    predicted: Matrices
    innovation: Matrices


MAY_BE_NAN = ("predicted", "innovation")  # fields of `Gains` that may be unknown


@readable
class Schedule(Module):
    """Linear filter over time with precomputed gains, and the covariance that it claims for complete data.

    Args:
        gains: gains and covariances of each step.
        start: the filter's state before the first step (N,).
        claim: what the covariance is: "exact", "upper", "nominal" or "none".

    Raises:
        ValueError: shapes that do not fit, numbers that are not finite (the last two fields may be NaN), an unknown
            claim.
    """

    gains: Gains
    start: Float[np.ndarray, "N"]
    claim: Claim = eqx.field(static=True)
    kept: StaticAssumedModel = eqx.field(
        static=True, default=NOTHING, init=False, repr=False, compare=False
    )  # models that it was made for

    def __init__(self, gains: Gains, start: "Float[ArrayLike, ' N']", claim: Claim):
        """Check the shapes of all arrays against each other, and hold them.

        A schedule is a linear filter whose gains are known before any data: s+ = F s + K z + c, xhat = L s + J z + d,
        and G s + g is its prediction of z.

        Args:
            gains: F (`transition`), K (`gain`), c (`offset`), L (`output`), J (`direct`), d (`output_offset`), G
                (`expected`), g (`expected_offset`), and three covariances, each with a leading axis of time; n numbers
                in s, m in z and q in xhat.
            start: the filter's state s before the first step (n,).
            claim: what the covariances are: "exact", "upper" (a bound), "nominal" or "none".
        """
        instance("gains of a schedule", gains, Gains, "Gains")
        self.start = array("start of the schedule", start, (None,))
        # Sizes are read from two of the fields, and the shapes of all are checked against them.
        time, n, m = np.shape(gains.gain)
        q = np.shape(gains.output_offset)[-1]
        shape_of_field: dict[str, tuple[int, ...]] = {
            "transition": (time, n, n), "gain": (time, n, m), "offset": (time, n),
            "output": (time, q, n), "direct": (time, q, m), "output_offset": (time, q),
            "expected": (time, m, n), "expected_offset": (time, m),
            "covariance": (time, q, q), "predicted": (time, q, q), "innovation": (time, m, m),
        }  # fmt: skip
        checked = {}
        for name, value in gains._asdict().items():
            check_array = _array_or_nan if name in MAY_BE_NAN else array  # these covariances may be unknown
            checked[name] = check_array(f"schedule {name}", value, shape_of_field[name])
        self.gains = Gains(**checked)
        if len(self.start) != n:
            raise fail("start of the schedule", f"shape ({n},)", f"shape {self.start.shape}")
        if not isinstance(claim, str) or claim not in STRENGTH:  # the four claims
            raise fail("claim", f"one of {list(STRENGTH)}", show_value(claim))
        self.claim = claim

    @property
    def horizon(self) -> int:
        """Number of steps."""
        return len(self.gains.offset)

    def save(self, path: str | Path) -> None:
        """Write all arrays and the claim to a NumPy file (.npz), which `load_schedule` or another program reads."""
        with open(path, "wb") as file:
            np.savez(file, start=self.start, claim=np.array(self.claim), **self.gains._asdict())


def _array_or_nan(name: str, value: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return a value as an array, after a check of its shape and numbers; NaN, for an unknown number, is let pass.

    `name` is what an error message calls it.
    """
    unknown = np.isnan(value)
    checked = array(name, np.where(unknown, 0.0, value), shape)
    return np.where(unknown, np.nan, checked)


def load_schedule(path: str | Path) -> Schedule:
    """Read the schedule that `Schedule.save` wrote to the file `path`.

    Args:
        path: of the file (.npz), with an array for each field of Gains, the start and the claim.

    Raises:
        ValueError: a file that holds no schedule.
    """
    path = file_path("schedule", path)
    try:
        with np.load(path, allow_pickle=False) as file:
            stored = {name: file[name] for name in file.files}
    except (ValueError, EOFError, OSError) as error:
        raise fail(f"schedule {path}", "a file written by Schedule.save", str(error).splitlines()[0]) from None
    missing = sorted({*Gains._fields, "start", "claim"} - set(stored))
    if missing:
        raise fail(f"schedule {path}", "all arrays of a schedule", f"none for {missing}")
    claim = cast(Claim, str(stored["claim"]))  # a Schedule checks it
    return Schedule(Gains(*(stored[field] for field in Gains._fields)), stored["start"], claim)
