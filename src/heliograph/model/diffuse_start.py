"""Diffuse initial states: the limit of an initial covariance that grows without bound, of all or of named states."""

from collections.abc import Sequence
from typing import NoReturn

import equinox as eqx
import numpy as np

from heliograph.numerics.check import covariance, fail, name_list
from heliograph.numerics.module import Module, readable
from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.types import Array, ArrayLike, Float

TAKEN_BY = "a known law of x_0 here (hg.kalman_filter takes an unknown one; a large covariance elsewhere)"


@readable
class DiffuseStart(Module):
    """Initial covariance of which nothing is known: `hg.diffuse` for all states, `hg.diffuse(names, known)` for some.

    Args:
        names: of the states that are unknown; None for all.
        known: covariance (n, n) or variance of the others, whose rows of unknown states do not matter; 0 by default.
    """

    names: tuple[str, ...] | None = eqx.field(static=True, default=None)
    known: ArrayLike = 0.0

    def __call__(self, states: Sequence[str], known: ArrayLike = 0.0) -> "DiffuseStart":
        """Return the start of which some states are unknown, and the others have a covariance.

        Args:
            states: names of the unknown ones.
            known: covariance (n, n), or variance, of the others; 0, which says that they are the initial mean.

        Raises:
            ValueError: no names.
        """
        return DiffuseStart(tuple(name_list("states with an unknown start", states)), known)

    def of_states(self, states: tuple[str, ...]) -> "UnknownStart":
        """Return the start of a plant with these states: which states are unknown, and the covariance of the others.

        `self.names`: names of the unknown states, None for all. Rows and columns of unknown states are set to 0.

        Raises:
            ValueError: a name that is no state, a matrix that is no covariance.
        """
        unknown_states = states if self.names is None else self.names
        for name in unknown_states:
            if name not in states:
                raise fail("states with an unknown start", f"some of {list(states)}", name)
        is_unknown = np.array([name in unknown_states for name in states])
        given = covariance("known part of the initial covariance", self.known, len(states))
        known = library(given).where(is_unknown[:, None] | is_unknown, 0.0, given)
        return UnknownStart(known, tuple(is_unknown.tolist()))


class UnknownStart(Module):
    """The initial covariance of a plant of which some states are unknown; what takes it for an array is refused.

    Args:
        known: covariance of the others (n, n), 0 elsewhere.
        unknown: which states are unknown (n,).
    """

    known: Float[Array, "n n"]
    unknown: tuple[bool, ...] = eqx.field(static=True)

    def _refuse(self, *_: object, **__: object) -> NoReturn:
        """Raise ValueError: here the law of x_0 must be known."""
        raise fail("initial covariance", TAKEN_BY, "hg.diffuse")

    __array__ = __jax_array__ = __matmul__ = __rmatmul__ = __getitem__ = __len__ = __iter__ = _refuse
    __add__ = __radd__ = __mul__ = __rmul__ = _refuse


diffuse = DiffuseStart()
