"""Filters that are told something of the modes: which packets arrived, a flag with each packet, or the mode itself."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter, Step, corrects, predicts
from heliograph.filters.correction import absent, gain_and_bound
from heliograph.filters.innovation import log_density
from heliograph.filters.modal import blocks, measure_matrix, move_matrix, padded
from heliograph.filters.scheduled import pseudo_solve
from heliograph.model.channel import Channel, check_link
from heliograph.model.estimate import Claim, Estimate, Innovation
from heliograph.model.fading import uncertain_chain
from heliograph.model.over_time import OverTime, at, first, over_time, unstack
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor, LinearSensor, check_linear
from heliograph.numerics.check import array, probabilities
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.linalg import symmetrize
from heliograph.numerics.module import Module
from heliograph.numerics.types import Array, ArrayLike, Bool, Float
from heliograph.random_affine.modes import JointModes, joint_modes
from heliograph.random_affine.second_moments import symmetric_product
from heliograph.random_affine.told import Outcome, outcomes, second_moments


class Told(Module):
    """A channel at one step, by mode and by what arrives.

    transition: of the modes from the step before to this one. Of each pattern of components that arrive: `present`, its
    `chance` in each mode, and in that mode and pattern E[(G, n)] and the spread, as a tensor. flags: P(flag | mode).

    Shapes: transition (M, M), present (A, m), chance (M, A), mean (M, A, m, p + 1), spread (M, A, m, m, p + 1, p + 1),
    flags (M, F).
    """

    transition: Float[Array, "M M"]
    present: Bool[Array, "A m"]
    chance: Float[Array, "M A"]
    mean: Float[Array, "M A m p1"]
    spread: Float[Array, "M A m m p1 p1"]
    flags: Float[Array, "M F"]


class ToldBelief(NamedTuple):
    """s, the estimate of zeta (mode after mode), its error's covariance, and E[r r' 1{mode} | flags], r = (x, 1, s).

    Shapes: with N = M (n + 1): mean (N,), covariance (N, N), moments (M, n + 1 + N, n + 1 + N).
    """

    mean: Float[jax.Array, " N"]
    covariance: Float[jax.Array, "N N"]
    moments: Float[jax.Array, "M r r"]
    moved: Bool[jax.Array, ""]


class ToldFilter(AbstractFilter):
    """A linear filter that weighs the modes by what is told with each packet, and knows its error given all that.

    A flag (and whether a packet arrived) changes the law of the modes, and with it what the estimate so far is worth:
    s = E[zeta r'] E[r r']^+ r is found anew from moments given the flags, with r = (1, s, z). Its covariance is exact
    given what was told; a filter that kept all data could do a little better, since earlier gains were right under
    earlier laws.

    It hears z and, where there are `flags`, the number of the flag after it; the likelihood is that of z given these.
    What is lost for reasons that the channel does not know must not depend on the modes. Moments are kept about the
    origin: a state whose mean is beyond 1e5 of its deviations loses the digits that tell them apart.

    Source: the filter of Costa (1994) with moments conditional on what is told.
    """

    plant: AnyPlant
    sensor: AnySensor
    channel: Told | OverTime
    initial: Float[Array, " M"]
    flagged: bool = eqx.field(static=True)
    claim: Claim = eqx.field(static=True)
    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    received: int = eqx.field(static=True)

    @in_float64
    def init(self) -> ToldBelief:
        """The prior, independent of the mode."""
        start, law = at(self.plant, 0), jnp.asarray(self.initial)
        x, spread = jnp.append(jnp.asarray(start.initial_mean), 1.0), padded(jnp.asarray(start.initial_covariance))
        s = jnp.kron(law, x)
        r = jnp.concatenate([x, s])
        square = jnp.outer(r, r).at[: len(x), : len(x)].add(spread)
        covariance = jnp.kron(jnp.diag(law), spread) + jnp.kron(jnp.diag(law) - jnp.outer(law, law), jnp.outer(x, x))
        return ToldBelief(s, covariance, law[:, None, None] * square, jnp.asarray(False))

    @predicts
    def predict(self, state: ToldBelief, u: ArrayLike = (), k: Step = 0) -> ToldBelief:
        """r moves by the plant and by s- = F s, the mode by the chain."""
        plant, channel = at(self.plant, k), at(self.channel, k)
        move, noise = move_matrix(plant, jnp.asarray(u))
        modes, size = len(state.moments), len(move)
        rows = jnp.where(state.moved, jnp.asarray(channel.transition), jnp.eye(modes))
        step = jnp.kron(rows.T, move)
        whole = jax.scipy.linalg.block_diag(move, step)
        law = state.moments[:, size - 1, size - 1]
        carried = whole @ state.moments @ whole.T
        carried = carried.at[:, :size, :size].add(law[:, None, None] * noise)
        moments = jnp.einsum("ij,iab->jab", rows, carried)
        covariance = blocks(moments[:, :size, :size]) - jnp.sum(moments, axis=0)[size:, size:]  # E[zeta s'] = E[s s']
        return ToldBelief(step @ state.mean, symmetrize(covariance), moments, jnp.asarray(True))

    @corrects
    def correct(self, state: ToldBelief, z: ArrayLike, k: Step = 0) -> tuple[ToldBelief, Innovation]:
        """Weigh the modes by the flag and by what arrived, project s anew, then use z."""
        sensor, told, heard = at(self.sensor, k), at(self.channel, k), jnp.asarray(z)
        z, flag = (heard[:-1], heard[-1]) if self.flagged else (heard, jnp.asarray(0.0))
        flag_there, there = ~jnp.isnan(flag), ~jnp.isnan(z)
        number = jnp.clip(jnp.where(flag_there, flag, 0.0).astype(int), 0, told.flags.shape[1] - 1)
        spelled = jnp.where(flag_there, jnp.asarray(told.flags)[:, number], 1.0)
        kind = pattern_of(told, there)
        weight = jnp.asarray(told.chance)[:, kind] * spelled
        size = len(self.states) + 1
        total = weight @ state.moments[:, size - 1, size - 1]
        moments = weight[:, None, None] * state.moments / total
        prior = _projected(state.mean, moments, state.moved, size)
        after, value, covariance = _used(
            prior, sensor, jnp.asarray(told.mean)[:, kind], jnp.asarray(told.spread)[:, kind], z, there
        )
        likelihood = log_density(value, covariance, jnp.abs(z) + jnp.abs(value))
        covariance = jnp.where(there[:, None] & there, covariance, jnp.nan)
        if self.flagged:
            surprise, covariance = with_flag(covariance, flag)
            value = jnp.append(value, surprise)
        return after, Innovation(value, covariance, likelihood)

    @in_float64
    def estimate(self, state: ToldBelief) -> Estimate:
        """x = sum_j zeta^j."""
        n = len(self.states)
        want = np.tile(np.eye(n, n + 1), (1, len(self.initial)))
        return Estimate(want @ state.mean, want @ state.covariance @ want.T, self.claim)


def _projected(s: jax.Array, moments: jax.Array, moved: jax.Array, size: int) -> ToldBelief:
    """The best s in (1, s) under these moments: G B^+ (1, s), G = E[zeta (1, s)'], B = E[(1, s)(1, s)']."""
    modes = len(moments)
    both = jnp.sum(moments, axis=0)[size - 1 :, size - 1 :]
    cross = moments[:, :size, size - 1 :].reshape(modes * size, -1)
    gain = pseudo_solve(both, cross.T).T
    change = jnp.eye(moments.shape[-1]).at[size:, size - 1 :].set(gain).at[size:, : size - 1].set(0.0)
    covariance = symmetrize(blocks(moments[:, :size, :size]) - gain @ cross.T)
    after = change @ moments @ change.T
    return ToldBelief(gain @ jnp.append(1.0, s), covariance, after, moved)


def _used(
    state: ToldBelief, sensor: LinearSensor, mean: jax.Array, spread: jax.Array, z: jax.Array, there: jax.Array
) -> tuple[ToldBelief, jax.Array, jax.Array]:
    """The update with what arrived; what was not expected, and its covariance."""
    measure, noise = measure_matrix(sensor)
    size = measure.shape[1]
    law = state.moments[:, size - 1, size - 1]
    output = mean @ measure
    second = measure @ state.moments[:, :size, :size] @ measure.T + law[:, None, None] * noise
    added = jnp.einsum("jmlab,jab->jml", spread, second) + law[:, None, None] * (mean @ noise @ mean.swapaxes(1, 2))
    joined = jnp.concatenate(list(output), axis=1)
    cross, value = joined @ state.covariance, z - joined @ state.mean
    total = cross @ joined.T + jnp.sum(added, axis=0)
    seen = jnp.where(there[:, None] & there, total, 0.0) + absent(there)
    gain, covariance = gain_and_bound(state.covariance, jnp.where(there[:, None], cross, 0.0), seen)
    change = jnp.tile(jnp.eye(state.moments.shape[-1]), (len(law), 1, 1))
    change = change.at[:, size:, :size].add(gain @ output).at[:, size:, size:].add(-gain @ joined)
    moments = change @ state.moments @ change.swapaxes(1, 2)
    moments = moments.at[:, size:, size:].add(gain @ added @ gain.T)
    after = ToldBelief(state.mean + gain @ jnp.where(there, value, 0.0), covariance, moments, state.moved)
    return after, value, total


def pattern_of(told: Told, there: Bool[Array, " m"]) -> jax.Array:
    """The smallest pattern that can be and in which everything that is there arrives."""
    present, possible = jnp.asarray(told.present), jnp.any(jnp.asarray(told.chance) > 0, axis=0)
    fits = jnp.all(present | ~there, axis=1) & possible
    return jnp.argmin(jnp.where(fits, jnp.sum(present, axis=1), present.shape[1] + 1))


def with_flag(covariance: jax.Array, flag: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Innovation of a flag, which is told and not estimated: 0, or NaN if missing; no covariance with anything."""
    surprise = jnp.where(jnp.isnan(flag), jnp.nan, 0.0)
    lost = jnp.isnan(jnp.append(jnp.diagonal(covariance), surprise))
    wide = jnp.pad(covariance, ((0, 1), (0, 1)))
    return surprise, jnp.where(lost[:, None] | lost, jnp.nan, jnp.nan_to_num(wide))


def told_filter(plant: AnyPlant, sensor: AnySensor, channel: Channel, flags: ArrayLike | None = None) -> ToldFilter:
    """The linear filter that uses what is told of the modes: which packets arrived, and a flag with each.

    `channel` may lose data with probabilities that depend on the mode (`erasure` in its modes). `flags` are P(flag |
    mode), the modes as in `joint_modes`; the filter then hears (z, flag), as `with_flag` delivers it. Flags that reveal
    the mode make it the Kalman filter given the modes.

    Claim: "exact"; "nominal" where probabilities are uncertain.

    Shapes: flags (modes, flags).

    Raises:
        ValueError: a plant or sensor that is not linear, parts that do not fit, flags that are no probabilities.
    Source: the filter of Costa (1994) with moments conditional on what is told.
    """
    check_linear("told filter", plant, sensor)
    start = first(plant)
    check_link(first(sensor), first(channel), len(start.states))
    steps = [joint_modes(c) for c in (unstack(channel) if isinstance(channel, OverTime) else [channel])]
    modes = len(steps[0].initial)
    chances = np.ones((modes, 1)) if flags is None else array("flags", flags, (modes, None))
    for i, row in enumerate(chances):
        probabilities(f"flags in mode {i}", row)
    described = by_pattern(steps, chances)
    known = all(m.corner_count() == 1 for one in steps for m in one.maps) and not uncertain_chain(channel)
    return ToldFilter(
        plant=plant,
        sensor=sensor,
        channel=over_time(described) if isinstance(channel, OverTime) else described[0],
        initial=steps[0].initial,
        flagged=flags is not None,
        claim="exact" if known else "nominal",
        states=start.states,
        inputs=start.inputs,
        received=first(channel).outputs + (flags is not None),
    )


def by_pattern(steps: Sequence[JointModes], flags: Float[np.ndarray, "M F"]) -> list[Told]:
    """The modes at each step by what arrives, with the patterns of all steps, and how they moved there."""
    each = [[outcomes(m) for m in one.maps] for one in steps]
    found = {tuple(o.arrived) for modes in each for parts in modes for o in parts}
    kinds = sorted(found, key=lambda kind: (sum(kind), kind))
    before = [steps[0], *steps[:-1]]
    return [_told(modes, kinds, last, flags) for modes, last in zip(each, before, strict=True)]


def _told(
    each: list[list[Outcome]], kinds: list[tuple[bool, ...]], before: JointModes, flags: Float[np.ndarray, "M F"]
) -> Told:
    m, p = each[0][0].map.outputs, each[0][0].map.inputs + 1
    shape = (len(each), len(kinds))
    chance, mean, second = np.zeros(shape), np.zeros((*shape, m, p)), np.zeros((*shape, m, m, p, p))
    for j, parts in enumerate(each):
        for part in parts:
            a, (first_order, second_order) = kinds.index(tuple(part.arrived)), second_moments(part.map)
            chance[j, a] += part.probability
            mean[j, a] += part.probability * first_order
            second[j, a] += part.probability * second_order
    divisor = np.where(chance > 0, chance, 1.0)
    mean, second = mean / divisor[..., None, None], second / divisor[..., None, None, None, None]
    spread = second - np.array([[symmetric_product(one, one) for one in row] for row in mean])
    return Told(before.transition, np.array(kinds).reshape(len(kinds), m), chance, mean, spread, flags)
