"""Edges between neighbours: a channel each, of which only matters what arrives."""

from collections.abc import Mapping, Sequence
from types import UnionType

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.fusion.mesh.graph import Graph
from heliograph.fusion.network_fusion import Fusion
from heliograph.model.channel import Channel
from heliograph.model.over_time import OverTime, at, first, unstack
from heliograph.numerics.check import array, fail, instance, spread_over_names
from heliograph.numerics.module import Module
from heliograph.numerics.traced import library, plain
from heliograph.numerics.types import ArrayLike, Bool, Int, PyTree, Scalar
from heliograph.random_affine.base import AbstractRandomAffine, inner_maps
from heliograph.random_affine.delay import Delayed, signal_size
from heliograph.random_affine.erasure import Erasure
from heliograph.random_affine.modes import Modes
from heliograph.random_affine.moments.second_moments import second_order
from heliograph.simulation.centres.uplinks import SentReports
from heliograph.simulation.transmission.shared_fading import (
    ChannelGroup,
    channel_groups,
    deliver_signal,
    start,
)

Recorded = Mapping[str, SentReports | ArrayLike]


class MeshEdges(Module):
    """All edges of a fusion between neighbours, by what arrives over them; without groups nothing is ever lost.

    `present` (node, degree): whether the node has a neighbour there, itself at 0. `slots` (edge,): where an edge lies
    in the flattened (node, degree). `rounds`: exchanges within a step. Where messages may be up to `past` steps late,
    a flag is the age of the message that arrives, -1 where none does.
    """

    groups: tuple[ChannelGroup, ...]
    slots: np.ndarray
    present: np.ndarray
    rounds: int = eqx.field(static=True)
    past: int = eqx.field(static=True, default=0)

    def init(self, key: jax.Array) -> tuple[PyTree, ...]:
        """Return the states of the channels before the first step."""

        def start_group(group: ChannelGroup) -> PyTree:
            """Return the initial state of one channel of a stack."""
            return start(group.channel, key, group.checksums, group.memories)

        return tuple(eqx.filter_vmap(start_group, in_axes=(eqx.if_array(0),))(group) for group in self.groups)

    def draw(self, states: tuple[PyTree, ...], key: jax.Array, k: jax.Array) -> tuple[tuple[PyTree, ...], jax.Array]:
        """Draw what arrives at step k in each round: next states, and flags or ages (node, rounds, degree)."""
        rounds = []
        # One exchange after another, each with its draws; channels with memory go on from one to the next.
        for number in range(self.rounds):
            flags, following = jnp.asarray(self.lossless()[:, 0]), []
            for group, state in zip(self.groups, states, strict=True):

                def deliver_once(edge: ChannelGroup, state: PyTree, count: jax.Array) -> tuple[PyTree, jax.Array]:
                    """Send a message over one edge: the channel's next state, and the flag or age of what arrives."""
                    channel = at(edge.channel, k)
                    state, z = deliver_signal(channel, state, jnp.zeros(signal_size(channel)), key, count,
                                              edge.checksums, edge.memories)  # fmt: skip
                    arrives, late = ~jnp.any(jnp.isnan(z)), late_part(channel)
                    if not self.past:
                        return state, arrives
                    age: jax.Array | int = 0
                    if late is not None:
                        age = z[-1].astype(int) if late.timestamped else late.times[0]
                    # Nothing was sent before the first step.
                    return state, jnp.where(arrives & (age <= count), age, -1)

                # All channels of one kind at once; their flags go to the places of the edges.
                deliver_all = eqx.filter_vmap(deliver_once, in_axes=(eqx.if_array(0), 0, None))
                state, arrives = deliver_all(group, state, k * self.rounds + number)
                following.append(state)
                flags = flags.ravel().at[self.slots[group.places]].set(arrives).reshape(flags.shape)
            states = tuple(following)
            rounds.append(flags)
        return states, jnp.stack(rounds, axis=1)

    def lossless(self) -> Bool[np.ndarray, "node rounds degree"] | Int[np.ndarray, "node rounds degree"]:
        """Return the flags of a step at which everything arrives at once.

        Of messages that may be late they are ages, 0 of a neighbour and -1 of none; else whether there is a neighbour.
        """
        module = library(self.present)
        flags = module.where(self.present, 0, -1) if self.past else self.present
        repeated: np.ndarray = module.repeat(flags[:, None], self.rounds, axis=1)
        return repeated

    def recorded(
        self, name: str, nodes: Sequence[str], reports: Recorded | None, steps: int
    ) -> Bool[np.ndarray, "time node rounds degree"]:
        """Return the flags of each step, or ages where messages may be late, from a recording.

        `reports`: for each node that has neighbours (steps, rounds times neighbours), NaN where nothing arrived.

        Raises:
            ValueError: nodes without flags or the reverse, shapes that do not fit.
        """
        flags = np.repeat(self.lossless()[None], steps, axis=0)
        # Everything arrives, unless a report says otherwise.
        if reports is None and not self.groups:
            return flags
        receivers = [node for node, there in zip(nodes, self.present, strict=True) if there[1:].any()]
        if reports is None or set(reports) != set(receivers):
            given = "none" if reports is None else list(reports)
            raise fail(f"reports of fusion {name!r}", f"what arrived from the neighbours of {receivers}", given)
        for i, node in enumerate(nodes):
            if node not in reports:
                continue
            report = reports[node]
            count = int(self.present[i, 1:].sum())
            values = array(f"reports of node {node!r}", report.values if isinstance(report, SentReports) else report,
                           (steps, self.rounds * count), missing=True)  # fmt: skip
            values = values.reshape(steps, self.rounds, count)
            if self.past and not np.isin(values[~np.isnan(values)], np.arange(self.past + 1)).all():
                expected = f"ages of what arrives, from 0 to {self.past} steps, NaN where nothing does"
                raise fail(f"reports of node {node!r}", expected, "other numbers")
            ages = np.where(np.isnan(values), -1, values).astype(int)
            flags[:, i, :, 1 : count + 1] = ages if self.past else ages >= 0
        return flags


def build_edges(fusion: Fusion, graph: Graph) -> MeshEdges:
    """Build the edges of a fusion between neighbours.

    Raises:
        ValueError: links of other edges, links that do more to a message than lose it, or of which nobody knows.
    """
    if fusion.link is None:
        return MeshEdges((), np.zeros(0, dtype=int), graph.present, fusion.rounds)
    links = edge_links(fusion.link, graph)
    for name, channel in {id(c): (name, c) for name, c in links.items()}.values():
        check_edge(f"link {name!r}" if isinstance(fusion.link, Mapping) else "link between neighbours", channel)
    slots = np.flatnonzero(graph.present & (np.arange(graph.present.shape[1]) > 0))
    past = max(first(channel).past for channel in links.values())
    return MeshEdges(channel_groups(links), slots, graph.present, fusion.rounds, past)


def edge_links(link: Channel | Mapping[str, Channel], graph: Graph) -> dict[str, Channel]:
    """Return the link of each edge by its name "SENDER to RECEIVER", receiver after receiver."""
    names = [f"{graph.nodes[sender]} to {graph.nodes[receiver]}" for sender, receiver in graph.edges]
    return dict(
        zip(names, spread_over_names("links between neighbours", link, names, "edge SENDER to RECEIVER"), strict=True)
    )


def check_edge(what: str, link: Channel) -> None:
    """Refuse a link that changes a message, and losses or delays that the receiver does not know of."""
    instance(what, first(link), AbstractRandomAffine, "a channel such as erasure(perfect(), 0.8)")
    for step in unstack(link):
        late = late_part(step)
        if late is not None and not (late.constant or late.timestamped):
            raise fail(what, "delays that the receiver knows (timestamped=True)", "others")
        inside = _open_link(step, Erasure | Delayed)[1]
        for mode in (_open_link(m)[1] for m in (inside.maps if isinstance(inside, Modes) else [inside])):
            if mode.remembers or mode.past or not _is_perfect(mode):
                expected = "messages that arrive as they are or are lost, and the receiver knows (erasure of perfect())"
                raise fail(what, expected, type(first(link)).__name__)


def late_part(channel: AbstractRandomAffine) -> Delayed | None:
    """Return the delay of a link, whose messages may also be lost; None of one without."""
    inside = _open_link(channel)[1]
    return inside if isinstance(inside, Delayed) else None


def _open_link(channel: AbstractRandomAffine, kinds: type | UnionType = Erasure) -> tuple[Scalar, AbstractRandomAffine]:
    """Return the probability that a message passes all outer maps of these kinds, and the map inside them."""
    arrival: Scalar = 1.0
    while isinstance(channel, kinds):
        arrival = arrival * plain(channel.arrival) if isinstance(channel, Erasure) else arrival
        channel = inner_maps(channel)[0]
    return arrival, channel


def arrival_chance(channel: Channel | None) -> float | None:
    """Return the probability that a message arrives; None where it differs between steps or depends on earlier ones."""
    if channel is None or isinstance(channel, OverTime):
        return 1.0 if channel is None else None
    chance, inside = _open_link(channel)
    return None if inside.erases else float(chance)


def find_loss_decay(channel: Channel | None) -> float | None:
    """Return the factor by which each further loss in a row is less probable, in the long run.

    Of modes with loss probabilities l and transitions P it is the spectral radius of diag(l) P; without modes the
    probability of a loss. None where the channel varies, or shares its modes with other edges.
    """
    if channel is None or isinstance(channel, OverTime):
        return 0.0 if channel is None else None
    arrival, inside = _open_link(channel, Erasure | Delayed)
    if not isinstance(inside, Modes):
        return None if inside.erases else 1 - float(arrival)
    chances = [arrival_chance(mode) for mode in inside.maps]
    if inside.memory.name is not None or None in chances:
        return None
    losses = 1 - float(arrival) * np.array(chances, dtype=float)
    return float(np.abs(np.linalg.eigvals(losses[:, None] * np.asarray(inside.memory.transition))).max())


def _is_perfect(channel: AbstractRandomAffine) -> bool:
    """Test whether a channel delivers what is sent."""
    if channel.inputs != channel.outputs:
        return False
    moments = second_order(channel.condition_on_arrival())
    same = np.array_equal(moments.mean_gain, np.eye(channel.inputs)) and not np.any(moments.offset)
    return same and not np.any(moments.nominal.center)
