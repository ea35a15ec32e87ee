"""What every filter is: a deterministic (init, step) with explicit state, and an estimate that says what it claims."""

from typing import Any

import equinox as eqx

from heliograph.model.estimate import Claim, Estimate


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

    def planned(self, inputs: Any) -> "AbstractFilter":
        """The same filter for these inputs and complete data, with all that does not depend on data computed before."""
        return self
