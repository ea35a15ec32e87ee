"""Relay networks: a plant observed by a sensor, relays that filter and forward, and a receiver, slot by slot."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import numpy as np

from heliograph.model.channel import Channel
from heliograph.model.over_time import at, first, stack_over_time, steps_covered
from heliograph.model.plant import AnyPlant, LinearPlant
from heliograph.model.sensor import AnySensor, LinearSensor, refuse_angles
from heliograph.numerics.check import check_horizon, fail, items, names, table
from heliograph.numerics.module import Module, readable
from heliograph.numerics.types import Array, Float, PyTree
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.moments.second_moments import second_order

SENSOR, RECEIVER = "sensor", "receiver"

Links = Mapping[str, Channel]  # by sender
Slot = Mapping[str, Links]  # by listener


@readable
class RelayNetwork(Module):
    """Network of relays with memory between a sensor and a receiver.

    At step k the sensor sends y_k = C_k x_k + v_k and relay r sends C_k s_r, with s_r its estimate at k - 1: what it
    receives at k, it can only forward later. A listener receives the sum of its links. A relay that listens and
    transmits in one slot is full duplex; its link to itself is self-interference. Links are independent of each other
    and over time; a link that is an OverTime is read at the step, not at the slot.

    Args:
        plant: linear plant without inputs.
        sensor: linear sensor.
        relays: names of the relays.
        slots: one dictionary for each slot of the schedule, used in turn from the first: slots[k][listener][sender] is
            the link, a random affine map. Senders are "sensor" and the relays, listeners the relays and "receiver".

    Raises:
        ValueError: no slots; a schedule in which nobody transmits to the receiver, or a relay that receives nothing but
            itself; unknown names; links that do not fit; a plant or sensor that is not linear, a plant with inputs.
    """

    plant: AnyPlant
    sensor: AnySensor
    slots: tuple[dict[str, dict[str, Channel]], ...]
    relays: tuple[str, ...] = eqx.field(static=True)

    def __init__(self, plant: AnyPlant, sensor: AnySensor, relays: Sequence[str], slots: Sequence[Slot]):
        """Check and hold a plant, its sensor, the relays' names, and the links of each slot of the schedule.

        `slots[k][listener][sender]` is the link of slot k from a sender to a listener; listeners without links are left
        out.
        """
        self.plant, self.sensor = plant, sensor
        self.relays = names("relays", relays, len(items("relays", relays, "names")), "relay")
        given_slots = [table("slot", slot, "links of a listener") for slot in items("slots", slots, "dictionaries")]
        read = [{to: table(f"links to {to!r}", links, "links") for to, links in slot.items()} for slot in given_slots]
        self.slots = tuple({listener: links for listener, links in slot.items() if links} for slot in read)
        _check_linear(first(plant), first(sensor))
        if len({*self.relays, SENSOR, RECEIVER}) != len(self.relays) + 2:
            raise fail("relays", f"distinct names other than {SENSOR!r} and {RECEIVER!r}", list(self.relays))
        if not self.slots:
            raise fail("slots", "at least one", "none")
        for number, slot in enumerate(self.slots):
            for listener, links in slot.items():
                _check_listener(self, number, listener, links)
        for name in self.filters:
            _check_reached(self, name)

    @property
    def filters(self) -> tuple[str, ...]:
        """Names of the filters: the relays, and the receiver last."""
        return (*self.relays, RECEIVER)

    @property
    def received(self) -> tuple[int, ...]:
        """Return how many numbers each filter receives in a step, in the order of `filters`: relays, then the receiver.

        It is the number of outputs of the first link to a filter in any slot, since all its links have equally many.
        """
        return tuple(
            next(first(link).outputs for slot in self.slots for link in slot.get(name, {}).values())
            for name in self.filters
        )

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the plant's states."""
        names: tuple[str, ...] = first(self.plant).states
        return names

    def always_receives(self, name: str) -> bool:
        """Return whether a listener, a relay or the receiver, gets numbers in every slot.

        In each slot some link leads to it, and none of its links loses messages (erases).
        """
        links_by_slot = [slot.get(name, {}) for slot in self.slots]
        some_link_erases = any(first(link).erases for links in links_by_slot for link in links.values())
        return all(links_by_slot) and not some_link_erases

    def initial(self) -> tuple[np.ndarray, np.ndarray]:
        """Return the mean (n,) and covariance (n, n) of x_0."""
        plant = first(self.plant)
        return np.asarray(plant.initial_mean), np.asarray(plant.initial_covariance)

    def check_horizon(self, horizon: int) -> None:
        """Raise ValueError unless `horizon` is positive and within what varies over time."""
        covered = steps_covered(self)
        check_horizon(horizon, covered)

    def steps(self, horizon: int) -> "RelaySteps":
        """Return the matrices and moments of steps 0 to horizon - 1, the first leading from x_0 to x_1.

        The links of a step are those of its slot; slots follow one another and repeat. Second moments of the network
        (of the state and all filters' errors) are computed from these matrices, which stand one step after another.

        Raises:
            ValueError: a horizon beyond what varies over time; links with uncertain probabilities.
        """
        self.check_horizon(horizon)
        # Moments of each slot, computed once where links do not vary over time.
        varies = steps_covered(self.slots) is not None
        period = horizon if varies else min(len(self.slots), horizon)
        by_slot = [_compute_slot_moments(self, self.slots[k % len(self.slots)], k) for k in range(period)]
        slot_of_step = np.arange(horizon) % period
        moments = _SlotMoments(*(np.stack(parts)[slot_of_step] for parts in zip(*by_slot, strict=True)))
        # The plant's x+ = A x + w at each step.
        transition = _list_arrays_by_step(self.plant, horizon, lambda p: p.matrix, 2)
        drift = _list_arrays_by_step(self.plant, horizon, lambda p: p.noise.mean, 1)
        # E x before each step: E x+ = A E x + E w.
        means = [self.initial()[0]]
        for a, b in zip(transition[:-1], drift[:-1], strict=True):
            means.append(a @ means[-1] + b)
        return RelaySteps(
            transition=transition,
            process=_list_arrays_by_step(self.plant, horizon, lambda p: p.noise.covariance, 2),
            drift=drift,
            sensing=_list_arrays_by_step(self.sensor, horizon, lambda s: s.matrix, 2),
            sensor_noise=_list_arrays_by_step(self.sensor, horizon, lambda s: s.noise.covariance, 2),
            sensor_offset=_list_arrays_by_step(self.sensor, horizon, lambda s: s.noise.mean, 1),
            state_mean=np.array(means),
            gain=moments.gain,
            offset=moments.offset,
            covariance=moments.covariance,
            receives_in_slot=moments.receives,
            transmits_in_slot=moments.transmits,
            received=self.received,
        )


class RelaySteps(Module):
    """Matrices of a relay network that its second moments need, for each step (leading axis).

    The F filters together receive R numbers; T = (1 + relays) m numbers are sent: y, then the signal of each relay.
    With W = E (sent, 1)(sent, 1)', what is received has mean gain sent + offset and, given them, covariance_ij : W
    (noise included). Rows with `receives_in_slot` = 1 have some link, senders with `transmits_in_slot` = 1 too;
    `state_mean` is E x before the step.

    Shapes: transition, process (time, n, n), drift, state_mean (time, n), sensing (time, m, n), sensor_noise
    (time, m, m), sensor_offset (time, m), gain (time, R, T), offset, receives_in_slot (time, R), covariance
    (time, R, R, T + 1, T + 1), transmits_in_slot (time, 1 + relays).
    """

    transition: np.ndarray
    process: np.ndarray
    drift: np.ndarray
    sensing: np.ndarray
    sensor_noise: np.ndarray
    sensor_offset: np.ndarray
    state_mean: np.ndarray
    gain: np.ndarray
    offset: np.ndarray
    covariance: np.ndarray
    receives_in_slot: np.ndarray
    transmits_in_slot: np.ndarray
    received: tuple[int, ...] = eqx.field(static=True)

    @property
    def owner(self) -> np.ndarray:
        """Index of the filter that receives each of the R numbers."""
        return np.repeat(np.arange(len(self.received)), self.received)

    def predict_maps(self) -> tuple[Float[np.ndarray, "time R n"], Float[np.ndarray, "time R"]]:
        """Return B and b of the prediction B s + b of all R received numbers from the estimate s of their filter.

        What is sent, (y, each relay's signal), is predicted from s: y by one step of the plant, and a relay's signal,
        which is one step old, by the sensor alone. `self.gain` and `self.offset` are the means of the links.
        """
        relays, m = len(self.received) - 1, self.sensing.shape[1]
        matrix_of_sent = np.concatenate([self.sensing @ self.transition, *[self.sensing] * relays], axis=1)
        constant_of_y = np.einsum("kmn,kn->km", self.sensing, self.drift) + self.sensor_offset
        B = self.gain @ matrix_of_sent
        b = np.einsum("krm,km->kr", self.gain[:, :, :m], constant_of_y) + self.offset
        return B, b


class _SlotMoments(NamedTuple):
    """Moments of the R numbers that are received in a slot, given the T numbers that are sent in it.

    gain, offset: their means. covariance: covariances of the entries of gain and offset, the offset as entry T.
    receives, transmits: 1 for each number that is received, and for each sender that transmits, in the slot; else 0.
    """

    gain: Float[np.ndarray, "R T"]
    offset: Float[np.ndarray, " R"]
    covariance: Float[np.ndarray, "R R T+1 T+1"]
    receives: Float[np.ndarray, " R"]
    transmits: Float[np.ndarray, " senders"]


def _compute_slot_moments(network: RelayNetwork, slot: Slot, k: int) -> _SlotMoments:
    """Return second moments of all that is received in one slot, given all that is sent in it.

    A slot is a turn of the schedule, which says who sends to whom. Rows are the numbers that all filters receive, one
    filter after another; columns are the m numbers of each sender, the sensor first and then the relays.

    Args:
        network: the network.
        slot: links of the slot, by listener and sender.
        k: step, at which links that vary are read.
    """
    m, senders = len(first(network.sensor).outputs), (SENSOR, *network.relays)
    rows, columns = sum(network.received), len(senders) * m
    # First row of each filter among all that is received.
    starts = dict(zip(network.filters, np.cumsum((0, *network.received[:-1])), strict=True))
    gain, offset, receives = np.zeros((rows, columns)), np.zeros(rows), np.zeros(rows)
    covariance, transmits = np.zeros((rows, rows, columns + 1, columns + 1)), np.zeros(len(senders))
    for listener, links in slot.items():  # slot[listener][sender] is the link
        for sender, link in links.items():
            # Mean gain and offset of the link z = G s + n, and covariances of the entries of (G, n).
            moments = second_order(at(link, k))
            if moments.uncertain:
                raise fail("link", "known probabilities", "uncertain ones")
            # A listener receives the sum of its links: gains, offsets and covariances of independent links add.
            received = starts[listener] + np.arange(len(moments.offset))
            sent = m * senders.index(sender) + np.arange(m)
            gain[np.ix_(received, sent)] = moments.mean_gain
            offset[received] += moments.offset
            sent_and_one = np.append(sent, columns)  # the offset stands behind the gains of all that is sent
            # Covariances of the link's gains and offset, (outputs, outputs, inputs + 1, inputs + 1).
            covariance[np.ix_(received, received, sent_and_one, sent_and_one)] += moments.nominal.center
            receives[received], transmits[senders.index(sender)] = 1.0, 1.0
    return _SlotMoments(gain=gain, offset=offset, covariance=covariance, receives=receives, transmits=transmits)


def _list_arrays_by_step(model: PyTree, horizon: int, read: Callable[[PyTree], Array], dimensions: int) -> np.ndarray:
    """Return an array of a plant or sensor at each of `horizon` steps, with a leading axis of steps.

    `read`: takes the array out of the model. `dimensions`: its number of axes at one step; a varying model has one
    more.
    """
    value = np.asarray(read(stack_over_time(model)), dtype=np.float64)
    if value.ndim == dimensions + 1:
        return value[:horizon]
    return np.broadcast_to(value, (horizon, *value.shape))


def _check_linear(plant: object, sensor: object) -> None:
    """Raise ValueError unless plant and sensor are linear, without inputs or angles, and fit each other."""
    if not isinstance(plant, LinearPlant) or not isinstance(sensor, LinearSensor):
        got = f"{type(plant).__name__} and {type(sensor).__name__}"
        raise fail("relay network", "a LinearPlant and a LinearSensor", got)
    refuse_angles("relay network", plant, sensor)
    if plant.inputs:
        raise fail("relay network's plant", "no inputs", list(plant.inputs))
    if sensor.matrix.shape[-1] != len(plant.states):
        raise fail("sensor matrix", f"{len(plant.states)} columns", f"shape {sensor.matrix.shape[-2:]}")


def _check_listener(network: RelayNetwork, number: int, listener: str, links: Links) -> None:
    """Raise ValueError unless the links to one listener in one slot come from known senders, and fit them.

    Args:
        network: the network, of which filters, relays and sensor are known already.
        number: number of the slot, for errors.
        listener: who receives, a relay or the receiver.
        links: link from each sender.
    """
    where = f"slot {number}, {listener!r}"
    # Names.
    if listener not in network.filters:
        raise fail(f"listener in slot {number}", f"one of {list(network.filters)}", repr(listener))
    for sender, link in links.items():
        if sender not in (SENSOR, *network.relays):
            raise fail(f"{where}: sender", f"one of {[SENSOR, *network.relays]}", repr(sender))
        if not isinstance(first(link), AbstractRandomAffine):
            raise fail(f"{where}: link from {sender!r}", "a random affine map", type(first(link)).__name__)
        if first(link).past:
            raise fail(f"{where}: link from {sender!r}", "one without delays", f"one late by {first(link).past} steps")
        # Sizes: a link takes what one sender sends, and all links of a listener deliver one length.
        takes, length = first(link).inputs, len(first(network.sensor).outputs)
        if takes != length:
            raise fail(f"{where}: link from {sender!r}", f"one that takes {length} numbers", f"one that takes {takes}")
    sizes = {first(link).outputs for slot in network.slots for link in slot.get(listener, {}).values()}
    if len(sizes) > 1:
        raise fail(f"links to {listener!r}", "one number of outputs", sorted(sizes))


def _check_reached(network: RelayNetwork, name: str) -> None:
    """Raise ValueError unless somebody transmits to a relay or to the receiver, called `name`, in some slot.

    A relay that hears nothing but itself is refused too. `network.slots[k][listener]` has the links to a listener in
    slot k, by sender.
    """
    senders = {sender for slot in network.slots for sender in slot.get(name, {})}  # in any slot of the schedule
    if name == RECEIVER and not senders:
        raise fail("slots", "one in which somebody transmits to the receiver", "a schedule in which nobody does")
    if not senders - {name}:
        got = "itself only" if senders else "nobody"
        raise fail(f"relay {name!r}", "to receive the sensor or another relay in some slot", got)
