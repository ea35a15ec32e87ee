"""Edges between neighbours: a channel each, of which only matters whether, and how late, a message arrives.

`degree`: most messages that a node receives, its own counted first. `rounds`: exchanges of messages within a step.
"""

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
from heliograph.numerics.numpy_or_jax import library, plain
from heliograph.numerics.types import ArrayLike, Bool, Int, PyTree, Scalar
from heliograph.random_affine.base import AbstractRandomAffine, inner_maps
from heliograph.random_affine.delay import DelayedLink, signal_size
from heliograph.random_affine.erasure import Erasure
from heliograph.random_affine.modes import Modes
from heliograph.random_affine.moments.second_moments import second_order
from heliograph.simulation.centres.uplinks import SentReports
from heliograph.simulation.transmission.channel_draws import (
    ChannelGroup,
    deliver_signal,
    group_channels,
    start_channel,
)

Recorded = Mapping[str, SentReports | ArrayLike]


class MeshEdges(Module):
    """All edges of a fusion between neighbours: draws of what arrives over them.

    Args:
        groups: the edges' channels, those of one structure stacked; without any, nothing is ever lost.
        slots: where each edge lies in the flattened (node, degree), by edge.
        present: whether the node has a neighbour there (node, degree), itself at 0.
        rounds: exchanges within a step.
        past: most steps by which a message may be late. If it is above 0, what arrives is given by ages in place of
            flags: the age of the message in steps, -1 where none arrives.
    """

    groups: tuple[ChannelGroup, ...]
    slots: np.ndarray
    present: np.ndarray
    rounds: int = eqx.field(static=True)
    past: int = eqx.field(static=True, default=0)

    def init(self, key: jax.Array) -> tuple[PyTree, ...]:
        """Return the initial states of the edges' channels for the run with this key, one for each group of channels.

        A group is a stack of channels of one structure.
        """

        def start_group(group: ChannelGroup) -> PyTree:
            """Return the initial state of one channel of a stack, drawn by the run's key."""
            return start_channel(group.channel, key, group.checksums, group.memories)

        return tuple(eqx.filter_vmap(start_group, in_axes=(eqx.if_array(0),))(group) for group in self.groups)

    def draw(self, states: tuple[PyTree, ...], key: jax.Array, k: jax.Array) -> tuple[tuple[PyTree, ...], jax.Array]:
        """Draw what arrives at step k of the run with this key, in each round of exchange.

        Args:
            states: states of the channels before the step, one for each group (a stack of channels of one structure).
            key: random key of the run.
            k: number of the step.

        Returns:
            The channels' states after the step, and what arrives (node, rounds, degree): flags or, if messages may be
            late, the ages of messages in steps, -1 if none arrives. A node's own message, at 0, always arrives.
        """
        arrivals_by_round = []
        # One exchange after another; the channels go on from one to the next.
        for round_number in range(self.rounds):
            arrives, next_states = jnp.asarray(self.lossless()[:, 0]), []
            for group, state in zip(self.groups, states, strict=True):
                exchange = k * self.rounds + round_number  # its number in the run
                after, by_edge = self._draw_group(group, state, key, k, exchange)
                next_states.append(after)
                # Each edge of the group has its place in the flattened (node, degree).
                arrives = arrives.ravel().at[self.slots[group.indices]].set(by_edge).reshape(arrives.shape)
            states = tuple(next_states)
            arrivals_by_round.append(arrives)
        return states, jnp.stack(arrivals_by_round, axis=1)

    def _draw_group(
        self, group: ChannelGroup, state: PyTree, key: jax.Array, k: jax.Array, count: jax.Array
    ) -> tuple[PyTree, jax.Array]:
        """Send one message over each channel of a group: return their next states, and flags or ages of what arrives.

        Args:
            group: channels of one structure from neighbour to neighbour, stacked along a leading axis of edges.
            state: states of these channels, with the same axis.
            key: random key of the run.
            k: number of the step, which selects the channel if it varies over time.
            count: how many messages each edge sent before, which seeds the draws.
        """

        def deliver_once(edge: ChannelGroup, state: PyTree, count: jax.Array) -> tuple[PyTree, jax.Array]:
            """Return the next state of one edge's channel, and what arrives of a message sent over it at step k.

            What arrives is a flag or, if messages may be late, the message's age in steps (-1 if nothing arrives).
            `count`: the number of the exchange. With `key` it determines the random draw.
            """
            # Send zeros, since only arrival matters here: lost numbers are NaN, and a time stamp is the last number.
            channel = at(edge.channel, k)
            state, z = deliver_signal(channel, state, jnp.zeros(signal_size(channel)), key, count,
                                      edge.checksums, edge.memories)  # fmt: skip
            arrives, delay = ~jnp.any(jnp.isnan(z)), find_delay(channel)
            if not self.past:  # no message is ever late: a flag says all
                return state, arrives
            age: jax.Array | int = 0
            if delay is not None:
                age = z[-1].astype(int) if delay.timestamped else delay.times[0]
            # A message cannot be older than the run: nothing was sent before the first step.
            return state, jnp.where(arrives & (age <= count), age, -1)

        deliver_all = eqx.filter_vmap(deliver_once, in_axes=(eqx.if_array(0), 0, None))
        after, arrives = deliver_all(group, state, count)
        return after, arrives

    def lossless(self) -> Bool[np.ndarray, "node rounds degree"] | Int[np.ndarray, "node rounds degree"]:
        """Return what arrives at a step without losses and delays, (node, rounds, degree).

        The entries are flags: True where there is a neighbour. If messages may be late (`self.past` > 0), they are
        ages: 0 where there is a neighbour, -1 where there is none.
        """
        xp = library(self.present)  # NumPy outside a trace, JAX inside
        flags = xp.where(self.present, 0, -1) if self.past else self.present
        repeated: np.ndarray = xp.repeat(flags[:, None], self.rounds, axis=1)
        return repeated

    def read_recorded(
        self, name: str, nodes: Sequence[str], reports: Recorded | None, steps: int
    ) -> Bool[np.ndarray, "time node rounds degree"]:
        """Return the flags of each step, or ages where messages may be late, from a recording.

        In a fusion between neighbours nodes exchange messages in several rounds within a step. The recording says which
        messages arrived, so that the run over it loses the same ones. On the last axis of the result a node's own
        message is at 0, and its neighbours follow.

        Args:
            name: of the fusion.
            nodes: names of its nodes.
            reports: recorded arrivals of each node that has neighbours: (steps, rounds times neighbours), NaN where
                nothing arrived, else the message's age in steps (any number if no message can be late); None if nothing
                was recorded.
            steps: number of steps.

        Raises:
            ValueError: nodes without flags or the reverse, shapes that do not fit, ages that the links do not have.
        """
        # Start from `lossless`: every message arrives at once. The reports below replace this.
        flags = np.repeat(self.lossless()[None], steps, axis=0)
        # Without random links (`groups` is empty) nothing is ever lost, and no report is needed.
        if reports is None and not self.groups:
            return flags
        # There must be a report of each node with a neighbour (`present` (node, degree), the node itself at 0), and no
        # other.
        receivers = [node for node, row in zip(nodes, self.present, strict=True) if row[1:].any()]
        if reports is None or set(reports) != set(receivers):
            given = "none" if reports is None else list(reports)
            raise fail(f"reports of fusion {name!r}", f"what arrived from the neighbours of {receivers}", given)
        for i, node in enumerate(nodes):
            if node in reports:
                ages = self._read_ages(node, reports[node], steps, neighbours=int(self.present[i, 1:].sum()))
                # Ages of -1 mean lost. They are kept as ages if messages may be late (`past` > 0), else reduced to
                # flags.
                flags[:, i, :, 1 : ages.shape[2] + 1] = ages if self.past else ages >= 0
        return flags

    def _read_ages(
        self, node: str, report: SentReports | ArrayLike, steps: int, neighbours: int
    ) -> Int[np.ndarray, "steps rounds neighbours"]:
        """Return the ages in steps of the messages that a node received, from its report; -1 means that none arrived.

        `neighbours`: number of the node's neighbours. `self.past`: the most steps by which a message may be late.

        Raises:
            ValueError: an age that is no whole number from 0 to `self.past`.
        """
        numbers = report.values if isinstance(report, SentReports) else report
        values = array(f"reports of node {node!r}", numbers, (steps, self.rounds * neighbours), missing=True)
        values = values.reshape(steps, self.rounds, neighbours)
        if self.past and not np.isin(values[~np.isnan(values)], np.arange(self.past + 1)).all():
            expected = f"ages of what arrives, from 0 to {self.past} steps, NaN where nothing does"
            raise fail(f"reports of node {node!r}", expected, "other numbers")
        return np.where(np.isnan(values), -1, values).astype(int)


def build_edges(fusion: Fusion, graph: Graph) -> MeshEdges:
    """Build the edges of a fusion between neighbours.

    Raises:
        ValueError: links of edges that do not exist, links that change messages, or unknown losses or delays.
    """
    if fusion.link is None:
        return MeshEdges((), np.zeros(0, dtype=int), graph.present, fusion.rounds)
    links = links_by_edge(fusion.link, graph)
    # One channel under many names is checked once.
    distinct = {id(channel): (name, channel) for name, channel in links.items()}
    for name, channel in distinct.values():
        check_edge(f"link {name!r}" if isinstance(fusion.link, Mapping) else "link between neighbours", channel)
    # Places of the edges in the flattened (node, degree). Place 0 of each node is the node itself, and no edge.
    slots = np.flatnonzero(graph.present & (np.arange(graph.present.shape[1]) > 0))
    past = max(first(channel).past for channel in links.values())
    return MeshEdges(group_channels(links), slots, graph.present, fusion.rounds, past)


def links_by_edge(link: Channel | Mapping[str, Channel], graph: Graph) -> dict[str, Channel]:
    """Return the link of each edge by the edge's name "SENDER to RECEIVER", receiver after receiver.

    An edge is a pair of neighbours. `link`: one link for all edges, or a link for each name.
    """
    names = [f"{graph.nodes[sender]} to {graph.nodes[receiver]}" for sender, receiver in graph.edges]
    # One link for each name; raises, with these words, where a name has none.
    title, label = "links between neighbours", "edge SENDER to RECEIVER"
    return dict(zip(names, spread_over_names(title, link, names, label), strict=True))


def check_edge(what: str, link: Channel) -> None:
    """Raise ValueError if a link changes its messages, or if the receiver does not know of its losses or delays.

    Neighbours weigh an estimate that they received as if it were the sender's: a link may lose or delay it, but not
    change it. `what`: the link in words, for the error.
    """
    instance(what, first(link), AbstractRandomAffine, "a channel such as erasure(perfect(), 0.8)")
    for step in unstack(link):
        # The receiver knows a delay that is the same for all messages, or is stamped on the message.
        delay = find_delay(step)
        if delay is not None and not (delay.constant or delay.timestamped):
            raise fail(what, "delays that the receiver knows (timestamped=True)", "others")
        # What is left inside losses and delays, and inside the losses of each mode, must change nothing.
        _, inside = _split_losses_from_link(step, Erasure | DelayedLink)
        for mode_link in inside.maps if isinstance(inside, Modes) else [inside]:
            _, mode = _split_losses_from_link(mode_link)
            if mode.remembers or mode.past or not _is_perfect(mode):
                expected = "messages that arrive as they are or are lost, and the receiver knows (erasure of perfect())"
                raise fail(what, expected, type(first(link)).__name__)


def find_delay(channel: AbstractRandomAffine) -> DelayedLink | None:
    """Return the delay inside a link, whose messages may also be lost; None of a link without delay."""
    _, inside = _split_losses_from_link(channel)
    return inside if isinstance(inside, DelayedLink) else None


def _split_losses_from_link(
    channel: AbstractRandomAffine, kinds: type | UnionType = Erasure
) -> tuple[Scalar, AbstractRandomAffine]:
    """Return the probability that a message passes all outer losses, and the map inside the outer maps.

    `kinds`: the types of the outer maps to take off. Only erasures among them lose messages.
    """
    arrival: Scalar = 1.0
    while isinstance(channel, kinds):
        arrival = arrival * plain(channel.arrival) if isinstance(channel, Erasure) else arrival
        channel = inner_maps(channel)[0]
    return arrival, channel


def find_arrival_probability(channel: Channel | None) -> float | None:
    """Return the probability that a message arrives, or None if there is no one probability.

    It is 1 without a channel (`channel` is None). It is None if the probability differs between steps, or depends on
    earlier steps through the modes of the channel.
    """
    if channel is None or isinstance(channel, OverTime):
        return 1.0 if channel is None else None
    chance, inside = _split_losses_from_link(channel)
    return None if inside.erases else float(chance)


def find_loss_decay(channel: Channel | None) -> float | None:
    """Return the factor by which each further loss in a row is less probable, in the long run.

    Without modes it is the probability of a loss. With modes it is the spectral radius of diag(l) P, where l are the
    modes' loss probabilities and P their transitions. It is 0 without a channel (None), and the result is None if the
    channel varies over time or shares its modes with other edges.
    """
    if channel is None or isinstance(channel, OverTime):
        return 0.0 if channel is None else None
    arrival, inside = _split_losses_from_link(channel, Erasure | DelayedLink)
    if not isinstance(inside, Modes):
        return None if inside.erases else 1 - float(arrival)
    chances = [find_arrival_probability(mode) for mode in inside.maps]
    if inside.memory.name is not None or None in chances:
        return None
    loss_probabilities = 1 - float(arrival) * np.array(chances, dtype=float)  # l, by mode
    losses_in_a_row = loss_probabilities[:, None] * np.asarray(inside.memory.transition)  # diag(l) P
    return float(np.abs(np.linalg.eigvals(losses_in_a_row)).max())


def _is_perfect(channel: AbstractRandomAffine) -> bool:
    """Return whether a channel delivers exactly what is sent: gain I, no offset, no noise and no random gains.

    `center`: the covariance of (gains, offset), which is 0 without noise and random gains.
    """
    if channel.inputs != channel.outputs:
        return False
    moments = second_order(channel.condition_on_arrival())
    is_identity = np.array_equal(moments.mean_gain, np.eye(channel.inputs)) and not np.any(moments.offset)
    has_noise = np.any(moments.nominal.center)
    return is_identity and not has_noise
