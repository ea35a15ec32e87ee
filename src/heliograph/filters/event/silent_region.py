"""Region in which y less the reference of its sender lies as long as the sender is silent; Gaussians cut to it."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.event.gaussian_in_ball import truncate_to_ball
from heliograph.filters.event.gaussian_sum import (
    GaussianSum,
    concatenate_sums,
    merge_groups,
    truncate_between,
    truncate_outside,
)
from heliograph.model.trigger import AbstractThreshold


class SilentRegion(NamedTuple):
    """The region |y - r| <= delta of a threshold, of each component, of all in a box, or in a ball.

    states, outputs: lengths n of x and m of y, of Gaussians over (x, r, y); pieces: into how many the interval of the
    first component is cut. A sender is a slice of the components of y.
    """

    states: int
    trigger: AbstractThreshold
    outputs: int
    pieces: int

    @property
    def is_ball(self) -> bool:
        """True if the region is a ball of several components."""
        return self.trigger.region == "ball" and self.outputs > 1

    def count_outside_parts(self, sender: slice) -> int:
        """Return the number of pieces that `truncate_outside` cuts the outside |y - r| > delta into.

        These are two for each component, above and below its interval, and for a ball the rest of the box around it.
        """
        return 2 * len(range(self.outputs)[sender]) + self.is_ball

    def _error_directions(self, sender: slice) -> list[tuple[jax.Array, jax.Array]]:
        """Return for each component i of a sender the row d with d'(x, r, y) = y_i - r_i, and its threshold delta_i.

        x has n states, and the sender compares the m signals y with the m references r.
        """
        n, m = self.states, self.outputs
        delta = jnp.broadcast_to(jnp.asarray(self.trigger.delta), (m,))
        unit = jnp.eye(n + 2 * m)
        return [(unit[n + m + i] - unit[n + i], delta[i]) for i in range(sender.start, sender.stop)]

    def truncate_inside(
        self, known: GaussianSum, unknown: GaussianSum, sender: slice
    ) -> tuple[GaussianSum, GaussianSum]:
        """Truncate Gaussians of (x, r, y) to |y - r| <= delta, in the components that a sender sends.

        A sender is silent while its signal y is near the value sent last, its reference r; x is the plant's state.
        Silence thus truncates the law of (x, r, y) to the region, and each truncated law is replaced by a Gaussian of
        the same moments. Pieces of the interval keep its shape better than one Gaussian. The region is a ball, or an
        interval in each component.

        Args:
            known: Gaussians with a known reference r. Each is cut to every piece of the interval of the sender's first
                component, and those of the same piece are merged.
            unknown: Gaussians whose reference was lost, each cut to the region as a whole.
            sender: components of y.

        Returns:
            The Gaussians of known reference, one for each piece, and those of unknown reference.
        """
        (direction, delta), *rest = self._error_directions(sender)
        # Each known Gaussian once for each piece [low, high] of the interval [-1, 1], piece after piece, in units of
        # delta.
        size, edges = len(known.log_weight), np.linspace(-1.0, 1.0, self.pieces + 1)
        low, high = (np.repeat(ends, size) for ends in (edges[:-1], edges[1:]))
        cut = concatenate_sums([known] * self.pieces)
        # A ball: cut to the piece of the first component, then all to the ball.
        if self.is_ball:
            if self.pieces > 1:  # a single piece is the whole ball
                cut = truncate_between(cut, direction, low * delta, high * delta)
            cut = self._truncate_to_ball(concatenate_sums([cut, unknown]), sender, 1.0, inside=True)
        else:
            # Intervals: the unknown ones from -delta to delta; then all by the interval of each other component.
            ones = np.ones(len(unknown.log_weight))
            low, high = np.append(low, -ones), np.append(high, ones)
            cut = truncate_between(concatenate_sums([cut, unknown]), direction, low * delta, high * delta)
            for direction, delta in rest:
                cut = truncate_between(cut, direction, -delta, delta)
        # The first size * pieces are the known ones; merge those of the same piece.
        count = size * self.pieces
        return merge_groups(cut.select_range(0, count), self.pieces), cut.select_range(count)

    def truncate_outside(self, mixture: GaussianSum, sender: slice, scale: float) -> GaussianSum:
        """Truncate each Gaussian to |y - r| > scale delta, in `count_outside_parts` pieces, and return their sum.

        The sender compares its signal y with r. delta is its threshold, or a radius if `is_ball`. There are two pieces
        for each component i: y_i - r_i is above or below the interval, and all components before i are inside. For a
        ball these pieces are the outside of the box around it. One more piece is the box without the ball.
        """
        outside, errors = [], self._error_directions(sender)
        for i, (direction, delta) in enumerate(errors, 1):
            edge = scale * delta
            outside.append(truncate_outside(mixture, direction, edge))
            if i < len(errors) or self.is_ball:
                mixture = truncate_between(mixture, direction, -edge, edge)
        if self.is_ball:
            outside.append(self._truncate_to_ball(mixture, sender, scale, inside=False))
        return concatenate_sums(outside)

    def _truncate_to_ball(self, mixture: GaussianSum, sender: slice, scale: float, inside: bool) -> GaussianSum:
        """Truncate each Gaussian to |y - r| <= scale delta (`inside`), or to where it is more."""
        directions, deltas = zip(*self._error_directions(sender), strict=True)
        return truncate_to_ball(mixture, jnp.stack(directions), scale * deltas[0], inside)
