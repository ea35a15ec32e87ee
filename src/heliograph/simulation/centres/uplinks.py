"""Uplinks of a fusion by reports: quantizers, random channels and delays."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.fusion.network_fusion import Fusion
from heliograph.fusion.quantizer import AbstractQuantizer
from heliograph.fusion.report_link import ReportModel
from heliograph.model.channel import Channel, perfect
from heliograph.model.over_time import OverTime, at, at_each_step, stack
from heliograph.numerics.check import array, fail
from heliograph.numerics.module import Module, readable
from heliograph.numerics.types import Array, ArrayLike, PyTree
from heliograph.random_affine.moments.second_moments import SecondOrder
from heliograph.simulation.centres.observation_model import describe_channel
from heliograph.simulation.random_keys import CHANNEL, draw_key
from heliograph.simulation.transmission.shared_fading import ChannelGroup, channel_groups


class UplinkDraws(NamedTuple):
    """Draws of the uplinks at one step: z = G m + n, NaN where lost, received `delay` steps later.

    Shapes: gain (node, m, n), offset (node, m), NaN in rows that a node lacks, delay (node,).
    """

    gain: Array
    offset: Array
    delay: Array


@readable
class SentReports(NamedTuple):
    """Received values of a node's reports, by the step at which they were sent, and their delays in steps.

    Args:
        values: (..., time, m), NaN where a report never arrived.
        delay: (..., time).
    """

    values: ArrayLike
    delay: ArrayLike


class InFlight(NamedTuple):
    """Reports in transit, by the steps since they were sent, from one; their delays; and the quantizers' states."""

    values: jax.Array
    delays: jax.Array
    quantizers: PyTree


class Uplinks(Module):
    """All uplinks of one fusion: quantizers stacked, channels by structure, delays and intervals by node.

    `delay` (node, ages): probability of each delay in steps. `every` (node,): steps from one report to the next.
    `links`: the centre's model of them.
    """

    groups: tuple[ChannelGroup, ...]
    quantizers: AbstractQuantizer | None
    links: ReportModel | OverTime
    delay: np.ndarray
    every: np.ndarray
    received: tuple[int, ...] = eqx.field(static=True)  # numbers that arrive of each node's report
    n: int = eqx.field(static=True)

    @property
    def rows(self) -> np.ndarray:
        """Places of the numbers that may arrive among (age, node, m) flattened."""
        exists = np.arange(max(self.received)) < np.array(self.received)[:, None]
        return np.flatnonzero(np.broadcast_to(exists, (self.delay.shape[1], *exists.shape)))

    def init(self) -> InFlight:
        """Return the state with no report in transit."""
        nodes, ages = self.delay.shape
        values = jnp.full((ages - 1, nodes, max(self.received)), jnp.nan)
        begin = eqx.filter_vmap(lambda q: q.init(self.n), in_axes=(eqx.if_array(0),), axis_size=nodes)
        start = () if self.quantizers is None else begin(self.quantizers)
        return InFlight(values, jnp.zeros((ages - 1, nodes), dtype=int), start)

    def draw(self, key: jax.Array, k: jax.Array) -> UplinkDraws:
        """Draw the uplinks of step k in the run with this key; the same for all fusions of the same nodes."""
        nodes, m, n = len(self.received), max(self.received), self.n
        # Lossless links, where nothing is random.
        gain = jnp.zeros((nodes, m, n)) if self.groups else jnp.tile(jnp.eye(n), (nodes, 1, 1))
        offset = jnp.where(np.arange(m) < np.array(self.received)[:, None], 0.0, jnp.nan)
        delay = self.fixed_delay
        # Channels and delays, independently for each node.
        for group in self.groups:
            places = jnp.asarray(group.places)

            def draw_link(channel: Channel, source: jax.Array, law: jax.Array) -> tuple[jax.Array, jax.Array]:
                """Draw the channel's matrix (m + 1, n + 1) and the delay of one node, of probabilities `law`."""
                of_channel, of_delay = jax.random.split(draw_key(key, k, source, CHANNEL))
                return at(channel, k).sample(of_channel), jax.random.choice(of_delay, len(law), p=law)

            draw_links = eqx.filter_vmap(draw_link, in_axes=(eqx.if_array(0), 0, 0))
            h, late = draw_links(group.channel, group.checksums, jnp.asarray(self.delay)[places])
            size = h.shape[1] - 1
            gain = gain.at[places, :size].set(h[:, :-1, :-1])
            offset = offset.at[places, :size].set(h[:, :-1, -1])
            delay = delay.at[places].set(late)
        return UplinkDraws(gain, offset, delay)

    def undrawn(self) -> UplinkDraws:
        """Return gains, offsets and delays of deterministic links."""
        nodes = len(self.received)
        return UplinkDraws(np.tile(np.eye(self.n), (nodes, 1, 1)), np.zeros((nodes, self.n)), self.fixed_delay)

    def recorded(
        self, name: str, nodes: Sequence[str], reports: Mapping[str, SentReports | ArrayLike] | None, steps: int
    ) -> UplinkDraws:
        """Return gains, offsets and delays of each step from a recording; (time, node, ...).

        Raises:
            ValueError: nodes without reports or the reverse, shapes that do not fit, delays that the links do not
                allow.
        """
        count, m = len(self.received), max(self.received)
        if reports is None and not self.groups:
            return UplinkDraws(*(np.broadcast_to(values, (steps, *np.shape(values))) for values in self.undrawn()))
        if reports is None or set(reports) != set(nodes):
            got = "none" if reports is None else list(reports)
            raise fail(f"reports of fusion {name!r}", f"those of {list(nodes)}", got)
        # z = 0 m + offset: the recorded values are offsets of links without gain.
        values, delay = np.full((steps, count, m), np.nan), np.tile(self.fixed_delay, (steps, 1))
        for i, node in enumerate(nodes):
            sent, size = reports[node], self.received[i]
            if isinstance(sent, SentReports):
                delay[:, i] = self._check_delay(f"delays of node {node!r}", sent.delay, steps, i)
                sent = sent.values
            values[:, i, :size] = array(f"reports of node {node!r}", sent, (steps, size), missing=True)
        return UplinkDraws(np.zeros((steps, count, m, self.n)), values, delay)

    def _check_delay(self, name: str, value: ArrayLike, steps: int, node: int) -> np.ndarray:
        """Return the delays of a node's reports (steps,); raise at one that its uplink does not have."""
        delays: np.ndarray = array(name, value, (steps,))
        possible = np.flatnonzero(self.delay[node] > 0)
        if not np.all(np.isin(delays, possible)):
            raise fail(name, f"each one of {possible.tolist()} steps", sorted(set(delays.tolist())))
        return delays.astype(int)

    @property
    def fixed_delay(self) -> jax.Array:
        """Most probable delay of each node, which is the only one where it is fixed."""
        return jnp.argmax(jnp.asarray(self.delay), axis=1)

    def send(
        self, state: InFlight, means: jax.Array, drawn: UplinkDraws, k: jax.Array
    ) -> tuple[InFlight, jax.Array, dict[str, jax.Array]]:
        """Send the reports of step k: next state, received values (node, m), whenever they arrive, and their traffic.

        A value that saturates a quantizer becomes an infinite number: nothing is known of it, and the estimate shows
        that.
        """
        # Only every d-th step sends; a quotient of multiples is exact, and native code has no remainder by a variable.
        step = jnp.asarray(k + 1, means.dtype)
        sending = (jnp.floor(step / self.every) * self.every == step)[:, None]
        values, traffic = jnp.where(sending, means, jnp.nan), {}
        saturated = jnp.zeros(len(means), dtype=bool)
        # Quantized reports; an infinite number stands for one that saturated.
        if self.quantizers is not None:
            quantize = eqx.filter_vmap(lambda q, s, mean: q.step(s, mean), in_axes=(eqx.if_array(0), 0, 0))
            quantizers, sent = quantize(self.quantizers, state.quantizers, values)
            state, values = state._replace(quantizers=quantizers), sent.value
            saturated = jnp.any(sent.saturated, axis=1)
            traffic = {"saturated": sent.saturated, "symbols": jnp.where(sending, sent.symbols, 0)}
        z = jnp.einsum("imn,in->im", drawn.gain, values) + drawn.offset
        return state, jnp.where(saturated[:, None], jnp.inf, z), traffic

    def arrive(self, state: InFlight, sent: jax.Array, delay: Array) -> tuple[InFlight, jax.Array]:
        """Return the next state, and what arrives now of this step's reports and earlier ones, (age, node, m)."""
        values = jnp.concatenate([sent[None], state.values])
        delays = jnp.concatenate([jnp.asarray(delay, dtype=state.delays.dtype)[None], state.delays])
        due = delays == np.arange(len(values))[:, None]
        return state._replace(values=values[:-1], delays=delays[:-1]), jnp.where(due[..., None], values, jnp.nan)


def uplinks_of(fusion: Fusion, nodes: Sequence[str], n: int) -> Uplinks:
    """Build the uplinks of these nodes to a centre that receives reports of n numbers."""
    links, quantizers = fusion.links(nodes), fusion.quantizers(nodes)
    ages = max(len(link.delay) for link in links)
    channels = [perfect(n) if link.channel is None else link.channel for link in links]
    # Without a channel, and with one certain delay each, nothing is drawn.
    random = any(link.channel is not None or np.max(link.delay) < 1 for link in links)
    named = {f"{node} to the fusion centre": channel for node, channel in zip(nodes, channels, strict=True)}
    # Received numbers of each node, and bounds on the quantizers' errors.
    received = tuple(link.received(n) for link in links)
    error = np.stack([q.error(n) for q in quantizers]) if quantizers else np.zeros((len(nodes), n))
    return Uplinks(
        groups=channel_groups(named) if random else (),
        quantizers=stack(quantizers) if quantizers else None,
        links=_model_links([describe_channel(channel) for channel in channels], received, error),
        delay=np.stack([np.pad(link.delay, (0, ages - len(link.delay))) for link in links]),
        every=np.array([link.every for link in links], float),  # arguments of the program, which others share
        received=received,
        n=n,
    )


def _model_links(
    known: Sequence[SecondOrder | OverTime], received: Sequence[int], error: np.ndarray
) -> ReportModel | OverTime:
    """Return the model of the uplinks for a centre, at each step if any varies."""
    model: ReportModel | OverTime = at_each_step(lambda *links: _gather_link_moments(links, received, error), *known)
    return model


def _gather_link_moments(known: Sequence[PyTree], received: Sequence[int], error: np.ndarray) -> ReportModel:
    """Return the moments of all uplinks as arrays, with zeros for what a node receives less than others."""
    gains, offsets, spreads = [], [], []
    for link, size in zip(known, received, strict=True):
        padding = (0, max(received) - size)
        gains.append(np.pad(link.mean_gain, (padding, (0, 0))))
        offsets.append(np.pad(link.offset, padding))
        spreads.append(np.pad(link.nominal.center, (padding, padding, (0, 0), (0, 0))))
    return ReportModel(np.stack(gains), np.stack(offsets), np.stack(spreads), error)


@readable
@dataclass(frozen=True)
class Uplink:
    """Traffic of a fusion's quantizers for the estimates of `nodes`, by component.

    Args:
        nodes: names of the nodes.
        saturated: whether a component was beyond the amplitude, (run, time, node, n) in a record; in statistics the
            mean over the runs, (time, node, n).
        symbols: how many symbols were sent for it, in the same form.
    """

    nodes: tuple[str, ...]
    saturated: np.ndarray
    symbols: np.ndarray

    def saturated_share(self) -> dict[str, float]:
        """Return the share of the samples (runs, steps and components) that saturated, by node."""
        return {node: float(self.saturated[..., i, :].mean()) for i, node in enumerate(self.nodes)}

    def symbols_per_value(self) -> float:
        """Return the mean number of symbols per component of an estimate."""
        return float(self.symbols.mean())
