"""Whether a function of states knows that a full turn of an angle, or of an attitude, is none."""

from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compute_once
from heliograph.numerics.angle import TURN
from heliograph.numerics.check import fail
from heliograph.numerics.float64 import quickly_compiled
from heliograph.numerics.manifold import Manifold
from heliograph.numerics.traced import is_traced
from heliograph.random_affine.noise import Vector

SAME = 1e-6  # relative: what a full turn of 2 pi, known to rounding, may leave in a steep function
SOME_TURN = (0.3, -0.2, 0.5)  # radians about the three axes: no attitude is at rest there


def check_turns(
    name: str,
    function: Callable[..., jax.Array],
    center: Vector,
    given: Manifold,
    results: Manifold,
    *rest: np.ndarray,
) -> None:
    """Raise ValueError where a full turn of an angle or an attitude changes f(center), but for full turns of results.

    What depends on a traced number has no value to judge: it was judged where its numbers were known.

    Args:
        name: of what has the function, for the error.
        function: f.
        center: a state (n,).
        given: which components of a state are angles and attitudes.
        results: which components of f(x) are.
        rest: further arguments of f, such as inputs.
    """
    if not (given.angles or given.rotations) or is_traced(center):
        return
    # Angles: the center with a full turn more in each of them.
    center = np.asarray(center)
    turned = center + TURN * np.eye(len(center))[list(given.angles)]
    _compare_turned(f"{name} with circular states", function, center, turned, results, rest)
    # Attitudes: f is asked at a general state, since the center's attitude may be a special case, such as no turn at
    # all. Every attitude there has a second rotation vector, a full turn longer, at which f has to be the same.
    change = np.zeros(len(center))
    change[list(given.rotations)] = np.resize(SOME_TURN, len(given.rotations))
    general_state = given.plus(center, change)
    others = [_turn_fully(general_state, given.rotations[i : i + 3]) for i in range(0, len(given.rotations), 3)]
    ones = tuple(np.ones_like(values) for values in rest)  # inputs of 0, such as turn rates, could hide a change
    kind = f"{name} with an attitude (hg.models.turn_attitude turns one, hg.models.rotation_matrix has its axes)"
    _compare_turned(kind, function, general_state, others, results, ones)


def _compare_turned(
    name: str,
    function: Callable[..., jax.Array],
    center: np.ndarray,
    turned: Sequence[np.ndarray] | np.ndarray,
    results: Manifold,
    rest: tuple[np.ndarray, ...],
) -> None:
    """Raise ValueError where f differs, by more than full turns of its results, at states that are one and the same.

    Args:
        name: of what has the function, for the error.
        function: f.
        center: a state (n,).
        turned: the same state with full turns in some components, each (n,).
        results: which components of f(x) are angles and attitudes.
        rest: further arguments of f.
    """
    if not len(turned):
        return
    # f at the state and at each of its other forms, by one compiled program.
    try:
        at_center, *values = compute_once(_values_at, _values_by_xla, (function, np.stack([center, *turned]), rest))
    except jax.errors.TracerArrayConversionError:  # the function holds a traced number
        return
    # What is more than full turns of the results, and more than the rounding of 2 pi in a steep function.
    for value, other in zip(values, turned, strict=True):
        change = np.abs(results.difference(np.asarray(value), np.asarray(at_center)))
        if np.any(change > SAME * (1 + np.abs(at_center))):
            turned_states = np.flatnonzero(other != center).tolist()
            named = f"state {turned_states[0]}" if len(turned_states) == 1 else f"states {turned_states}"
            got = f"a change of {change.max():.3g} by a turn of {named}"
            raise fail(name, "one that a full turn does not change", got)


def _turn_fully(x: np.ndarray, places: Sequence[int]) -> np.ndarray:
    """Return the state with another rotation vector of the same attitude: the turn back, the long way round.

    Args:
        x: the state.
        places: of the rotation vector's three components in it.
    """
    r = x[list(places)]
    other: np.ndarray = x.copy()
    other[list(places)] = r * (1 - TURN / np.linalg.norm(r))
    return other


def _values_at(function: Callable[..., jax.Array], points: jax.Array, rest: tuple[jax.Array, ...]) -> jax.Array:
    """Return f(x) at each of some points x."""
    return jnp.stack([jnp.asarray(function(point, *rest)) for point in points])


_values_by_xla = quickly_compiled(_values_at)
