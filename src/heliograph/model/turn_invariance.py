"""Whether a function of states returns the same after a full turn (2 pi) of an angle, or of an attitude."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compute_once
from heliograph.numerics.angles.angle import TURN
from heliograph.numerics.angles.manifold import Manifold
from heliograph.numerics.check import fail
from heliograph.numerics.float64 import quickly_compiled
from heliograph.numerics.numpy_or_jax import is_traced
from heliograph.random_affine.noises.noise import Vector

SAME = 1e-6  # relative: what a full turn of 2 pi, known to rounding, may leave in a steep function
SOME_TURN = (0.3, -0.2, 0.5)  # radians, about the three axes or of any states: no attitude is at rest there
SOME_INPUTS = (0.6, 0.9, 0.7)  # above 0, as a time is; not whole, lest a full turn times one is full turns


class EqualStates(NamedTuple):
    """A state x, other vectors that are the same state by full turns of angles or attitudes, and f's other arguments.

    f(x, *rest) is then compared with f(x', *rest) for each x' among `turned`.
    """

    state: np.ndarray
    turned: Sequence[np.ndarray] | np.ndarray
    rest: tuple[np.ndarray, ...]


def check_turn_invariance(
    name: str,
    function: Callable[..., jax.Array],
    center: Vector,
    given: Manifold,
    results: Manifold,
    *rest: np.ndarray,
) -> None:
    """Raise ValueError where a full turn of an angle or an attitude changes f(center), but for full turns of results.

    A model must not depend on whether an angle is written as 0 or 2 pi, since a filter wraps its angles. f is computed
    at the center and at one general state; a change that only other states show is not found. A function of numbers
    that JAX traces has no value to compare: it was compared before, when its numbers were known.

    Args:
        name: name of the model that has the function, for the error.
        function: f.
        center: a state (n,).
        given: which components of a state are angles, and which are attitudes (rotation vectors).
        results: which components of f(x) are angles or attitudes.
        rest: further arguments of f, such as inputs.
    """
    if not (given.angles or given.rotations) or is_traced(center):
        return
    # A state that is no special case, with rates that are not 0: at 0 sin(angle / 2) and angle * rate hide.
    center = np.asarray(center)
    general_state = given.plus(center, np.resize(SOME_TURN, len(center)))
    example_rest = tuple(np.resize(SOME_INPUTS, len(values)) for values in rest)
    # Angles: a full turn more in each of them, at the center too.
    turns = TURN * np.eye(len(center))[list(given.angles)]
    if len(turns):
        cases = [
            EqualStates(center, center + turns, rest),
            EqualStates(general_state, general_state + turns, example_rest),
        ]
        _compare_turned(f"{name} with circular states", function, cases, results)
    # An attitude has a second rotation vector, the long way round its axis: f must agree at both.
    attitudes = [given.rotations[i : i + 3] for i in range(0, len(given.rotations), 3)]
    turned = [_turn_attitude_long_way_round(general_state, components) for components in attitudes]
    if turned:
        kind = f"{name} with an attitude (hg.models.turn_attitude turns one, hg.models.rotation_matrix has its axes)"
        _compare_turned(kind, function, [EqualStates(general_state, turned, example_rest)], results)


def _compare_turned(
    name: str, function: Callable[..., jax.Array], cases: Sequence[EqualStates], results: Manifold
) -> None:
    """Raise ValueError where f differs, by more than full turns of its results, at states that are one and the same.

    Angles of a state may be changed by full turns (2 pi) at any time, so that a plant's or sensor's function must not
    depend on them.

    Args:
        name: name of what has the function, for the error.
        function: f.
        cases: a state x, the same state with full turns, and the other arguments of f for these.
        results: which components of f(x) are angles and attitudes.
    """
    # One compiled program evaluates f at all points: x and the turned states of every case.
    points = np.concatenate([np.stack([case.state, *case.turned]) for case in cases])
    counts = [1 + len(case.turned) for case in cases]
    rest_by_point = [case.rest for case, count in zip(cases, counts, strict=True) for _ in range(count)]
    rests = tuple(np.stack(values) for values in zip(*rest_by_point, strict=True))  # (points, ...) of each argument
    # f at all points, in native code if there is any.
    try:
        values_at_points = np.asarray(compute_once(_evaluate_at_points, _values_by_xla, (function, points, rests)))
    except jax.errors.TracerArrayConversionError:  # the function holds a traced number
        return
    # Differences but for full turns, beyond the rounding of 2 pi in a steep function.
    for case, (value, *turned_values) in zip(cases, np.split(values_at_points, np.cumsum(counts)[:-1]), strict=True):
        for turned_value, turned in zip(turned_values, case.turned, strict=True):
            change = np.abs(results.difference(turned_value, value))
            if np.any(change > SAME * (1 + np.abs(value))):
                numbers = np.flatnonzero(turned != case.state).tolist()
                states = f"state {numbers[0]}" if len(numbers) == 1 else f"states {numbers}"
                got = f"a change of {change.max():.3g} by a turn of {states}"
                raise fail(name, "one that a full turn does not change", got)


def _turn_attitude_long_way_round(x: np.ndarray, components: Sequence[int]) -> np.ndarray:
    """Return the state with the other rotation vector of the same attitude, r (1 - 2 pi / |r|): the turn the other way.

    Args:
        x: the state.
        components: indices of the three components of the rotation vector r in the state.
    """
    r = x[list(components)]
    turned: np.ndarray = x.copy()
    turned[list(components)] = r * (1 - TURN / np.linalg.norm(r))
    return turned


def _evaluate_at_points(
    function: Callable[..., jax.Array], points: jax.Array, rests: tuple[jax.Array, ...]
) -> jax.Array:
    """Return f(x, ...), f the `function`, at each of some points x (points, n), one value after another.

    Point i gets entry i of each array in `rests` as further arguments of f.
    """
    return jnp.stack([jnp.asarray(function(x, *(values[i] for values in rests))) for i, x in enumerate(points)])


_values_by_xla = quickly_compiled(_evaluate_at_points)
