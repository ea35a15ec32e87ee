"""Filters behind delayed links, whose states are past signals too, and filters of a part of a larger system's states.

A delay line holds the signals of the last steps, which may still be under way: y_k, y_k-1, ..., y_k-D.
"""

from dataclasses import replace
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from heliograph.factors.covariance_factors import WeightedColumns
from heliograph.filters.base import AbstractFilter, Step, make_sizes, predicts
from heliograph.filters.gaussian.signal_moments import factor_link_noise
from heliograph.filters.linear.linear_filter_state import LinearBelief, PlantMotion, predict_belief
from heliograph.filters.linear.precomputed_filter import PlannedFilter, plan_filter
from heliograph.filters.wrappers.late_data import LateFilter, Make, build_known_delay_filter
from heliograph.filters.wrappers.wrapper import AbstractWrapper
from heliograph.model.assumed.assumed_model import believes
from heliograph.model.augmented.bias import append_driving_plant
from heliograph.model.augmented.past_outputs import with_past
from heliograph.model.channel import Channel, check_link
from heliograph.model.over_time import at_each_step, first
from heliograph.model.plant import AnyPlant, LinearPlant, Plant
from heliograph.model.sensor import AnySensor, LinearSensor
from heliograph.numerics.check import check_count, fail, instance
from heliograph.numerics.types import Array, ArrayLike, Float, PyTree
from heliograph.random_affine.base import AbstractRandomAffine, check_forgets, check_maps
from heliograph.random_affine.delay import DelayedLink, place_on_delay_line, signal_size
from heliograph.random_affine.hop import known
from heliograph.random_affine.moments.second_moments import SecondOrder, second_order
from heliograph.random_affine.relayed_links import RelayedLinks
from heliograph.random_affine.series_and_stack import Series


class PartFilter(AbstractWrapper):
    """A filter of a larger system that estimates its first states alone. Built by `part_filter`."""

    base: AbstractFilter

    def __init__(self, base: AbstractFilter, states: int):
        """Wrap the filter `base` so that only its first `states` states are estimated.

        What its covariance is said to be (`claim`), its inputs, and the length of z (`received`) stay those of `base`.
        """
        self.base, self.claim, self.states = base, base.claim, base.states[:states]
        self.inputs, self.received, self.kept = base.inputs, base.received, base.kept

    def planned(self, inputs: Float[Array, "horizon inputs"]) -> AbstractFilter:
        """Plan the larger filter, and keep the rows of its plan that belong to the first n states.

        A plan holds the filter's matrices for these inputs. Its projection maps the plan's mean to the states.
        """
        plan, n = self.base.planned(inputs), len(self.states)
        if not isinstance(plan, PlannedFilter):
            return PartFilter(plan, n)
        projection = jnp.eye(len(self.base.states)) if plan.projection is None else jnp.asarray(plan.projection)
        covariances = plan.covariances[:, :n, :n]
        return replace(plan, covariances=covariances, projection=projection[:n], states=self.states)


def part_filter(filter: AbstractFilter, states: int) -> PartFilter:
    """Restrict a filter to its first states, which are those of the plant in a system enlarged by `with_past`.

    Args:
        filter: the filter of the larger system.
        states: number of its first states that are estimated.

    Claim: that of `filter`.

    Raises:
        ValueError: no filter, more states than it has.

    Source: a part of a linear estimate is the estimate of that part.
    """
    instance("filter", filter, AbstractFilter, "a filter")
    if check_count("states", states) > len(filter.states):
        raise fail("states", f"at most the filter's {len(filter.states)}", states)
    return PartFilter(filter, states)


class RelayLine(NamedTuple):
    """Indices in the state of what one relay receives.

    start: first state of the delay line that it receives from: the sensor's, or that of the relay before it.
    length: number of states of that line.
    received: first state of its own line, which takes the signal that it receives in this step.
    """

    start: int
    length: int
    received: int


class RelayLinesFilter(AbstractWrapper):
    """Best linear filter of (x, past signals of the sensor, past received signals of each relay).

    The sensor and each relay have a delay line of the signals that may still be received from them. At each step relay
    i receives r = G l + n, where l is the line of the sensor or relay before it: the mean of r given l is M l + b, with
    M = E G and b = E n, and E Cov(r given l) uses the moments of l before any data.

    base: the filter of these states, whose plant shifts all lines by one signal and leaves their first entries free.
    links: moments of G and n for each relay. lines: for each relay the line that it receives from, and the index of its
    received signal.
    """

    base: AbstractFilter
    links: tuple[SecondOrder, ...]
    lines: tuple[RelayLine, ...] = eqx.field(static=True)

    @predicts
    def predict(self, state: PyTree, u: ArrayLike = (), k: Step = 0) -> PyTree:
        """Predict plant and delay lines over step k, then add what each relay receives, in the order of the relays.

        `self.lines` says where each relay's lines are in the state.
        """
        state = self.base.predict(state, u, k)
        for link, line in zip(self.links, self.lines, strict=True):
            state = _receive_into_line(state, link, line)
        return state

    def planned(self, inputs: Float[Array, "horizon inputs"]) -> AbstractFilter:
        """Return the filter with all covariances and gains computed for these inputs (horizon, inputs)."""
        return plan_filter(self, inputs, np.eye(len(self.states), len(self.base.states)))


def _receive_into_line(state: LinearBelief, link: SecondOrder, relay: RelayLine) -> LinearBelief:
    """Set the first entry of a relay's delay line in the filter's state to what the relay receives, r = G l + n.

    l is the delay line, a part of the state, of the sensor or relay that sends. `link` has the moments of G and n, with
    M = E G and b = E n, and `relay` the indices of l and of r in the state.
    """
    gain = jnp.asarray(link.mean_gain)
    offset = jnp.asarray(link.offset)
    total, m = len(state.gaussian.mean), len(offset)
    line = slice(relay.start, relay.start + relay.length)
    received = slice(relay.received, relay.received + m)
    # The state becomes `matrix` x + `offset_of_state` + noise: M l + b in the entries `received`, all others unchanged.
    matrix = jnp.eye(total).at[received, :].set(0.0).at[received, line].set(gain)
    offset_of_state = jnp.zeros(total).at[received].set(offset)
    # E Cov(r given l), by E[l l'] before any data: a random gain multiplies l itself.
    mean = state.state_mean[line]
    covariance = state.state_covariance[line, line]
    link_noise = factor_link_noise(link, covariance + jnp.outer(mean, mean), mean)
    noise_columns = jnp.zeros((total, link_noise.matrix.shape[1])).at[received].set(link_noise.matrix)
    noise = WeightedColumns(noise_columns, link_noise.weights)
    return predict_belief(
        state, PlantMotion(matrix=matrix, offset=offset_of_state, covariance=noise.covariance, noise=noise)
    )


def enlarge_by_relays(
    plant: AnyPlant, sensor: AnySensor, channel: RelayedLinks
) -> tuple[AnyPlant, LinearSensor, Channel, tuple[RelayLine, ...]]:
    """Enlarge the plant's state x by the delay lines of past signals (newest first): the sensor's, then each relay's.

    `channel.stages` are the links: from the sensor to relay 0, from relay 0 to relay 1, ..., to the receiver. Stage
    i + 1 sends from the line of relay i, which holds the newest and `past` older signals, as that stage may be late.

    Returns:
        The larger plant, a sensor that outputs the last relay's line, the link from there to the receiver, and for each
        relay the indices of its lines in the state.
    """
    for stage in channel.stages:
        check_forgets("link of a relay that is late by chance", stage)
    # The sensor's line, then one line per relay behind it.
    larger, _, _ = with_past(plant, sensor, channel.stages[0])
    line_start, lines = len(first(plant).states), []
    total = len(first(larger).states)
    for i, (stage_to_relay, stage_from_relay) in enumerate(zip(channel.stages, channel.stages[1:], strict=False)):
        lines.append(RelayLine(start=line_start, length=stage_to_relay.inputs, received=total))
        line_start = total
        total += stage_from_relay.inputs
        append_line = partial(_append_relay_line, relay=i, size=stage_to_relay.outputs, steps=stage_from_relay.past)
        larger = at_each_step(append_line, larger)
    # The receiver measures the line of the last relay, without noise of its own.
    matrix = np.eye(total)[line_start:]
    no_noise = np.zeros((total - line_start, total - line_start))
    last_line_sensor = LinearSensor(matrix, no_noise, first(larger).states[line_start:])
    return larger, last_line_sensor, place_on_delay_line(channel.stages[-1]), tuple(lines)


def _append_relay_line(plant: PyTree, relay: int, size: int, steps: int) -> LinearPlant | Plant:
    """Enlarge the plant by a relay's line: the `size` numbers that it received 0, 1, ..., `steps` steps ago.

    At each step the numbers move one entry on, without noise, and the newest entry becomes free for the next one.
    """
    length = size * (1 + steps)
    names = [f"relay_{relay}_{j}_{d}_ago" for d in range(1 + steps) for j in range(size)]
    shift_matrix = np.kron(np.eye(1 + steps, k=-1), np.eye(size))
    no_noise = np.zeros((length, length))
    line = LinearPlant(shift_matrix, no_noise, np.zeros(length), no_noise, states=names)
    return append_driving_plant(plant, line, np.zeros((len(plant.states), length)))


def relayed_filter(plant: AnyPlant, channel: RelayedLinks, base: AbstractFilter, lines: PyTree) -> RelayLinesFilter:
    """Build the filter behind relays from `base`, a filter of the plant and the delay lines of all relays.

    A delay line holds what a relay received in the last steps. `lines` has one `RelayLine` for each relay: the indices
    of the line that it receives from and of its own.
    """
    # One link to each relay; the last link, to the receiver, is in `base` itself. The filter is optimal only with known
    # probabilities.
    links = tuple(second_order(place_on_delay_line(stage)) for stage in channel.stages[:-1])
    if any(link.uncertain for link in links):
        raise fail("link to a relay that is late by chance", "known probabilities", "uncertain ones")
    start = first(plant)
    return RelayLinesFilter(
        base=base,
        links=links,
        lines=lines,
        **make_sizes(base.claim, start, channel.outputs),
    )


@believes
def build_behind_delays(plant: AnyPlant, sensor: AnySensor, channel: Channel, make: Make) -> AbstractFilter:
    """Build a filter for a link that may be late from `make`, which builds one for a link without delay.

    If there are time stamps or the delay is random, past signals become states. A constant delay needs no such states.
    """
    start, n = first(channel), len(first(plant).states)
    check_link(first(sensor), start, n, late=True)
    if isinstance(start, DelayedLink) and start.timestamped:
        return build_known_delay_filter(plant, sensor, channel, make)
    if isinstance(channel, DelayedLink) and channel.constant:
        return LateFilter(make(plant, sensor, channel.link), channel.past)
    if isinstance(start, RelayedLinks):
        return _build_behind_relays(plant, sensor, channel, make)
    # The filter has past signals as states, but only the plant's n states are estimated.
    return PartFilter(make(*with_past(plant, sensor, channel)), n)


def _build_behind_relays(plant: AnyPlant, sensor: AnySensor, channel: Channel, make: Make) -> RelayLinesFilter:
    """Build the filter behind relays that store what they received, and forward it later.

    The plant's state is enlarged by each relay's delay line, of what it received in the last steps. `make` builds the
    filter of this plant, with a sensor that outputs the last relay's line, behind the last link.
    """
    if not isinstance(channel, RelayedLinks):
        raise fail("channel with relays that are late by chance", "one that does not vary", "one in over_time")
    enlarged_plant, last_line_sensor, last_link, lines = enlarge_by_relays(plant, sensor, channel)
    return relayed_filter(plant, channel, make(enlarged_plant, last_line_sensor, last_link), lines)


def deliver_line_as_current(channel: Channel) -> Channel:
    """Return the channel as it is to a filter that takes late signals for current ones.

    A late channel is a map of the delay line (y_k, y_k-1, ...) of the last signals. Here all its entries are y_k.
    """
    current: Channel = at_each_step(_deliver_at_once, channel)
    return current


def _deliver_at_once(channel: AbstractRandomAffine) -> AbstractRandomAffine:
    """Return the channel as if nothing were late: every entry of its delay line is the present signal."""
    check_maps("channel", [channel])
    if isinstance(channel, RelayedLinks):
        # Each stage has a delay line of its own.
        return Series([_deliver_at_once(stage) for stage in channel.stages])
    repeat = known(np.tile(np.eye(signal_size(channel)), (1 + channel.past, 1)))
    return Series([repeat, place_on_delay_line(channel)])
