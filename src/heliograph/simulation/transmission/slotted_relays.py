"""Transmission over relays that send in turn: slots of hops, which repeat over the steps."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.channel import Channel
from heliograph.model.estimate import Estimate
from heliograph.model.over_time import OverTime, at, first, over_time, structure_key
from heliograph.model.relays import SENSOR as SENDER
from heliograph.model.relays import RelayNetwork
from heliograph.numerics.types import PyTree
from heliograph.simulation.network_index import EstimateIndex
from heliograph.simulation.random_keys import SENSOR, Number, checksum, draw_key
from heliograph.simulation.transmission.channel_draws import deliver_signal, start_channel
from heliograph.simulation.transmission.medium import AbstractMedium, Measurements


class RelayStates(NamedTuple):
    """Estimates that the relays will send, (relay, n), and the states of the hops with memory."""

    estimates: jax.Array
    hops: dict[str, PyTree]


class SlottedRelays(AbstractMedium):
    """Medium of relays in turn: each sends C s with its estimate s of the step before; slots repeat over the steps.

    A hop with memory moves on at every step, used or not; the same pair in another slot is another hop.

    Args:
        relays: who sends to whom in each slot, over which hop.
        estimates_at: where each relay's estimate stands.
        groups: listeners of each group, by their numbers among `relays.filters`.
        memories: numbers that seed the draws of the memories of each hop that has some, by its name.
    """

    relays: RelayNetwork
    estimates_at: tuple[EstimateIndex, ...] = eqx.field(static=True)
    groups: tuple[tuple[int, ...], ...] = eqx.field(static=True)
    memories: dict[str, np.ndarray]

    def init(self, key: jax.Array) -> RelayStates:
        """Return the initial mean as every relay's estimate, and the initial states of the hops with memory."""
        mean = jnp.asarray(at(self.relays.plant, k=0).initial_mean)
        hops = {
            name: start_channel(hop.channel, key, hop.source, self.memories[name])
            for name, hop in find_hops_with_memory(self.relays).items()
        }
        return RelayStates(jnp.tile(mean, (len(self.estimates_at), 1)), hops)

    def receive(
        self, state: RelayStates, x: jax.Array, u: jax.Array, key: jax.Array, k: jax.Array
    ) -> tuple[RelayStates, Measurements]:
        """Send over the hops of this step's slot, and sum at each listener what arrives over its hops.

        Relays estimate the plant's state and send their estimates on. A schedule of slots, used in turn, says who sends
        to whom; a hop is a random link from one sender to one listener.

        Args:
            state: the relays' estimates of the step before, and the states of hops with memory.
            x: the plant's state after the step.
            u: inputs of the plant over the step.
            key: random key of the run.
            k: number of the step.

        Returns:
            The next state, and for each group of listeners what they receive (listener, m).
        """
        # The sensor (SENDER is its name) sends y = C x + v, as it reports it: perhaps rounded. Each relay sends C s of
        # its estimate s.
        sensor = at(self.relays.sensor, k)
        v = sensor.noise.sample(draw_key(key, k, checksum(SENDER), SENSOR))
        y = sensor.noise.report(sensor.measure(x) + v)
        signals = [jnp.asarray(sensor.matrix) @ s for s in state.estimates]
        sent = dict(zip((SENDER, *self.relays.relays), [y, *signals], strict=True))
        # Hops without memory are drawn only in their slot. Those with memory are drawn at every step, since their
        # memories move on, but what they deliver counts only in their own slot.
        received = self._sum_without_memory(k, sent, key)
        hop_states, slot = {}, k % len(self.relays.slots)
        for name, hop in find_hops_with_memory(self.relays).items():
            hop_states[name], z = deliver_signal(
                hop.channel, state.hops[name], sent[hop.sender], key, k, hop.source, shared=self.memories[name]
            )
            received[hop.listener] = received[hop.listener] + jnp.where(slot == hop.slot, z, 0.0)
        # A group is a tuple of listeners' numbers, in the order of the network's listeners.
        in_order = [received[name] for name in self.relays.filters]
        received_by_group = tuple(jnp.stack([in_order[i] for i in group]) for group in self.groups)
        return RelayStates(state.estimates, hop_states), received_by_group

    def feed_back(self, state: RelayStates, estimates: Sequence[Estimate]) -> RelayStates:
        """Return the state with the relays' new estimates, which they send at the next step.

        `estimates`: of all filters by stack (of one structure), with mean (filter, node, n). `self.estimates_at`: where
        each relay's stands.
        """
        means = [estimates[index.stack].mean[index.filter, index.node] for index in self.estimates_at]
        return RelayStates(jnp.stack(means) if means else state.estimates, state.hops)

    def _sum_without_memory(self, k: jax.Array, sent: dict[str, jax.Array], key: jax.Array) -> dict[str, jax.Array]:
        """Return the sum at each listener through hops without memory, by name; NaN where nobody transmits to it.

        `sent`: signal of each sender, by name.
        """
        # Slots of one structure share a branch.
        slots_alike: dict[object, list[int]] = {}
        for number, slot in enumerate(self.relays.slots):
            slots_alike.setdefault(structure_key(slot), []).append(number)
        # Of each slot its branch, and its position within it.
        branch, position = np.zeros((2, len(self.relays.slots)), dtype=int)
        for i, numbers in enumerate(slots_alike.values()):
            branch[numbers], position[numbers] = i, np.arange(len(numbers))
        branches = [self._make_branch([self.relays.slots[i] for i in numbers]) for numbers in slots_alike.values()]
        # The branch of this step's slot.
        slot_now = k % len(branch)
        received: dict[str, jax.Array] = jax.lax.switch(
            jnp.asarray(branch)[slot_now], branches, jnp.asarray(position)[slot_now], k, sent, key
        )
        return received

    def _make_branch(self, slots: Sequence[Mapping[str, Mapping[str, Channel]]]) -> Callable[..., dict[str, jax.Array]]:
        """Return the function that computes what each listener receives in one of these slots, of one structure.

        A slot: by listener, its hop from each sender. Hops with memory are added elsewhere.
        """
        # A single slot is not stacked: its hops may vary over time, and are read at the step.
        stacked: PyTree = slots[0] if len(slots) == 1 else over_time(slots)

        def branch(
            position: jax.Array, k: jax.Array, sent: dict[str, jax.Array], key: jax.Array
        ) -> dict[str, jax.Array]:
            """Return what each listener receives at step k, by name, in the slot at this position of the stack.

            `sent`: the signal of each sender, by name. `key`: key of the run.

            `self.relays.received`: how many numbers each listener receives.
            """
            slot: PyTree = at(stacked, position) if isinstance(stacked, OverTime) else stacked
            listeners = zip(self.relays.filters, self.relays.received, strict=True)
            return {name: _receive_sum(slot.get(name, {}), name, size, k, sent, key) for name, size in listeners}

        return branch


class SlotHop(NamedTuple):
    """A hop of a slot: number of the slot, names of listener and sender, and the channel between them."""

    slot: int
    listener: str
    sender: str
    channel: Channel

    @property
    def source(self) -> Number:
        """Number that seeds the hop's draws, from the names of its ends."""
        return checksum(f"{self.sender} to {self.listener}")


def find_hops_with_memory(relays: RelayNetwork) -> dict[str, SlotHop]:
    """Return the hops whose channels have memory, by the name "SLOT LISTENER SENDER".

    In each slot of a step, each listener has hops from those who send to it.
    """
    return {
        f"{number} {listener} {sender}": SlotHop(number, listener, sender, hop)
        for number, slot in enumerate(relays.slots)
        for listener, hops in slot.items()
        for sender, hop in hops.items()
        if first(hop).remembers
    }


def _receive_sum(
    hops: Mapping[str, Channel], listener: str, size: int, k: jax.Array, sent: dict[str, jax.Array], key: jax.Array
) -> jax.Array:
    """Return the sum of what arrives at a listener over its hops without memory, or NaN if nobody sends to it.

    Args:
        hops: hops to the listener in this slot, by sender.
        listener: name of the listener.
        size: how many numbers it receives.
        k: number of the step.
        sent: signal of each sender, by name.
        key: key of the run.
    """
    received = []
    for sender, hop in hops.items():
        if not first(hop).remembers:  # its state is ()
            source = checksum(f"{sender} to {listener}")
            _, z = deliver_signal(hop, (), sent[sender], key, k, source, shared=())
            received.append(z)
    if received:
        return jnp.sum(jnp.stack(received), axis=0)
    # If all hops have memory, the sum here is 0: the caller adds what arrives over these.
    return jnp.zeros(size) if hops else jnp.full(size, jnp.nan)
