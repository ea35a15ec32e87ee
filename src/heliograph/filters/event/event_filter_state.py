"""State of a filter behind a sender that decides when to send: a Gaussian sum, and what is known of the sender."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from heliograph.factors.factored_gaussian import Gaussian
from heliograph.filters.event.gaussian_sum import GaussianSum, safe_log


class EventBelief(NamedTuple):
    """The sum: Gaussians of (x, r), r the sender's reference, and labels (mode, steps since sent, number lost).

    Shapes: weight (H,), the Gaussians (H, n + m), label (H, S, M, A, C) with S = 1 where y is sent as a whole, else m;
    `begun` (S,) once there is a reference, `moved` once the chain was used.
    """

    weight: jax.Array
    gaussian: Gaussian
    label: jax.Array
    begun: jax.Array
    moved: jax.Array

    @property
    def components(self) -> tuple[jax.Array, Gaussian]:
        """Weights (H,), and the Gaussians of (x, r)."""
        return self.weight, self.gaussian

    @property
    def parts(self) -> GaussianSum:
        """The sum, with the logarithms of its weights."""
        return GaussianSum(safe_log(self.weight), self.gaussian, self.label)

    @staticmethod
    def from_sum(mixture: GaussianSum, begun: jax.Array, moved: jax.Array) -> "EventBelief":
        """Return the state that holds a sum of Gaussians, with weights in place of their logarithms.

        A stored state should be finite, which log 0 is not. `begun` is True for the senders that have sent. `moved` is
        True once a step was predicted.
        """
        return EventBelief(
            weight=jnp.exp(mixture.log_weight), gaussian=mixture.gaussian, label=mixture.label, begun=begun, moved=moved
        )
