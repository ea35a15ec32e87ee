"""States that are not all vectors: some components are angles, or rotation vectors of attitudes.

A state x has n numbers, and so has a small change d of it. "x plus d" is x + d, except that an angle is wrapped to
between -pi and pi, and an attitude is rotated by d in its body axes. "x difference y" is the d with y plus d = x;
covariances are those of such changes d.
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
Rotations = Angles  # indices of the components of rotation vectors, three for each vector


class Manifold(NamedTuple):
    """Which states are angles, and which, three by three, are rotation vectors of attitudes; all others are real.

    Args:
        angles: indices of angles.
        rotations: indices of the components of rotation vectors, three for each attitude.
    """

    angles: Angles = ()
    rotations: Rotations = ()

    def plus(self, x: Array, d: Array) -> Any:
        """Return x changed by d (..., n): angles are wrapped to between -pi and pi, attitudes rotated in body axes."""
        total: Any = x + d
        return self._replace_rotations(wrap_angles(total, self.angles), turn, x, d)

    def difference(self, x: Array, other: Array) -> Any:
        """Return d with x = other plus d, (..., n): angles and turns of at most pi."""
        change: Any = x - other
        return self._replace_rotations(wrap_angles(change, self.angles), turn_between, x, other)

    def _replace_rotations(self, state: Array, combine: Callable[[Array, Array], Any], x: Array, y: Array) -> Any:
        """Return `state` (..., n) with each rotation vector replaced by combine(a, b), a and b those of x and y.

        `combine` maps two rotation vectors (..., 3) to one, such as the rotation a followed by b. `self.rotations`
        holds the indices of the vectors' components, three for each vector.
        """
        for i in range(0, len(self.rotations), 3):
            columns = np.array(self.rotations[i : i + 3])  # of one rotation vector
            x, y = (v if np.shape(v) == np.shape(state) else v + np.zeros(np.shape(state)) for v in (x, y))
            vector = combine(x[..., columns], y[..., columns])
            if isinstance(state, jax.Array) or isinstance(vector, jax.Array):
                state = jnp.asarray(state).at[..., columns].set(vector)
            else:
                state = state.copy()
                state[..., columns] = vector
        return state

    def near(self, x: A, reference: Array) -> A:
        """Return x with full turns added to its angles, so that each is within half a turn of `reference` (..., n)."""
        return wrap_near(x, reference, self.angles)

    def chart(self, function: Callable[[jax.Array], jax.Array], center: jax.Array) -> Callable[[jax.Array], jax.Array]:
        """Return the function x -> function(center plus (x - center)), where x - center is a difference of vectors.

        `plus` adds vectors and turns attitudes. So the derivative at x = center, as JAX takes it, is the derivative by
        a small change of the state, as an extended filter needs it. Without attitudes it is the function itself.
        """
        if not self.rotations:
            return function
        return lambda x: function(self._replace_rotations(x, turn, center, x - center))

    def chart_move(
        self, function: Callable[[jax.Array], jax.Array], center: jax.Array, middle: jax.Array | None = None
    ) -> Any:
        """Return the motion f near `center` as a map of vectors to vectors, whose moments the usual transforms compute.

        Attitudes are replaced by rotation vectors: x - center is the rotation from `center` before the motion, and the
        result is m plus the rotation vector from m after it. With m = `middle`, by default f(center), the map is
        x -> m + (f(center plus (x - center)) difference m), where + and - are those of vectors. An angle does not jump
        by a full turn: it is continued from its value at `center`.
        """
        continuous = continue_angles(function, center, self.angles, self.angles)
        if not self.rotations:
            return continuous
        function_of_vectors = self.chart(continuous, center)
        m = function(center) if middle is None else middle
        return lambda x: self.unsettle(m, function_of_vectors(x))

    def settle(self, center: Array, x: Array) -> Any:
        """Return center plus (x - center), (..., n): the states of vectors x as `chart_move` computes with them.

        In x, an attitude is center + r, with the rotation vector r from `center`; here it becomes the attitude that r
        leads to. All other components, angles too, stay as they are.
        """
        return self._replace_rotations(x, turn, center, x - center) if self.rotations else x

    def unsettle(self, center: Array, x: Array) -> Any:
        """Return center + (x difference center), (..., n), the inverse of `settle`.

        An attitude of x becomes center + r, with the rotation vector r from `center` to it, so that transforms of
        vectors can compute with it. All other components, angles too, stay as they are.
        """
        return self._replace_rotations(x, lambda r, other: other + turn_between(r, other), x, center)

    def reset_jacobian(self, change: jax.Array) -> jax.Array | None:
        """Return the matrix J (n, n) that maps errors about a state x to errors about x' = x plus `change`.

        A filter finds the change with an error d, whose covariance is P, and moves its estimate from x to x'. The error
        d' about x' is of the same state: x plus (change + d) = x' plus d'. So its covariance is J P J' with J = dd'/dd
        at d = 0. J is the identity but for attitudes, for which `plus` turns: there d' is the turn from `change` to
        change + d. None is returned if no state is an attitude.
        """
        if not self.rotations:
            return None
        matrix = jnp.eye(len(change), dtype=change.dtype)
        for i in range(0, len(self.rotations), 3):
            columns = np.array(self.rotations[i : i + 3])  # of one rotation vector
            rotation = change[columns]
            # Derivative by r of the turn from `rotation` to r, at r = rotation (3, 3).
            block = jax.jacfwd(lambda r, rotation=rotation: turn_between(r, rotation))(rotation)
            matrix = matrix.at[columns[:, None], columns].set(block)
        return matrix
