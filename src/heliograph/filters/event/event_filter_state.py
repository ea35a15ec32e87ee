"""State of a filter behind a sender that decides when to send: a Gaussian sum, and what is known of the sender."""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from heliograph.factors.factored_gaussian import Gaussian
from heliograph.filters.event.gaussian_sum import GaussianSum, safe_log


class EventBelief(NamedTuple):
    """A sum of H Gaussians of (x, r): x (n,) is the plant's state, r (m,) the value that the senders compare y with.

    `weight` (H,), `gaussian` of n + m components. `label` (H, S, M, A, C): probabilities of each sender's status given
    the Gaussian, by link mode, steps since it sent and transmissions lost; S = 1 if y is sent as a whole, else m.
    `begun` (S,): the sender has a reference. `moved`: a step was predicted, so the link's modes have left the first.
    """

    weight: jax.Array
    gaussian: Gaussian
    label: jax.Array
    begun: jax.Array
    moved: jax.Array

    @property
    def components(self) -> tuple[jax.Array, Gaussian]:
        """Weights (H,), and the H Gaussians of (x, r): x is the plant's state, r the senders' reference."""
        return self.weight, self.gaussian

    @property
    def gaussian_sum(self) -> GaussianSum:
        """The sum, with the logarithms of its weights."""
        return GaussianSum(safe_log(self.weight), self.gaussian, self.label)

    @staticmethod
    def from_sum(mixture: GaussianSum, begun: jax.Array, moved: jax.Array) -> "EventBelief":
        """Return the state that holds a sum of Gaussians, with weights in place of their logarithms.

        A stored state should be finite, which log 0 is not. `begun` (S,) is True for senders that have a reference to
        compare with. `moved` is True once a step was predicted.
        """
        return EventBelief(
            weight=jnp.exp(mixture.log_weight),
            gaussian=mixture.gaussian,
            label=mixture.status,
            begun=begun,
            moved=moved,
        )
