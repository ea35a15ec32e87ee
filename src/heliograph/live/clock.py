"""Time of a network: step numbers, or seconds that an input counts; and whether intervals can be divided."""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.over_time import first, steps_covered
from heliograph.model.plant import AbstractPlant
from heliograph.numerics.check import fail
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node

TIME_STEP = "dt"  # the input that a plant of continuous time has
CUTS = ((0.0, 1.0), (0.25, 0.75), (1.0, 0.0))  # of an interval of length one, in the plant's own unit
TOLERANCE = 1e-9  # relative: a few products lose 1e-15


def time_input(network: Network) -> int | None:
    """Return the index of the plant's input that is the time since the previous row; None if time counts steps.

    Raises:
        ValueError: a plant with the input dt in a network with parts that need step numbers: they vary over time or
            have memory.
    """
    if TIME_STEP not in network.inputs:
        return None
    expected = f"no part that goes by steps where the plant's time does not (its input {TIME_STEP!r})"
    if steps_covered(network) is not None:
        raise fail("timeline", expected, f"one that covers {steps_covered(network)} steps")
    if network.relays is not None:
        raise fail("timeline", expected, "relays that talk in slots")
    for name, node in network.nodes.items():
        if isinstance(node, Node) and first(node.channel).remembers:
            raise fail("timeline", expected, f"a channel that remembers, at node {name!r}")
        if isinstance(node, Node) and node.trigger is not None:
            raise fail("timeline", expected, f"a sender with a trigger, at node {name!r}")
    return network.inputs.index(TIME_STEP)


def uneven(plant: AbstractPlant, dt: int) -> str:
    """Explain how a plant's prediction over an interval differs from that over its parts; "" if it does not.

    f(f(x, s), t) = f(x, s + t), A(s + t) = A(t) A(s), Q(s + t) = A(t) Q(s) A(t)' + Q(t), with A the Jacobian of f. We
    test these around the initial mean, with all other inputs 1; s = 0 and t = 0 are among the divisions.
    """
    with jax.enable_x64(True):
        mean, spread = np.asarray(plant.initial_mean), np.sqrt(np.diag(np.asarray(plant.initial_covariance)))
        # At the initial mean, and one standard deviation from it.
        for x in (mean, mean + spread):
            for s, t in CUTS:
                whole, parts = _moved(plant, dt, x, (s + t,)), _moved(plant, dt, x, (s, t))
                for what, item, two in zip(("transition", "Jacobian", "noise"), whole, parts, strict=True):
                    gap = float(np.abs(item - two).max())
                    if not gap <= TOLERANCE * max(1.0, float(np.abs(item).max())):
                        return f"{what} over {s:g} and then {t:g} differs by {gap:.3g} from that over {s + t:g}"
    return ""


def _moved(
    plant: AbstractPlant, dt: int, x: np.ndarray, parts: tuple[float, ...]
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return state, Jacobian and noise covariance after these intervals."""
    n = len(x)
    state, matrix, spread = jnp.asarray(x), jnp.eye(n), jnp.zeros((n, n))
    for part in parts:
        u = jnp.ones(len(plant.inputs)).at[dt].set(part)
        a = jax.jacfwd(plant.transition)(state, u)
        state, matrix, spread = (
            plant.transition(state, u) + plant.noise_mean(), a @ matrix, a @ spread @ a.T + plant.noise_covariance(u),
        )  # fmt: skip
    return np.asarray(state), np.asarray(matrix), np.asarray(spread)
