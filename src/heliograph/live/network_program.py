"""The program of a network on live data: its step as a function of rows, and the input that is its time step."""

from functools import cached_property

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.live.stored.snapshot import Identity, network_identity
from heliograph.model.over_time import first, steps_covered
from heliograph.model.plant import TIME_STEP, AbstractPlant
from heliograph.numerics.caching import share_by_object
from heliograph.numerics.check import fail, instance
from heliograph.numerics.types import Array, Float
from heliograph.random_affine.memory import memories
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node
from heliograph.simulation.rows.row_smoother import RowSmoother
from heliograph.simulation.rows.row_step import RowStep

CUTS = ((0.0, 1.0), (0.25, 0.75), (1.0, 0.0))  # of an interval of length one, in the plant's own unit
TOLERANCE = 1e-9  # relative: a few products lose 1e-15


def time_input(network: Network) -> int | None:
    """Return the index of the plant's input dt, the time since the previous row; None if time counts steps.

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
    if memories(network.plant):
        raise fail("timeline", expected, "a plant with modes, whose law a row that is inserted would change")
    for name, node in network.nodes.items():
        if isinstance(node, Node) and memories(node.sensor):
            raise fail("timeline", expected, f"a sensor with modes, at node {name!r}")
        if isinstance(node, Node) and first(node.channel).remembers:
            raise fail("timeline", expected, f"a channel that remembers, at node {name!r}")
        if isinstance(node, Node) and node.trigger is not None:
            raise fail("timeline", expected, f"a sender with a trigger, at node {name!r}")
    return network.inputs.index(TIME_STEP)


def explain_unevenness(plant: AbstractPlant, dt: int) -> str:
    """Explain how a plant's prediction over an interval differs from that over its parts; "" if it does not.

    f(f(x, s), t) = f(x, s + t), A(s + t) = A(t) A(s), Q(s + t) = A(t) Q(s) A(t)' + Q(t), with A the Jacobian of f. We
    test these around the initial mean, with all other inputs 1; s = 0 and t = 0 are among the divisions.

    Args:
        plant: the plant, whose time step is an input.
        dt: index of this input.
    """
    mean, spread = np.asarray(plant.initial_mean), np.sqrt(np.diag(np.asarray(plant.initial_covariance)))
    cuts = np.array(CUTS)
    # At the initial mean, and one standard deviation from it.
    for x in (mean, mean + spread):
        whole = _integrate_parts(plant, dt, x, cuts.sum(axis=1, keepdims=True))
        parts = _integrate_parts(plant, dt, x, cuts)
        for i, (s, t) in enumerate(CUTS):
            for what, at_once, in_two in zip(("transition", "Jacobian", "noise"), whole, parts, strict=True):
                gap = float(np.abs(at_once[i] - in_two[i]).max())
                if not gap <= TOLERANCE * max(1.0, float(np.abs(at_once[i]).max())):
                    return (
                        f"{what} over {s:g} and then {t:g} differs by {gap:.3g} from that over {s + t:g}; give the "
                        "plant a function, and a noise, of dt that agree over the parts of an interval"
                    )
    return ""


@compile_on_call
def _integrate_parts(
    plant: AbstractPlant, dt: int, x: Float[Array, " n"], intervals: Float[Array, "cut part"]
) -> tuple[Float[Array, "cut n"], Float[Array, "cut n n"], Float[Array, "cut n n"]]:
    """Return for each cut the mean, transition matrix and noise covariance after its intervals, passed one by one.

    intervals (cut, part): lengths, in the plant's unit of time; the mean starts at x.
    """

    def integrate(parts: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return mean, transition matrix and noise covariance after intervals of these lengths."""
        n = len(x)
        state, matrix, spread = jnp.asarray(x), jnp.eye(n), jnp.zeros((n, n))
        for interval in parts:
            u = jnp.where(np.arange(len(plant.inputs)) == dt, interval, 1.0)
            a, moved = jax.jacfwd(plant.moves(u, state))(state), plant.transition(state, u)
            state, matrix, spread = (
                plant.manifold.settle(moved, moved + plant.noise_mean()),
                a @ matrix,
                a @ spread @ a.T + plant.noise_covariance(u),
            )
        return state, matrix, spread

    moved: tuple[jax.Array, jax.Array, jax.Array] = jax.vmap(integrate)(jnp.asarray(intervals))
    return moved


class NetworkProgram:
    """A network's step on rows, `step_rows`, one for each plant; plants come and go without compilation.

    `places` gives the columns of each filter's estimate and judgement among its outputs.

    `uneven` explains why the plant's intervals cannot be divided, "" if they can. Rows have `received` measurements and
    `given` inputs without the time step, whose number among the inputs is `dt`; None where time counts steps.

    Args:
        network: the network, with at least one filter.

    Raises:
        ValueError: no network, or one without filters.
    """

    def __init__(self, network: Network):
        instance("network", network, Network, "a Network")
        self.network, self.claims, self.dt = network, network.claims(), time_input(network)
        if not any(self.claims.values()):
            raise fail("network", "at least one filter to run", "none")
        self.uneven = "" if self.dt is None else explain_unevenness(first(network.plant), self.dt)
        # Sizes of a row: measurements of all nodes, and inputs other than dt.
        self.received = sum(node.received for node in network.nodes.values())
        self.given = len(network.inputs) - (self.dt is not None)
        self.step_rows = RowStep(network)
        self.places = self.step_rows.columns

    @cached_property
    def smoother(self) -> RowSmoother:
        """Return the smoother of these filters, compiled at the first call.

        Raises:
            ValueError: no filter that can be smoothed.
        """
        return RowSmoother(self.network, self.dt)

    @cached_property
    def identity(self) -> Identity:
        """Return the identity of the network and its program, which a saved timeline is compared with."""
        return network_identity(self.network, self.step_rows.program, {})


shared_program = share_by_object(NetworkProgram)  # returns a network's program, which it makes at the first call
