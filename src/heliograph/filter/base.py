"""What every filter is: a deterministic (init, step) with explicit state, and an estimate that says what it claims."""

from typing import Any, Literal

import equinox as eqx
import jax
import numpy as np

Claim = Literal["exact", "upper", "nominal", "none"]
STRENGTH: dict[Claim, int] = {"none": -1, "nominal": 0, "upper": 1, "exact": 2}


class Estimate(eqx.Module):
    """An estimate and the covariance claimed for its error.

    claim: "exact" if `bound` is E[(x - mean)(x - mean)'], "upper" if it dominates it, "nominal" if it is only what the
    filter's approximations say, "none" if no covariance is claimed: then `bound` is NaN.

    Shapes: mean (..., n), bound (..., n, n).
    """

    mean: jax.Array | np.ndarray
    bound: jax.Array | np.ndarray
    claim: Claim = eqx.field(static=True)


class AbstractFilter(eqx.Module):
    """A filter: `init()` gives the state before any data, `step(state, z, u, k)` the next state and the estimate.

    Deterministic: it never receives a random key. A component of z that is NaN did not arrive and is skipped. The
    state is a pytree of arrays, so one filter object serves a stream, a recording and thousands of runs at once.
    """

    claim: eqx.AbstractVar[Claim]

    def init(self) -> Any:
        """State before the first step."""
        raise NotImplementedError

    def step(self, state: Any, z: Any, u: Any = (), k: Any = 0) -> tuple[Any, Estimate]:
        """Predict over step k with the input u, then use the measurement z of shape (m,)."""
        raise NotImplementedError


def weakest(claims: list[Claim]) -> Claim:
    """The strongest claim that all of `claims` support."""
    return min(claims, key=STRENGTH.__getitem__)
