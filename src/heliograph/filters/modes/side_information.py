"""Filters with side information on the modes: which packets arrived, a flag with each packet, or the mode itself."""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compiled
from heliograph.factors.columns import Columns
from heliograph.filters.base import AbstractSizedFilter, Step, corrects, estimates, predicts, sized
from heliograph.filters.gaussian.belief import start_of
from heliograph.filters.gaussian.correction import absent, gain_and_bound, is_precise
from heliograph.filters.gaussian.precise import above_rounding, noise_rounding, output_rounding
from heliograph.filters.innovation import log_density
from heliograph.filters.modes.modal import (
    beside,
    measured_about,
    moved_about,
    padded,
    sum_of_modes,
    without_common,
)
from heliograph.model.channel import Channel, check_link
from heliograph.model.estimate import Estimate, Innovation, given_bounds
from heliograph.model.fading import uncertain_chain, with_flag
from heliograph.model.over_time import OverTime, at, at_each_step, first, over_time, unstack
from heliograph.model.plant import AnyPlant, LinearPlant
from heliograph.model.premise import Premise, believing
from heliograph.model.sensor import AnySensor, LinearSensor, check_linear
from heliograph.numerics.caching import cached
from heliograph.numerics.check import array, probabilities
from heliograph.numerics.lapack import pseudo_solve
from heliograph.numerics.linalg import PRECISE, rounding, spread_of, symmetrize
from heliograph.numerics.module import Module
from heliograph.numerics.types import Array, ArrayLike, Bool, Float
from heliograph.random_affine.base import memories
from heliograph.random_affine.erasure import Outcome, outcomes, second_moments
from heliograph.random_affine.modes import JointModes, joint_modes
from heliograph.random_affine.moments.second_moments import divided, symmetric_product, undivided


class SideInformation(Module):
    """A channel at one step, by mode and by pattern of arrivals.

    transition: of the modes from the step before to this one. For each pattern of components that arrive: `present`,
    its `chance` in each mode, and in that mode and pattern E[(G, n)] and, as in `SecondOrder`, `gain_spread` and
    `noise`. flags: P(flag | mode).

    Shapes: transition (M, M), present (A, m), chance (M, A), mean (M, A, m, p + 1), gain_spread (M, A, m, m, p + 1,
    p + 1), noise (M, A, m, m), flags (M, F).
    """

    transition: Float[Array, "M M"]
    present: Bool[Array, "A m"]
    chance: Float[Array, "M A"]
    mean: Float[Array, "M A m p1"]
    gain_spread: Float[Array, "M A m m p1 p1"]
    noise: Columns
    flags: Float[Array, "M F"]

    @property
    def spread(self) -> Float[Array, "M A m m p1 p1"]:
        """E[((G, n) - mean) Y ((G, n) - mean)' | mode, pattern] as a tensor."""
        return undivided(self.gain_spread, self.noise)


class SideInformationBelief(NamedTuple):
    """s, the estimate of zeta, and E[r r' 1{mode} | side information] of r = (x~, s, e), with the error e = zeta - s.

    x~ = (x - c, 1), c = E[x] before any data, and zeta holds x~ 1{mode}, mode after mode. Both s and e are carried
    though s + e = zeta is known: no covariance is the difference of larger ones.

    Shapes: with N = M (n + 1): centre (n,), mean (N,), moments (M, n + 1 + 2 N, n + 1 + 2 N).
    """

    centre: Float[jax.Array, " n"]
    mean: Float[jax.Array, " N"]
    moments: Float[jax.Array, "M r r"]
    moved: Bool[jax.Array, ""]

    @property
    def covariance(self) -> Float[jax.Array, "N N"]:
        """E[e e' | side information]."""
        count = len(self.mean)
        return jnp.sum(self.moments, axis=0)[-count:, -count:]


class SideInformationFilter(AbstractSizedFilter):
    """A linear filter that weights the modes by side information with each packet, and conditions its covariance on it.

    A flag (and whether a packet arrived) changes the law of the modes, and with it the accuracy of the estimate so far:
    s = E[zeta r'] E[r r']^+ r is recomputed from moments given the flags, with r = (1, s, z). Its covariance is exact
    given the side information; a filter of all past data could do a little better, since earlier gains were optimal
    under earlier laws.

    Its measurement is z and, where there are `flags`, the number of the flag after it; the likelihood is that of z
    given these. Losses that the channel does not model must not depend on the modes. Moments are those of x - E[x], and
    the error has moments of its own: a mean far from zero costs no digits, and with one mode no precise measurement
    does. With several, x is the sum of its parts in each. What the products of moments leave of rounding, eps |F|^2 of
    the deviations, is added to the error's variances, and after a precise measurement that of the mean: so that what is
    claimed is never less than nothing, and no data without noise take it to where rounding decides.

    Source: the filter of Costa (1994) with moments conditional on the side information.
    """

    plant: AnyPlant
    sensor: AnySensor
    channel: SideInformation | OverTime
    initial: Float[Array, " M"]
    flagged: bool = eqx.field(static=True)

    @compiled
    def init(self) -> SideInformationBelief:
        """Return the prior, independent of the mode."""
        start, law = at(self.plant, 0), jnp.asarray(self.initial)
        modes, unit = len(law), jnp.zeros(len(self.states) + 1).at[-1].set(1.0)
        expected = jnp.kron(law, unit)
        # E[r | mode], of which x alone varies.
        known = [jnp.concatenate([unit, expected, jnp.kron(of_mode - law, unit)]) for of_mode in np.eye(modes)]
        moments = _of_state(padded(jnp.asarray(start.initial_covariance)), modes)
        moments = law[:, None, None] * (moments + jnp.stack([jnp.outer(r, r) for r in known]))
        return SideInformationBelief(jnp.asarray(start.initial_mean), expected, moments, jnp.asarray(False))

    @predicts
    def predict(self, state: SideInformationBelief, u: ArrayLike = (), k: Step = 0) -> SideInformationBelief:
        """s+ = F s; where the mode goes from i to j, e+ = F e + (1_j - p_i) x A~ x~ + 1_j x w~."""
        plant, channel = at(self.plant, k), at(self.channel, k)
        move, noise, centre = moved_about(plant, u, state.centre)
        modes, size = len(state.moments), len(move)
        rows = jnp.where(state.moved, jnp.asarray(channel.transition), jnp.eye(modes))
        step, law = jnp.kron(rows.T, move), state.moments[:, size - 1, size - 1]
        carried = _carried(_mirrored(state.moments), move[:-1, :-1], rows)
        # e in mode j: F e + (1_j - p_i) x A~ x~, with the random transition of the mode.
        chosen = jnp.eye(modes) - rows[:, None]
        moments = _with_transition(carried, rows, chosen) + (law @ rows)[:, None, None] * _of_state(noise, modes)
        # The rounding of these products.
        reach = _deviation(state.moments).reshape(modes, -1, size) @ jnp.abs(move).T
        error = jnp.einsum("lj,ila->ija", rows, reach[:, 1 + modes :])
        reached = jnp.abs(chosen)[..., None] * reach[:, None, None, 0] + error[:, None]
        rounded = jnp.einsum("ij,ijla->jla", rows, reached**2).reshape(modes, -1)
        moments = _with_rounding(moments, rounded)
        return SideInformationBelief(centre, step @ state.mean, moments, jnp.asarray(True))

    @corrects
    def correct(
        self, state: SideInformationBelief, z: ArrayLike, k: Step = 0
    ) -> tuple[SideInformationBelief, Innovation]:
        """Weight the modes by the flag and by the pattern of arrivals, project s again, then use z."""
        sensor, known, observed = at(self.sensor, k), at(self.channel, k), jnp.asarray(z)
        z, flag = (observed[:-1], observed[-1]) if self.flagged else (observed, jnp.asarray(0.0))
        # P(flag, pattern | mode).
        flag_there, there = ~jnp.isnan(flag), ~jnp.isnan(z)
        number = jnp.clip(jnp.where(flag_there, flag, 0.0).astype(int), 0, known.flags.shape[1] - 1)
        spelled = jnp.where(flag_there, jnp.asarray(known.flags)[:, number], 1.0)
        kind = pattern_of(known, there)
        weight = jnp.asarray(known.chance)[:, kind] * spelled
        size = len(self.states) + 1
        # Moments given the side information, and the best s under them.
        weight = weight / (weight @ state.moments[:, size - 1, size - 1])
        moments = weight[:, None, None] * _mirrored(state.moments)
        prior = _projected(state._replace(moments=moments), size)
        # Kalman update of zeta with the components that arrived, and the rounding of the mean.
        after, value, covariance, precise = _used(
            prior, sensor, jnp.asarray(known.mean)[:, kind], jnp.asarray(known.spread)[:, kind], z, there,
            received_rounding(sensor, start_of(at(self.plant, 0)), jnp.asarray(known.mean)[:, kind]),
        )  # fmt: skip
        law = after.moments[:, size - 1, size - 1]
        shares = mean_rounding(at(self.plant, 0), law, after.covariance, prior.covariance, precise)
        errors = slice(-len(after.mean), None)
        after = after._replace(moments=after.moments.at[:, errors, errors].add(law[:, None, None] * shares))
        likelihood = log_density(value, covariance, jnp.abs(z) + jnp.abs(value))
        covariance = jnp.where(there[:, None] & there, covariance, jnp.nan)
        if self.flagged:
            nis, covariance = append_flag(covariance, flag)
            value = jnp.append(value, nis)
        return after, Innovation(value, covariance, likelihood)

    @estimates
    def estimate(self, state: SideInformationBelief) -> Estimate:
        """x - c = sum_j zeta^j."""
        projection = sum_of_modes(len(self.states), len(self.initial))
        return Estimate(
            state.centre + projection @ state.mean, projection @ state.covariance @ projection.T, self.claim
        )


def _mirrored(moments: jax.Array) -> jax.Array:
    """Moments (M, r, r) that are symmetric but for rounding, of their upper triangle: half of the products is done."""
    return jnp.where(np.triu(np.ones(moments.shape[1:], bool)), moments, moments.swapaxes(1, 2))


def _of_state(covariance: jax.Array, modes: int) -> jax.Array:
    """E[r r'] in each mode (M, r, r) of what x~ gains, with this covariance: in x~ and in e of the mode."""
    gains = np.zeros((modes, 1 + 2 * modes), bool)
    gains[:, 0], gains[:, 1 + modes :] = True, np.eye(modes)
    there = np.kron(gains[:, :, None] & gains[:, None, :], np.ones(covariance.shape, bool))
    return jnp.where(there, jnp.tile(covariance, (gains.shape[1],) * 2), 0.0)


def _carried(moments: jax.Array, transition: jax.Array, rows: jax.Array) -> jax.Array:
    """E[r r'] (M, r, r) with each x~ in r moved by A~ = diag(A, 1), those in s and in e then mixed by the chain."""
    modes, n = len(rows), len(transition)

    def act(columns: jax.Array) -> jax.Array:
        parts = columns.reshape(modes, -1, n + 1, columns.shape[-1])
        moved = jnp.concatenate([jnp.einsum("ab,itbc->itac", transition, parts[:, :, :n]), parts[:, :, n:]], axis=2)
        apart = moved[:, 1:].reshape(modes, 2, modes, -1)
        mixed = jnp.einsum("lj,itlc->itjc", rows, apart).reshape(modes, 2 * modes, n + 1, -1)
        return jnp.concatenate([moved[:, :1], mixed], axis=1).reshape(columns.shape)

    return _turned(moments, act)


def _with_transition(moments: jax.Array, rows: jax.Array, chosen: jax.Array) -> jax.Array:
    """E[r r'] in each next mode j, sum_i Pi_ij E[r r' | i], where e gains c_ij x x~, c = `chosen` (M, M, M)."""
    modes, size = len(rows), moments.shape[1] // (1 + 2 * len(rows))
    weights, errors = rows[:, :, None] * chosen, slice(-modes * size, None)
    squares = weights[..., None] * chosen[:, :, None]
    cross = jnp.einsum("ijl,iab->jlab", weights, moments[:, :size]).reshape(modes, modes * size, -1)
    square = jnp.einsum("ijlm,iab->jlamb", squares, moments[:, :size, :size]).reshape(modes, modes * size, -1)
    of_next = jnp.einsum("ij,iab->jab", rows, moments)
    of_next = of_next.at[:, :, errors].add(cross.swapaxes(1, 2)).at[:, errors].add(cross)
    return _mirrored(of_next.at[:, errors, errors].add(square))


def _turned(moments: jax.Array, act: Callable[[jax.Array], jax.Array]) -> jax.Array:
    """F E[r r'] F' (M, r, r), where `act` is the product of F with columns (M, r, c)."""
    return _mirrored(act(act(moments).swapaxes(1, 2)))


def _deviation(moments: jax.Array) -> jax.Array:
    """Deviations (..., r)."""
    return jnp.sqrt(jnp.maximum(jnp.diagonal(moments, axis1=-2, axis2=-1), 0.0))


def _with_rounding(moments: jax.Array, squares: jax.Array) -> jax.Array:
    """Add to the last variances, the errors', four eps of (|F| d)^2, d the deviations: the products' F E[r r'] F'."""
    count = squares.shape[-1]
    rounded = 4 * float(np.finfo(moments.dtype).eps) * squares
    return moments.at[..., -count:, -count:].add(jnp.where(np.eye(count, dtype=bool), rounded[..., None], 0.0))


def _projected(state: SideInformationBelief, size: int) -> SideInformationBelief:
    """Best s in (1, s) under these moments: s + D (1, s), D = E[e (1, s)'] E[(1, s)(1, s)']^+.

    Moments of e are exact under any D. Directions of s of next to no variance are left as they are: what the products
    of moments leave of rounding there would be divided by it.
    """
    count, total = len(state.mean), jnp.sum(state.moments, axis=0)
    known = slice(size - 1, size + count)
    change = pseudo_solve(total[known, known], total[known, -count:], rounding(PRECISE, total, 1000)).T

    def act(r: jax.Array) -> jax.Array:
        gained = change @ r[:, known]
        return jnp.concatenate([r[:, :size], r[:, size:-count] + gained, r[:, -count:] - gained], axis=1)

    moments, deviation = _turned(state.moments, act), _deviation(state.moments)
    reach = deviation[:, -count:] + deviation[:, known] @ jnp.abs(change).T
    mean = state.mean + change @ jnp.append(1.0, state.mean)
    return state._replace(mean=mean, moments=_with_rounding(moments, reach**2))


def _used(
    state: SideInformationBelief,
    sensor: LinearSensor,
    mean: jax.Array,
    spread: jax.Array,
    z: jax.Array,
    there: jax.Array,
    of_z: jax.Array,
) -> tuple[SideInformationBelief, jax.Array, jax.Array, jax.Array]:
    """Update by e+ = (I - K H) e - K noise; returns the innovation and covariance, and if it is precise."""
    measure, noise = measured_about(sensor, state.centre)
    size = measure.shape[1]
    # Cov(z | zeta, mode) = T_j(E[y y' 1{j}]) + P(j) Hbar_j R~ Hbar_j', and the rounding of z.
    law = state.moments[:, size - 1, size - 1]
    second = measure @ state.moments[:, :size, :size] @ measure.T + law[:, None, None] * noise
    added = jnp.einsum("jmlab,jab->jml", spread, second) + law[:, None, None] * (mean @ noise @ mean.swapaxes(1, 2))
    added = added + law[:, None, None] * jnp.diag(of_z)
    # Output matrix of zeta less the mean output; modes of probability zero have none.
    output, common = without_common(mean @ measure, law)
    output = beside(jnp.where(law[:, None, None] > 0, output, 0.0))
    prior = state.covariance
    # S = H P H' + sum_j Cov(z | zeta, j), K = P H' S^-1, with the rounding of S, which no difference of modes is below.
    cross, value = output @ prior, z - common - output @ state.mean
    total = cross @ output.T + jnp.sum(added, axis=0)
    rounded = _with_rounding(symmetrize(total), (jnp.abs(output) @ _deviation(prior)) ** 2)
    seen = jnp.where(there[:, None] & there, rounded, 0.0) + absent(there)
    gain, _ = gain_and_bound(prior, jnp.where(there[:, None], cross, 0.0), seen)
    # s+ = s + K (H e + noise), e+ = e - K (H e + noise).
    count, left = len(prior), jnp.eye(len(prior)) - gain @ output

    def act(r: jax.Array) -> jax.Array:
        e = r[:, -count:]
        return jnp.concatenate([r[:, :size], r[:, size:-count] + gain @ (output @ e), left @ e], axis=1)

    reach = _deviation(state.moments)[:, -count:] @ jnp.abs(left).T
    moments = _with_rounding(_turned(state.moments, act), reach**2)
    noise_of = jax.vmap(spread_of, in_axes=(None, 0))(gain, added)
    moments = moments.at[:, size:, size:].add(jnp.kron(jnp.array([[1.0, -1.0], [-1.0, 1.0]]), noise_of))
    after = state._replace(mean=state.mean + gain @ jnp.where(there, value, 0.0), moments=moments)
    fresh = jnp.where(there[:, None] & there, jnp.sum(added, axis=0), 0.0) + absent(there)
    return after, value, total, is_precise(seen, fresh)


def received_rounding(sensor: LinearSensor, size: jax.Array, gains: jax.Array) -> jax.Array:
    """Variance (m,) that rounding gives to z by what the outputs are off, behind the greatest of the modes' gains."""
    of_noise = noise_rounding(sensor.noise.mean, sensor.noise.covariance)
    of_outputs = output_rounding(sensor.matrix, size) + of_noise
    largest: jax.Array = jnp.max(jnp.abs(gains[..., :-1]) @ of_outputs, axis=0)
    return largest**2


def mean_rounding(
    start: LinearPlant, law: jax.Array, after: jax.Array, prior: jax.Array, precise: jax.Array | bool = False
) -> jax.Array:
    """Return what `above_rounding` adds to x = sum_j zeta^j, a part to each mode by its probability: (N, N)."""
    n, size = len(start.initial_mean), start_of(start)
    projection = sum_of_modes(n, len(law))
    left, whole = (projection @ covariance @ projection.T for covariance in (after, prior))
    return jnp.kron(jnp.diag(law), padded(above_rounding(left, whole, size, precise) - left))


def pattern_of(channel: SideInformation, there: Bool[Array, " m"]) -> jax.Array:
    """Index of the smallest possible pattern in which every component that is there arrives."""
    present, possible = jnp.asarray(channel.present), jnp.any(jnp.asarray(channel.chance) > 0, axis=0)
    fits = jnp.all(present | ~there, axis=1) & possible
    return jnp.argmin(jnp.where(fits, jnp.sum(present, axis=1), present.shape[1] + 1))


def append_flag(covariance: jax.Array, flag: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Innovation of a flag, which is known and not estimated: 0, or NaN if missing; uncorrelated with everything."""
    nis = jnp.where(jnp.isnan(flag), jnp.nan, 0.0)
    lost = jnp.isnan(jnp.append(jnp.diagonal(covariance), nis))
    wide = jnp.pad(covariance, ((0, 1), (0, 1)))
    return nis, jnp.where(lost[:, None] | lost, jnp.nan, jnp.nan_to_num(wide))


def side_information_filter(
    plant: AnyPlant, sensor: AnySensor, channel: Channel, flags: Float[ArrayLike, "modes flags"] | None = None
) -> SideInformationFilter:
    """Linear filter with side information on the modes: which packets arrived, and a flag with each.

    Args:
        plant: a linear plant, n states.
        sensor: a linear sensor, m outputs.
        channel: from the sensor to the filter; it may lose data with probabilities that depend on the mode (`erasure`
            in its modes).
        flags: P(flag | mode), shape (modes, flags), the modes as in `joint_modes`; the measurement is then (z, flag),
            as `with_flag` delivers it. Flags that identify the mode make it the Kalman filter given the modes. None by
            default: no flags.

    Claim: "exact"; "upper" where noise is known by bounds, "nominal" where probabilities are uncertain.

    Raises:
        ValueError: a plant or sensor that is not linear, parts that do not fit, flags that are no probabilities.

    Source: the filter of Costa (1994) with moments conditional on the side information.
    """
    check_linear("side-information filter", plant, sensor)
    check_link(first(sensor), first(channel), len(first(plant).states))
    initial, steps, known = _described(channel)
    # P(flag | mode); one flag that is always the same where there are none.
    if flags is not None:
        chances = array("flags", flags, (len(initial), None))
        for i, row in enumerate(chances):
            probabilities(f"flags in mode {i}", row)
        steps = [replace(step, flags=chances) for step in steps]
    claim = given_bounds("exact" if known else "nominal", plant, sensor, channel)
    filter = SideInformationFilter(
        plant=plant,
        sensor=sensor,
        channel=over_time(steps) if isinstance(channel, OverTime) else steps[0],
        initial=initial,
        flagged=flags is not None,
        **sized(claim, first(plant), first(channel).outputs + (flags is not None)),
    )
    if flags is not None and len(memories(channel)) != 1:  # of several chains' joint mode: no channel delivers them
        return filter
    received = channel if flags is None else at_each_step(lambda link: with_flag(link, chances), channel)
    return believing(filter, Premise(plant, sensor, received))


@cached
def _described(channel: Channel) -> tuple[Float[Array, " M"], list[SideInformation], bool]:
    """Law of a channel's first mode, its moments at each step, and whether all of its probabilities are known."""
    steps = [joint_modes(c) for c in unstack(channel)]
    known = all(m.corner_count() == 1 for step in steps for m in step.maps) and not uncertain_chain(channel)
    return steps[0].initial, by_pattern(steps, np.ones((len(steps[0].initial), 1))), known


def by_pattern(steps: Sequence[JointModes], flags: Float[np.ndarray, "M F"]) -> list[SideInformation]:
    """Moments of the channel at each step by mode and pattern of arrivals, with the patterns of all steps."""
    items = [[outcomes(m) for m in step.maps] for step in steps]
    results = {tuple(o.arrived) for modes in items for parts in modes for o in parts}
    kinds = sorted(results, key=lambda kind: (sum(kind), kind))
    before = [steps[0], *steps[:-1]]
    return [_side_information(modes, kinds, last, flags) for modes, last in zip(items, before, strict=True)]


def _side_information(
    outcomes: list[list[Outcome]], kinds: list[tuple[bool, ...]], before: JointModes, flags: Float[np.ndarray, "M F"]
) -> SideInformation:
    m, p = outcomes[0][0].map.outputs, outcomes[0][0].map.inputs + 1
    shape = (len(outcomes), len(kinds))
    # Sums over the outcomes of each mode: P, P E[(G, n)] and P E[(G, n) x (G, n)].
    chance, mean, second = np.zeros(shape), np.zeros((*shape, m, p)), np.zeros((*shape, m, m, p, p))
    for j, of_mode in enumerate(outcomes):
        for outcome in of_mode:
            a, (first_order, second_order) = kinds.index(tuple(outcome.arrived)), second_moments(outcome.map)
            chance[j, a] += outcome.probability
            mean[j, a] += outcome.probability * first_order
            second[j, a] += outcome.probability * second_order
    # Conditional moments given mode and pattern.
    divisor = np.where(chance > 0, chance, 1.0)
    mean, second = mean / divisor[..., None, None], second / divisor[..., None, None, None, None]
    spread = second - np.array([[symmetric_product(gain, gain) for gain in row] for row in mean])
    gains, noises = zip(*(divided(part) for row in spread for part in row), strict=True)
    noise = Columns(*(np.reshape(part, (*shape, *np.shape(part[0]))) for part in zip(*noises, strict=True)))
    present = np.array(kinds).reshape(len(kinds), m)
    return SideInformation(before.transition, present, chance, mean, np.reshape(gains, spread.shape), noise, flags)
