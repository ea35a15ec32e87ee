"""A channel at one step by mode and by which components arrive, and flags that come with a packet."""

from collections.abc import Sequence
from typing import Protocol

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.covariance_factors import WeightedColumns
from heliograph.model.channel import Channel
from heliograph.model.over_time import first, unstack
from heliograph.numerics.module import Module
from heliograph.numerics.numpy_or_jax import is_traced, library
from heliograph.numerics.types import Array, Bool, Float
from heliograph.random_affine.base import ArrivalOutcome
from heliograph.random_affine.erasure import second_moments
from heliograph.random_affine.memories_of_channels import memories
from heliograph.random_affine.modes import JointModes, joint_modes
from heliograph.random_affine.moments.gain_and_noise_covariances import join_gain_and_noise, split_off_noise
from heliograph.random_affine.moments.moment_tensors import symmetric_product


class ChannelByPattern(Module):
    """A channel at one step, by mode and by pattern of arrivals.

    transition: of the modes from the step before to this one. For each pattern of components that arrive: `present`,
    its `chance` in each mode, and in that mode and pattern E[(G, n)] and, as in `SecondOrder`, `gain_covariance` and
    `noise`. flags: P(flag | mode).

    Shapes: transition (M, M), present (A, m), chance (M, A), mean (M, A, m, p + 1), gain_covariance (M, A, m, m, p + 1,
    p + 1), noise (M, A, m, m), flags (M, F).
    """

    transition: Float[Array, "M M"]
    present: Bool[Array, "A m"]
    chance: Float[Array, "M A"]
    mean: Float[Array, "M A m p1"]
    gain_covariance: Float[Array, "M A m m p1 p1"]
    noise: WeightedColumns
    flags: Float[Array, "M F"]

    @property
    def covariance(self) -> Float[Array, "M A m m p1 p1"]:
        """Covariances Cov((G, n)_ik, (G, n)_jl | mode, pattern of arrivals), for z = G y + n.

        Axes: mode, pattern, i, j (components of z), k, l (components of y, and n as the last).
        """
        return join_gain_and_noise(self.gain_covariance, self.noise)


def describe_by_pattern(steps: Sequence[JointModes], flags: Float[np.ndarray, "M F"]) -> list[ChannelByPattern]:
    """Return the channel at each step by mode and by pattern of arrivals, with the same patterns at all steps.

    A pattern says which components arrive. A flag is a received number that depends on the mode, and `flags` holds
    P(flag | mode). `JointModes` of a step hold the transition that leads from it to the next step, so the channel at
    step k gets that of step k - 1. The first step gets its own: it may stand for all steps.
    """
    # For each step and mode the outcomes: which components arrive, by which random map, with which probability.
    outcomes_by_step = [[mode.list_outcomes() for mode in step.maps] for step in steps]
    distinct = {tuple(o.arrived) for modes in outcomes_by_step for outcomes in modes for o in outcomes}
    patterns = sorted(distinct, key=lambda pattern: (sum(pattern), pattern))  # first those with fewer arrivals
    previous_steps = [steps[0], *steps[:-1]]
    return [
        _describe_step_by_pattern(outcomes, patterns, step_before, flags)
        for outcomes, step_before in zip(outcomes_by_step, previous_steps, strict=True)
    ]


def _describe_step_by_pattern(
    outcomes: list[list[ArrivalOutcome]],
    patterns: list[tuple[bool, ...]],
    modes_before: JointModes,
    flags: Float[np.ndarray, "M F"],
) -> ChannelByPattern:
    """Return the channel of one step by mode and pattern of arrivals.

    Args:
        outcomes: of each mode, what may arrive: a probability, which components arrive, and the random map z = G y + n.
        patterns: all patterns of arrivals, each (m,).
        modes_before: those of the step before, with the transition to this step's.
        flags: P(flag | mode).
    """
    some_map = outcomes[0][0].map
    m, p = some_map.outputs, some_map.inputs + 1  # (G, n) is (m, p)
    shape = (len(outcomes), len(patterns))
    # Sums over the outcomes of each mode and pattern: P, P E[(G, n)] and P E[(G, n) x (G, n)]; moments may be traced.
    chance = np.zeros(shape)
    firsts: list[Array] = [np.zeros((m, p))] * chance.size
    seconds: list[Array] = [np.zeros((m, m, p, p))] * chance.size
    for j, outcomes_of_mode in enumerate(outcomes):
        for outcome in outcomes_of_mode:
            a = patterns.index(tuple(outcome.arrived))
            first_order, second_order = second_moments(outcome.map)
            chance[j, a] += outcome.probability
            index = j * len(patterns) + a
            firsts[index] = firsts[index] + outcome.probability * first_order
            seconds[index] = seconds[index] + outcome.probability * second_order
    # Moments given mode and pattern; where the pattern cannot occur they are 0.
    xp, divisor = library(firsts, seconds), np.where(chance > 0, chance, 1.0)
    means = [one / share for one, share in zip(firsts, divisor.flat, strict=True)]
    covariances = [one / share - symmetric_product(gain, gain)
                   for one, share, gain in zip(seconds, divisor.flat, means, strict=True)]  # fmt: skip
    gains, noises = zip(*map(split_off_noise, covariances), strict=True)
    noise = WeightedColumns(
        *(xp.reshape(xp.stack(part), (*shape, *np.shape(part[0]))) for part in zip(*noises, strict=True))
    )
    return ChannelByPattern(
        transition=modes_before.transition,
        present=np.array(patterns).reshape(len(patterns), m),
        chance=chance,
        mean=xp.reshape(xp.stack(means), (*shape, m, p)),
        gain_covariance=xp.reshape(xp.stack(gains), (*shape, m, m, p, p)),
        noise=noise,
        flags=flags,
    )


def has_same_law_in_every_mode(channel: ChannelByPattern) -> bool:
    """Return whether what arrives has the same mean and covariance in every mode in which it can arrive.

    This must hold for each pattern of arrivals (which components come). Then a value needs one update, not one for each
    mode of the link.
    """
    possible = np.asarray(channel.chance) > 0  # (mode, pattern of arrivals)
    for a, modes in enumerate(possible.T):
        if not channel.present[a].any() or not modes.any():
            continue
        for moment in (np.asarray(channel.mean), np.asarray(channel.covariance)):  # (mode, pattern, ...) each
            by_mode = moment[modes, a]
            if not np.array_equal(by_mode, np.broadcast_to(by_mode[:1], by_mode.shape)):
                return False
    return True


def losses_tell_of_gains(channel: Channel) -> bool:
    """Return whether what is lost says something of the law of what arrives, since a mode of the link decides on both.

    A link that was good for a while loses little and has a large gain, say. Then a filter that reckons with the modes
    takes a value that is refused for one that was lost, and so for a sign of a bad link.

    Args:
        channel: a link, with its losses; it may vary over time.
    """
    link = first(channel)
    if not (link.erases and link.remembers):
        return False
    # Delays and gains that drift have no finite number of modes here, and of traced numbers nothing can be said.
    drifts = any(memory.drifts for memory in memories(link).values())
    if link.past or drifts or any(is_traced(leaf) for leaf in jax.tree.leaves(channel)):
        return True
    modes = [joint_modes(step) for step in unstack(channel)]
    no_flags = np.ones((len(modes[0].initial), 1))
    return not all(has_same_law_in_every_mode(step) for step in describe_by_pattern(modes, no_flags))


class HasPatterns(Protocol):
    """A channel by pattern of arrivals: which components arrive in each, and the pattern's chance in each mode."""

    @property
    def present(self) -> Bool[Array, "A m"]:
        """Flags (A, m): which components of z arrive in each of A patterns."""

    @property
    def chance(self) -> Float[Array, "M A"]:
        """Probabilities (M, A) of each pattern of arrivals in each mode."""


def pattern_of(channel: HasPatterns, arrived: Bool[Array, " m"]) -> jax.Array:
    """Return the index of the smallest possible pattern in which all components that arrived arrive.

    A larger pattern is possible too, if numbers that arrived were replaced by NaN. `channel.present` (pattern,
    component) says what arrives, and `channel.chance` (mode, pattern) holds probabilities.
    """
    present, possible = jnp.asarray(channel.present), jnp.any(jnp.asarray(channel.chance) > 0, axis=0)
    is_candidate = jnp.all(present | ~arrived, axis=1) & possible
    arrivals = jnp.sum(present, axis=1)
    return jnp.argmin(jnp.where(is_candidate, arrivals, present.shape[1] + 1))


def append_flag(covariance: jax.Array, flag: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return the innovation of a flag, and the innovations' covariance with a row and column for it.

    A flag is a received number that tells the mode of a link. Its innovation and covariance are 0. A missing number has
    the innovation NaN, and NaN in its row and column.
    """
    innovation = jnp.where(jnp.isnan(flag), jnp.nan, 0.0)
    is_missing = jnp.isnan(jnp.append(jnp.diagonal(covariance), innovation))
    padded = jnp.pad(covariance, ((0, 1), (0, 1)))
    return innovation, jnp.where(is_missing[:, None] | is_missing, jnp.nan, jnp.nan_to_num(padded))
