"""Which number an error covariance becomes: traces and weighted traces, one state, the worst direction, when."""

from collections.abc import Mapping

import equinox as eqx
import numpy as np

from heliograph.numerics.check import array, check_count, covariance, fail, flag
from heliograph.numerics.module import Module
from heliograph.numerics.readable import readable
from heliograph.numerics.types import ArrayLike, Float

WEIGHT = "weight of the error"


@readable
class Error(Module):
    """The error that a design makes small, of the covariance P of the best linear filter after each step.

    <W, P>, with W the `weight`: a matrix (n, n), or a number for each named state ({"position": 1.0} asks for that
    state alone), the identity unless given; `worst`: the largest eigenvalue of W^1/2 P W^1/2 in place of its trace.

    Steady unless a `horizon` is given, then the mean over that many steps from the plant's initial covariance on, or
    with `at_end` that after the last. `period`: the steady mean over a period of so many steps, in each of which
    transmitters may have another power.

    Raises:
        ValueError: a horizon and a period, an end without a horizon, a weight that is no covariance or weighs nothing.
    """

    weight: np.ndarray | dict[str, float] | None
    worst: bool = eqx.field(static=True)
    horizon: int | None = eqx.field(static=True)
    at_end: bool = eqx.field(static=True)
    period: int = eqx.field(static=True)

    def __init__(
        self,
        weight: ArrayLike | Mapping[str, float] | None = None,
        worst: bool = False,
        horizon: int | None = None,
        at_end: bool = False,
        period: int = 1,
    ):
        if isinstance(weight, Mapping):
            self.weight = dict(weight)
        else:
            self.weight = None if weight is None else covariance(WEIGHT, weight)
        self.worst, self.at_end = flag("worst", worst), flag("at_end", at_end)
        self.horizon = None if horizon is None else check_count("horizon of the error", horizon)
        self.period = check_count("period of the error", period)
        if self.horizon is not None and self.period > 1:
            raise fail("error", "a horizon or a period", "both")
        if self.at_end and self.horizon is None:
            raise fail("error at the end", "a horizon", "none")

    @property
    def steps(self) -> int:
        """Steps over which the powers may differ."""
        return self.period if self.horizon is None else self.horizon

    def matrix(self, states: tuple[str, ...]) -> Float[np.ndarray, "n n"]:
        """W for a plant with these states.

        Raises:
            ValueError: a state that the plant does not have, a weight of another size.
        """
        n = len(states)
        if self.weight is None:
            return np.eye(n)
        if isinstance(self.weight, dict):
            unknown = sorted(set(self.weight) - set(states))
            if unknown:
                raise fail(WEIGHT, f"numbers for some of the states {list(states)}", unknown)
            diagonal = np.array([float(self.weight.get(name, 0.0)) for name in states])
            matrix = covariance(WEIGHT, np.diag(diagonal), n)
        else:
            matrix = array(WEIGHT, self.weight, (n, n))
        if not np.any(matrix):
            raise fail(WEIGHT, "one that weighs something", "zero")
        return np.asarray(matrix)

    def over(self) -> Float[np.ndarray, "time"]:
        """The share of each step in the error."""
        shares: np.ndarray = np.full(self.steps, 1 / self.steps)
        return np.eye(self.steps)[-1] if self.at_end else shares
