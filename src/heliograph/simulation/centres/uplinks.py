"""Uplinks of a fusion by reports: quantizers, random channels and delays.

`n`: numbers in a report as a node sends it. `m`: numbers that arrive of the longest one; a node of which fewer arrive
has NaN in the other rows. Age of a report: steps since it was sent.
"""

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
from heliograph.simulation.centres.observation_model import compute_channel_moments
from heliograph.simulation.random_keys import CHANNEL, draw_key
from heliograph.simulation.transmission.channel_draws import ChannelGroup, group_channels


class UplinkDraws(NamedTuple):
    """Draws of the uplinks at one step: of a report x arrives gain x + offset, NaN where lost, `delay` steps later.

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


class ReportsInTransit(NamedTuple):
    """Reports in transit, and the quantizers' states.

    Args:
        values: what arrives of the reports sent 1, 2, ... steps ago (age, node, m), NaN of what is lost or not sent.
        delays: after how many steps each arrives (age, node).
        quantizers: states of the nodes' quantizers, stacked; () without quantizers.
    """

    values: jax.Array
    delays: jax.Array
    quantizers: PyTree


class Uplinks(Module):
    """All uplinks of one fusion by reports.

    Args:
        groups: the nodes' channels, those of one structure stacked; without any, nothing is drawn.
        quantizers: of the nodes, stacked; None where reports are sent as they are.
        links: the centre's model of the channels.
        delay: probability of each delay in steps (node, ages).
        every: steps from one report to the next, by node.
        received: how many numbers arrive of each node's report.
        n: how many numbers a report has when it is sent.
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
        """Indices of the numbers that may arrive, among the reports (age, node, m), flattened.

        Shorter reports are padded to m, the length of the longest one; what pads them never arrives.
        """
        ages = self.delay.shape[1]
        is_number = np.arange(max(self.received)) < np.array(self.received)[:, None]  # (node, m)
        return np.flatnonzero(np.broadcast_to(is_number, (ages, *is_number.shape)))

    def init(self) -> ReportsInTransit:
        """Return the state with no report in transit from the nodes to the centre.

        It has a row for each age of 1, 2, ... steps that a report can reach on its way, and the initial states of the
        quantizers, by which nodes send reports in few bits.
        """
        nodes, ages = self.delay.shape
        values = jnp.full((ages - 1, nodes, max(self.received)), jnp.nan)  # NaN: nothing was sent

        def init_quantizer(quantizer: AbstractQuantizer) -> PyTree:
            """Return the initial state of one node's quantizer."""
            return quantizer.init(self.n)

        init_all = eqx.filter_vmap(init_quantizer, in_axes=(eqx.if_array(0),), axis_size=nodes)
        quantizers = () if self.quantizers is None else init_all(self.quantizers)
        return ReportsInTransit(values, delays=jnp.zeros((ages - 1, nodes), dtype=int), quantizers=quantizers)

    def draw(self, key: jax.Array, k: jax.Array) -> UplinkDraws:
        """Draw the uplinks of step k in the run with this key; the same for all fusions of the same nodes.

        A report m of n numbers arrives as G m + b, of up to `max(self.received)` numbers; G and b are drawn, and so is
        the delay.
        """
        nodes, m, n = len(self.received), max(self.received), self.n
        # Lossless links, where nothing is random; NaN in rows that a node lacks.
        gain = jnp.zeros((nodes, m, n)) if self.groups else jnp.tile(jnp.eye(n), (nodes, 1, 1))
        offset = jnp.where(np.arange(m) < np.array(self.received)[:, None], 0.0, jnp.nan)
        delay = self.fixed_delay
        # A group holds nodes whose channels have one structure: `group.indices` are their numbers.
        for group in self.groups:
            node_numbers = jnp.asarray(group.indices)
            matrices, delays = _draw_links(group, jnp.asarray(self.delay)[node_numbers], key, k)  # [G b; 0 1]
            size = matrices.shape[1] - 1
            gain = gain.at[node_numbers, :size].set(matrices[:, :-1, :-1])
            offset = offset.at[node_numbers, :size].set(matrices[:, :-1, -1])
            delay = delay.at[node_numbers].set(delays)
        return UplinkDraws(gain, offset, delay)

    def lossless(self) -> UplinkDraws:
        """Return gains, offsets and delays of links by which all reports arrive as they are, each after its delay."""
        nodes = len(self.received)
        return UplinkDraws(
            gain=np.tile(np.eye(self.n), (nodes, 1, 1)), offset=np.zeros((nodes, self.n)), delay=self.fixed_delay
        )

    def read_recorded(
        self, name: str, nodes: Sequence[str], reports: Mapping[str, SentReports | ArrayLike] | None, steps: int
    ) -> UplinkDraws:
        """Return gains, offsets and delays of each step from a recording, with a leading axis of time.

        They stand for the draws of a simulation: a report m arrives as gain m + offset after a delay. Here gains are 0,
        and offsets are the recorded values.

        Args:
            name: name of the fusion, for errors.
            nodes: names of the nodes that report to it.
            reports: for each node, the received values of its reports (steps, numbers), in the row of the step at which
                a report was sent, NaN where it was lost; `SentReports` adds delays where they are not fixed. None if
                no reports were recorded.
            steps: number of steps.

        Raises:
            ValueError: nodes without reports or the reverse, shapes that do not fit, delays that the links do not
                allow.
        """
        count, m = len(self.received), max(self.received)
        # Without channels all that is sent arrives.
        if reports is None and not self.groups:
            return UplinkDraws(*(np.broadcast_to(values, (steps, *np.shape(values))) for values in self.lossless()))
        if reports is None or set(reports) != set(nodes):
            got = "none" if reports is None else list(reports)
            raise fail(f"reports of fusion {name!r}", f"those of {list(nodes)}", got)
        # The recorded values enter as offsets of links without gain.
        values, delay = np.full((steps, count, m), np.nan), np.tile(self.fixed_delay, (steps, 1))
        for i, node in enumerate(nodes):
            sent, size = reports[node], self.received[i]  # `size` numbers arrive of a report; the rest of a row is NaN
            if isinstance(sent, SentReports):
                delay[:, i] = self._check_delay(f"delays of node {node!r}", sent.delay, steps, i)
                sent = sent.values
            values[:, i, :size] = array(f"reports of node {node!r}", sent, (steps, size), missing=True)
        return UplinkDraws(np.zeros((steps, count, m, self.n)), values, delay)

    def _check_delay(self, name: str, value: ArrayLike, steps: int, node: int) -> np.ndarray:
        """Return the delays in steps of a node's reports (steps,); raise ValueError for an impossible delay.

        `self.delay` (node, ages): the probability of each delay of the node's uplink.
        """
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
        self, state: ReportsInTransit, means: jax.Array, drawn: UplinkDraws, k: jax.Array
    ) -> tuple[ReportsInTransit, jax.Array, dict[str, jax.Array]]:
        """Send the reports of step k: return the next state, their values as they arrive, and what the quantizers did.

        Nodes report the means of their estimates to a centre over uplinks. A quantizer rounds a report to a symbol of
        few bits; a component beyond its range saturates it. Such a report becomes infinite: no bound of its error is
        known, and an estimate that is no number shows that.

        Args:
            state: reports in transit and states of quantizers, before the step.
            means: means to be sent (node, n).
            drawn: the links' random gains G (node, m, n) and offsets b (node, m) of the step.
            k: number of the step.

        Returns:
            The state with the quantizers' next states; values that arrive, now or after a delay (node, m), NaN where
            nothing does; {"saturated": which components saturated a quantizer, "symbols": how many symbols were sent
            for each} (node, n), empty without quantizers.
        """
        # A node sends at steps d, 2 d, ... counted from 1, d = `every`; a quotient of multiples is exact, and native
        # code has no remainder by a variable.
        step = jnp.asarray(k + 1, means.dtype)
        is_sending = (jnp.floor(step / self.every) * self.every == step)[:, None]
        values, quantizer_outcome = jnp.where(is_sending, means, jnp.nan), {}
        saturated = jnp.zeros(len(means), dtype=bool)
        # Quantized reports.
        if self.quantizers is not None:
            quantize = eqx.filter_vmap(lambda q, s, mean: q.step(s, mean), in_axes=(eqx.if_array(0), 0, 0))
            quantizers, sent = quantize(self.quantizers, state.quantizers, values)
            state, values = state._replace(quantizers=quantizers), sent.value
            saturated = jnp.any(sent.saturated, axis=1)
            quantizer_outcome = {"saturated": sent.saturated, "symbols": jnp.where(is_sending, sent.symbols, 0)}
        # The links: G m + b.
        z = jnp.einsum("imn,in->im", drawn.gain, values) + drawn.offset
        return state, jnp.where(saturated[:, None], jnp.inf, z), quantizer_outcome

    def arrive(self, state: ReportsInTransit, sent: jax.Array, delay: Array) -> tuple[ReportsInTransit, jax.Array]:
        """Return the next state, and what arrives now of this report and of earlier ones, by age (age, node, m).

        `sent` (node, m): values of this step's reports, which arrive `delay` (node,) steps later. NaN means that
        nothing arrives.
        """
        values = jnp.concatenate([sent[None], state.values])
        delays = jnp.concatenate([jnp.asarray(delay, dtype=state.delays.dtype)[None], state.delays])
        is_due = delays == np.arange(len(values))[:, None]  # a report arrives when its age is its delay
        arriving = jnp.where(is_due[..., None], values, jnp.nan)
        return state._replace(values=values[:-1], delays=delays[:-1]), arriving


def _draw_links(group: ChannelGroup, delay: jax.Array, key: jax.Array, k: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Draw the matrices [G n; 0 1] (channel, m + 1, n + 1) of a group's channels at step k, and their delays in steps.

    A group has the channels of some nodes, of one structure, stacked. G: the gain. n: the offset with its noise.
    `delay` (channel, ages): the probability of each delay.
    """

    def draw_link(channel: Channel, source: jax.Array, probabilities: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Draw one channel, seeded by its number `source`, and a delay by its `probabilities`."""
        channel_key, delay_key = jax.random.split(draw_key(key, k, source, CHANNEL))
        return at(channel, k).sample(channel_key), jax.random.choice(delay_key, len(probabilities), p=probabilities)

    draw_links = eqx.filter_vmap(draw_link, in_axes=(eqx.if_array(0), 0, 0))
    matrices, delays = draw_links(group.channel, group.checksums, delay)
    return matrices, delays


def build_uplinks(fusion: Fusion, nodes: Sequence[str], n: int) -> Uplinks:
    """Return the uplinks of these nodes to the centre of a fusion by reports of n numbers.

    A node's report is its estimate of n numbers; on its way to the centre it may be rounded by a quantizer, and scaled,
    lost or delayed by a random channel.
    """
    links, quantizers = fusion.links(nodes), fusion.quantizers(nodes)
    channels = [perfect(n) if link.channel is None else link.channel for link in links]
    # Nothing is drawn if no link has a channel, and each has one delay of probability 1.
    is_random = any(link.channel is not None or np.max(link.delay) < 1 for link in links)
    channel_by_name = {f"{node} to the fusion centre": channel for node, channel in zip(nodes, channels, strict=True)}
    # Probabilities of delays of 0, 1, ... steps, padded with zeros to the longest delay of all links.
    ages = max(len(link.delay) for link in links)
    delay = np.stack([np.pad(link.delay, (0, ages - len(link.delay))) for link in links])
    # How many numbers arrive of each node's report, and bounds on the quantizers' errors.
    received = tuple(link.received(n) for link in links)
    error = np.stack([quantizer.error(n) for quantizer in quantizers]) if quantizers else np.zeros((len(nodes), n))
    groups = group_channels(channel_by_name) if is_random else ()
    moments = [compute_channel_moments(channel) for channel in channels]
    return Uplinks(
        groups=groups,
        quantizers=stack(quantizers) if quantizers else None,
        links=_make_link_models(moments, received, error),
        delay=delay,
        every=np.array([link.every for link in links], float),  # arguments of the program, which others share
        received=received,
        n=n,
    )


def _make_link_models(
    moments_by_node: Sequence[SecondOrder | OverTime], received: Sequence[int], error: np.ndarray
) -> ReportModel | OverTime:
    """Return the centre's model of the uplinks, or one for each step if any uplink varies.

    `moments_by_node`: the moments of each node's channel. `received`: how many numbers arrive of each node's report.
    `error` (node, n): a bound on the error of each node's quantizer.
    """

    def gather(*links: SecondOrder) -> ReportModel:
        """Return the model of one step, from the moments of each node's link."""
        return _gather_link_moments(links, received, error)

    model: ReportModel | OverTime = at_each_step(gather, *moments_by_node)
    return model


def _gather_link_moments(links: Sequence[PyTree], received: Sequence[int], error: np.ndarray) -> ReportModel:
    """Return the moments of all uplinks z_i = G_i m_i + b_i as arrays, padded with zeros where z_i has fewer numbers.

    Args:
        links: moments of each node's channel at one step: the means E G and E b, and the covariance of (G, b).
        received: how many numbers arrive of each node's report.
        error: a bound on the error of each node's quantizer (node, n).
    """
    gains, offsets, covariances = [], [], []
    for link, size in zip(links, received, strict=True):
        padding = (0, max(received) - size)
        gains.append(np.pad(link.mean_gain, (padding, (0, 0))))
        offsets.append(np.pad(link.offset, padding))
        covariances.append(np.pad(link.nominal.center, (padding, padding, (0, 0), (0, 0))))
    return ReportModel(gain=np.stack(gains), offset=np.stack(offsets), covariance=np.stack(covariances), error=error)


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
