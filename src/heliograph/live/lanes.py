"""Steps of many plants of one network, the network's time, and where the outputs of a step stand in a row."""

from functools import cached_property, partial
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.codegen.engine import compiled
from heliograph.live.later import Sweeper
from heliograph.live.row_step import RowStep
from heliograph.live.snapshot import Identity, network_identity
from heliograph.model.estimate import Claim
from heliograph.model.over_time import first, steps_covered
from heliograph.model.plant import TIME_STEP, AbstractPlant
from heliograph.numerics.caching import shared
from heliograph.numerics.check import fail, instance
from heliograph.numerics.types import Array, Float, PyTree
from heliograph.simulation.network import FUSED, Network
from heliograph.simulation.node import Node
from heliograph.simulation.results.by_name import by_name
from heliograph.simulation.stepping import AllFilters, begun

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
    mean, spread = np.asarray(plant.initial_mean), np.sqrt(np.diag(np.asarray(plant.initial_covariance)))
    cuts = np.array(CUTS)
    # At the initial mean, and one standard deviation from it.
    for x in (mean, mean + spread):
        whole, parts = _moved(plant, dt, x, cuts.sum(axis=1, keepdims=True)), _moved(plant, dt, x, cuts)
        for i, (s, t) in enumerate(CUTS):
            for what, at_once, in_two in zip(("transition", "Jacobian", "noise"), whole, parts, strict=True):
                gap = float(np.abs(at_once[i] - in_two[i]).max())
                if not gap <= TOLERANCE * max(1.0, float(np.abs(at_once[i]).max())):
                    return (
                        f"{what} over {s:g} and then {t:g} differs by {gap:.3g} from that over {s + t:g}; give the "
                        "plant a function, and a noise, of dt that agree over the parts of an interval"
                    )
    return ""


@compiled
def _moved(
    plant: AbstractPlant, dt: int, x: Float[Array, " n"], intervals: Float[Array, "cut part"]
) -> tuple[Float[Array, "cut n"], Float[Array, "cut n n"], Float[Array, "cut n n"]]:
    """Return state, Jacobian and noise covariance after the parts of each cut."""

    def after(parts: jax.Array) -> tuple[jax.Array, jax.Array, jax.Array]:
        n = len(x)
        state, matrix, spread = jnp.asarray(x), jnp.eye(n), jnp.zeros((n, n))
        for interval in parts:
            u = jnp.where(np.arange(len(plant.inputs)) == dt, interval, 1.0)
            a = jax.jacfwd(plant.transition)(state, u)
            state, matrix, spread = (
                plant.transition(state, u) + plant.noise_mean(),
                a @ matrix,
                a @ spread @ a.T + plant.noise_covariance(u),
            )
        return state, matrix, spread

    moved: tuple[jax.Array, jax.Array, jax.Array] = jax.vmap(after)(jnp.asarray(intervals))
    return moved


class JudgementAt(NamedTuple):
    """Columns of the parts of a judgement."""

    distance: int
    arrived: int
    reason: int
    input: int


class WeighedAt(NamedTuple):
    """Columns of what a filter that weighs made of each of its components."""

    value: tuple[int, ...]
    variance: tuple[int, ...]
    weight: tuple[int, ...]


class TestedAt(NamedTuple):
    """Columns of a fused estimate's squared innovation, and of how many numbers arrived."""

    distance: int
    arrived: int


class FilterColumns(NamedTuple):
    """Columns of a filter's estimate among the outputs: first of its mean, first of its covariance, and its judgement.

    `judgement` is None for a fusion rule, which receives no measurement; `tested` has its squared innovation by what
    its nodes receive, and is None for all others. `weighed` is None of a filter that weighs nothing.
    """

    node: str
    filter: str
    claim: Claim
    mean: int
    covariance: int
    judgement: JudgementAt | None
    weighed: WeighedAt | None
    tested: TestedAt | None


class Lanes:
    """A network's step as a function of rows: (state, received, inputs, step number) to (state, outputs).

    The outputs are the leaves of the estimates and each filter's judgement of what it received; `places` gives their
    columns. A filter leaves out the measurements that it finds implausible. Plants come and go without compilation, and
    no bit of an estimate depends on which other rows are stepped in the same call.

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
        self.uneven = "" if self.dt is None else uneven(first(network.plant), self.dt)
        # Sizes of a row: measurements of all nodes, and inputs other than dt.
        self.received = sum(node.received for node in network.nodes.values())
        self.given = len(network.inputs) - (self.dt is not None)
        with jax.enable_x64(True):
            filters = AllFilters(network, judges=True, tests=True)
            for name, link in filters.reporting.items():
                if link.uplinks.groups:
                    expected = "reports that arrive as they are sent, or the fusion as a filter (centre_filter)"
                    raise fail(f"timeline: fusion {name!r}", expected, "links that chance has a part in")
            self.step_rows = RowStep(network, filters, begun(filters))
        self.places = self._places()

    @cached_property
    def sweeper(self) -> Sweeper:
        """Return the smoother of these filters, compiled at the first call.

        Raises:
            ValueError: no filter that can be smoothed.
        """
        return Sweeper(self.network, self.dt)

    @cached_property
    def identity(self) -> Identity:
        """Return the identity of the network and its program, which a saved timeline is compared with."""
        return network_identity(self.network, self.step_rows.program, {})

    def _places(self) -> tuple[FilterColumns, ...]:
        """Locate each filter's estimate, by reading a row that holds its own column numbers as a row of estimates."""
        outputs = self.step_rows.outputs
        numbered = jax.tree.map(lambda leaf: leaf.astype(int), outputs.tree(np.arange(float(outputs.size))))
        mean = by_name(self.network, numbered, lambda estimate: np.asarray(estimate.mean), -3)
        covariance = by_name(self.network, numbered, lambda estimate: np.asarray(estimate.covariance), -4)
        judged, weighed = self._judged(numbered), self._weighed(numbered)
        tested = {(FUSED, name): TestedAt(*map(int, columns)) for name, columns in numbered["tested"].items()}
        return tuple(
            FilterColumns(node, name, claim, int(mean[node][name].flat[0]), int(covariance[node][name].flat[0]),
                  judged[node].get(name), weighed.get((node, name)), tested.get((node, name)))
            for node, filters in self.claims.items()
            for name, claim in filters.items()
        )  # fmt: skip

    def _weighed(self, outcome: PyTree) -> dict[tuple[str, str], WeighedAt]:
        """Return the columns of what each filter that weighs made of its components, by node and filter."""
        parts = {
            name: [np.asarray(field)[f, i] for field in outcome["weighed"][kind]]
            for name, (kind, f, i) in self.network.places().items()
            if outcome["weighed"][kind] is not None
        }
        central = {(FUSED, name): list(at) for name, at in outcome["weighed_centrally"].items() if at is not None}
        return {
            name: WeighedAt(*(tuple(map(int, field)) for field in columns))
            for name, columns in (parts | central).items()
        }

    def _judged(self, outcome: PyTree) -> dict[str, dict[str, JudgementAt]]:
        """Return the columns of each part of a judgement, by node and filter."""
        judged = {"estimates": outcome["judged"], "fused": {}}
        parts = [by_name(self.network, judged, partial(_part, i), -2) for i in range(len(JudgementAt._fields))]
        by_node = {
            node: {name: JudgementAt(*(int(field[node][name]) for field in parts)) for name in filters}
            for node, filters in parts[0].items()
        }
        central = outcome["judged_centrally"]
        return by_node | {
            FUSED: {name: JudgementAt(*(int(column) for column in columns)) for name, columns in central.items()}
        }


shared_lanes = shared(Lanes)  # of a network, made at the first call


def _part(i: int, judged: PyTree) -> np.ndarray:
    return np.asarray(judged[i])
