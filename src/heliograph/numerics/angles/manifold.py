"""States that are no numbers on a line: angles, and attitudes as rotation vectors, among others that are.

A state x has n numbers, and so has a small change d of it: x plus d is x + d, but for angles, where full turns are
taken off, and attitudes, which turn by d in their own axes. `difference` is the inverse; covariances are of such
changes.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, TypeVar

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.angles.angle import Angles, continue_angles, wrap_angles, wrap_near
from heliograph.numerics.angles.rotation_vectors import turn, turn_between
from heliograph.numerics.types import Array

A = TypeVar("A", jax.Array, np.ndarray)
Rotations = Angles  # places of rotation vectors, three after three


class Manifold(NamedTuple):
    """Which states are angles, and which, three by three, are the rotation vectors of attitudes; all others are lines.

    Args:
        angles: places of angles.
        rotations: places of rotation vectors, three of each attitude.
    """

    angles: Angles = ()
    rotations: Rotations = ()

    def plus(self, x: Array, d: Array) -> Any:
        """Return x changed by d, (..., n) both: angles between -pi and pi, attitudes turned in their own axes."""
        total: Any = x + d
        return self._replace_rotations(wrap_angles(total, self.angles), turn, x, d)

    def difference(self, x: Array, other: Array) -> Any:
        """Return d with x = other plus d, (..., n): angles and turns of at most pi."""
        change: Any = x - other
        return self._replace_rotations(wrap_angles(change, self.angles), turn_between, x, other)

    def _replace_rotations(self, whole: Array, make: Callable[[Array, Array], Any], x: Array, y: Array) -> Any:
        """Return `whole` (..., n) with each of its rotation vectors replaced by make(that of x, that of y).

        `self.rotations`: the places of their components, three for each vector.
        """
        for i in range(0, len(self.rotations), 3):
            columns = np.array(self.rotations[i : i + 3])  # of one rotation vector
            x, y = (v if np.shape(v) == np.shape(whole) else v + np.zeros(np.shape(whole)) for v in (x, y))
            vector = make(x[..., columns], y[..., columns])
            if isinstance(whole, jax.Array) or isinstance(vector, jax.Array):
                whole = jnp.asarray(whole).at[..., columns].set(vector)
            else:
                whole = whole.copy()
                whole[..., columns] = vector
        return whole

    def near(self, x: A, reference: Array) -> A:
        """Return the same state, its angles within half a turn of those of `reference` (..., n)."""
        return wrap_near(x, reference, self.angles)

    def chart(self, function: Callable[[jax.Array], jax.Array], center: jax.Array) -> Callable[[jax.Array], jax.Array]:
        """Return the function x -> function(center plus (x - center)) of plain differences from `center`.

        `plus` adds vectors and turns attitudes. The derivative at x = center is then that by the change of the state.
        """
        if not self.rotations:
            return function
        return lambda x: function(self._replace_rotations(x, turn, center, x - center))

    def chart_move(
        self, function: Callable[[jax.Array], jax.Array], center: jax.Array, middle: jax.Array | None = None
    ) -> Any:
        """Return the motion f of states near `center` as a function of vectors, for which moments can be computed.

        It is x -> m + (f(center plus (x - center)) difference m), with m the `middle`, by default f(center). `plus` and
        `difference` turn attitudes; + and - are those of vectors. Angles are continued over full turns.
        """
        continued = continue_angles(function, center, self.angles, self.angles)
        if not self.rotations:
            return continued
        in_chart = self.chart(continued, center)
        m = function(center) if middle is None else middle
        return lambda x: self.unsettle(m, in_chart(x))

    def settle(self, center: Array, x: Array) -> Any:
        """Return the state whose change from `center` is x - center, (..., n); angles stay as they are."""
        return self._replace_rotations(x, turn, center, x - center) if self.rotations else x

    def unsettle(self, center: Array, x: Array) -> Any:
        """Return center + (x difference center), (..., n), the inverse of `settle`; angles stay as they are."""
        return self._replace_rotations(x, lambda r, other: other + turn_between(r, other), x, center)

    def reset_jacobian(self, change: jax.Array) -> jax.Array | None:
        """Return d((x + d) difference x')/dd at d = change with x' = x plus change (n, n), or None without rotations.

        It turns errors about x into errors about x'. It is the identity except for attitudes, where the block of a
        rotation is the right Jacobian. `plus` and `difference` turn attitudes; + is that of vectors.
        """
        if not self.rotations:
            return None
        matrix = jnp.eye(len(change), dtype=change.dtype)
        for i in range(0, len(self.rotations), 3):
            columns = np.array(self.rotations[i : i + 3])  # of one rotation vector
            rotation = change[columns]
            block = jax.jacfwd(lambda d, rotation=rotation: turn_between(d, rotation))(rotation)
            matrix = matrix.at[columns[:, None], columns].set(block)
        return matrix
