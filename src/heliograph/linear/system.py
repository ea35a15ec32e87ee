"""A linear system whose noises are white: what plant, relays and sensors become before gains are computed."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from typing_extensions import TypeAliasType

from heliograph.numerics import check
from heliograph.numerics.check import array, instance
from heliograph.numerics.module import Module
from heliograph.numerics.readable import readable
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
    """Linear system y+ = A y + a + w, z = C y+ + c + v, of which x = W y is to be estimated.

    w and v have mean zero given all earlier y and are uncorrelated with each other. Random coefficients fit: take A and
    C as their means, and as Cov(w), Cov(v) what is left over, E[(H - EH) y y' (H - EH)'] plus noise. A measurement
    that shares the step's noise (a relay that listens while it sends) is made a component of y and read with v = 0.

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
        instance("steps of a system", steps, Steps, "Steps")
        time, n = np.shape(steps.drift)
        m = np.shape(steps.offset)[-1]
        one_step: tuple[tuple[int, ...], ...] = ((n, n), (n,), (n, n), (m, n), (m,), (m, m))
        named = zip(Steps._fields, steps, one_step, strict=True)
        checked = [array(f"system {name}", value, (time, *shape)) for name, value, shape in named]
        self.steps = Steps(*checked)
        self.mean = array("mean of the start", mean, (n,))
        self.covariance = check.covariance("covariance of the start", covariance, n)
        self.projection = array("what is to be known", projection, (None, n))
        self.rounding = _rounding(rounding, (time, n))
        self.received_rounding = _rounding(received_rounding, (time, m))
        self.start_rounding = _rounding(start_rounding, (n,))

    @property
    def horizon(self) -> int:
        """Number of steps."""
        return len(self.steps.drift)

    def step(self, k: int) -> Steps:
        """The matrices of one step, without time axis."""
        return Steps(*(field[k] for field in self.steps))

    @property
    def steady_from(self) -> int:
        """The first step from which on all steps are as the last."""
        changes = [0]
        for field in (*self.steps, self.rounding, self.received_rounding):
            moved = field[1:] != field[:-1]
            changed = np.flatnonzero(np.any(moved, axis=tuple(range(1, moved.ndim))))
            changes += (changed[-1:] + 1).tolist()
        return max(changes)


def over_horizon(parts: Sequence[np.ndarray], horizon: int) -> np.ndarray:
    """Parts of the first steps, of which all that follow are as the last, for every step of the horizon."""
    values = np.array(parts)
    return np.concatenate([values, np.repeat(values[-1:], horizon - len(values), axis=0)])


def _rounding(given: ArrayLike | None, shape: tuple[int, ...]) -> np.ndarray:
    result: np.ndarray = np.zeros(shape) if given is None else array("rounding", given, shape)
    return result


class StateMoments(NamedTuple):
    """Mean and covariance of y itself; entry 0 is the start."""

    mean: Float[np.ndarray, "time+1 N"]
    covariance: Float[np.ndarray, "time+1 N N"]


def state_moments(system: LinearSystem) -> StateMoments:
    """Propagate the moments of y of a `system` before any data: X+ = A X A' + Cov(w).

    No best filter's error exceeds them, P_k <= X_k.
    """
    instance("system", system, LinearSystem, "a LinearSystem")
    mean, spread = system.mean, system.covariance
    means, spreads = [mean], [spread]
    for k in range(system.horizon):
        s = system.step(k)
        mean = s.transition @ mean + s.drift
        spread = s.transition @ spread @ s.transition.T + s.process
        means.append(mean)
        spreads.append(spread)
    return StateMoments(np.array(means), np.array(spreads))
