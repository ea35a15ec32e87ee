"""Best linear filter behind relays with random delays: it estimates the signals that each relay stores."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter, Step, predicts
from heliograph.filters.gaussian.correction import homogeneous
from heliograph.filters.linear.plan import plan
from heliograph.filters.wrappers.part import AbstractPartFilter
from heliograph.model.channel import Channel
from heliograph.model.over_time import OverTime, first, over_time, unstack
from heliograph.model.past import with_past
from heliograph.model.plant import AnyPlant, LinearPlant
from heliograph.model.sensor import AnySensor, LinearSensor
from heliograph.numerics.check import fail
from heliograph.numerics.linalg import symmetrize
from heliograph.numerics.traced import library
from heliograph.numerics.types import Array, ArrayLike, Float, PyTree
from heliograph.random_affine.base import check_forgets
from heliograph.random_affine.delay import of_line
from heliograph.random_affine.in_line import Relayed
from heliograph.random_affine.moments.second_moments import SecondOrder, second_order
from heliograph.random_affine.noise import Gaussian, Independent


class HeldFilter(AbstractPartFilter):
    """Best linear filter of (x, past signals of the sensor, past received signals of each relay).

    Each line of past signals is as long as its values may still be received. At each step relay i receives r = G l + n
    of the line l of the stage before, whatever is forwarded later: its mean is M l + b, and Cov(r | l) is taken at the
    unconditional moments of l.

    base: the filter of these states, whose plant shifts all lines by one and leaves their first places empty.
    links: the relays' links. lines: for each relay the line that it receives and the place of its received signal, as
    (start, length, place).
    """

    base: AbstractFilter
    links: tuple[SecondOrder, ...]
    lines: tuple[tuple[int, int, int], ...] = eqx.field(static=True)

    @predicts
    def predict(self, state: PyTree, u: ArrayLike = (), k: Step = 0) -> PyTree:
        """Move the plant, send the sensor's signal, and receive it at one relay after another."""
        state = self.base.predict(state, u, k)
        for link, line in zip(self.links, self.lines, strict=True):
            state = _received_by(state, link, *line)
        return state

    def planned(self, inputs: Float[Array, "horizon inputs"]) -> AbstractFilter:
        """Precompute all covariances and gains."""
        return plan(self, inputs, np.eye(len(self.states), len(self.base.states)))


def _received_by(state: PyTree, link: SecondOrder, start: int, length: int, place: int) -> PyTree:
    """Moments after r = G l + n stands at `place`, l the line of `length` from `start` on."""
    # x+ = move x + shift: the received signal replaces what stands at its place.
    gain, offset = jnp.asarray(link.mean_gain), jnp.asarray(link.offset)
    total, m = len(state.mean), len(offset)
    here, there = slice(start, start + length), slice(place, place + m)
    move, shift = jnp.eye(total).at[there, :].set(0.0).at[there, here].set(gain), jnp.zeros(total).at[there].set(offset)
    # Cov(r | l) at the unconditional moments of l.
    mean, covariance = state.state_mean[here], state.state_covariance[here, here]
    second = homogeneous(covariance + jnp.outer(mean, mean), mean, 1.0)
    fresh = jnp.zeros((total, total)).at[there, there].set(link.spread.middle(second, jnp.ones(m, dtype=bool)))
    return state._replace(
        mean=move @ state.mean + shift,
        covariance=symmetrize(move @ state.covariance @ move.T + fresh),
        state_mean=move @ state.state_mean + shift,
        state_covariance=symmetrize(move @ state.state_covariance @ move.T + fresh),
    )


def with_relays(
    plant: AnyPlant, sensor: AnySensor, channel: Relayed
) -> tuple[AnyPlant, LinearSensor, Channel, tuple[tuple[int, int, int], ...]]:
    """Enlarge the plant by all lines of past signals; return it with sensor, last link, and each relay's places.

    Raises:
        ValueError: a plant or sensor that is not linear, links with memory.
    """
    for stage in channel.stages:
        check_forgets("link of a relay that is late by chance", stage)
    # The sensor's line, then one line per relay behind it.
    moved, _, _ = with_past(plant, sensor, channel.stages[0])
    start, lines = len(first(plant).states), []
    total = len(first(moved).states)
    for i, (stage, later) in enumerate(zip(channel.stages, channel.stages[1:], strict=False)):
        lines.append((start, stage.inputs, total))
        start = total
        total += later.inputs
        if isinstance(moved, OverTime):
            moved = over_time([_holding(item, i, stage.outputs, later.past) for item in unstack(moved)])
        else:
            moved = _holding(moved, i, stage.outputs, later.past)
    # The receiver sees the line of the last relay.
    last = LinearSensor(np.eye(total)[start:], np.zeros((total - start, total - start)), first(moved).states[start:])
    return moved, last, of_line(channel.stages[-1]), tuple(lines)


def _holding(plant: PyTree, relay: int, size: int, steps: int) -> LinearPlant:
    """Enlarge the plant by the line of a relay, which shifts by one at each step."""
    held, n = size * (1 + steps), len(plant.states)
    xp, none = library(plant.matrix, plant.input_matrix), Gaussian(np.zeros((held, held)))
    shift = np.kron(np.eye(1 + steps, k=-1), np.eye(size))
    return LinearPlant(
        xp.block([[plant.matrix, np.zeros((n, held))], [np.zeros((held, n)), shift]]),
        Independent([plant.noise, none]),
        xp.concatenate([plant.initial_mean - plant.deviation.mean, np.zeros(held)]),
        Independent([plant.deviation, none]),
        xp.concatenate([plant.input_matrix, np.zeros((held, len(plant.inputs)))]),
        (*plant.states, *(f"relay_{relay}_{j}_{d}_ago" for d in range(1 + steps) for j in range(size))),
        plant.inputs,
    )


def relayed_filter(plant: AnyPlant, channel: Relayed, base: AbstractFilter, lines: PyTree) -> HeldFilter:
    """Build the filter behind relays from `base`, the filter of all lines.

    Raises:
        ValueError: relays' links with uncertain probabilities.
    """
    # Only the moments under known probabilities make the filter optimal.
    links = tuple(second_order(of_line(stage)) for stage in channel.stages[:-1])
    if any(link.uncertain for link in links):
        raise fail("link to a relay that is late by chance", "known probabilities", "uncertain ones")
    start = first(plant)
    return HeldFilter(
        base=base,
        links=links,
        lines=lines,
        claim=base.claim,
        states=start.states,
        inputs=start.inputs,
        received=channel.outputs,
    )
