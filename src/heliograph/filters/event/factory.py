"""Factory of the filters behind a sender that decides when to send."""

from typing import Any

import jax
import numpy as np

from heliograph.filters.base import AbstractFilter, make_sizes
from heliograph.filters.event.event_filter import EventFilter
from heliograph.filters.event.gaussian_in_ball import MOST_COMPONENTS
from heliograph.filters.event.stochastic_event_filter import StochasticEventFilter
from heliograph.filters.gaussian.moment_transforms import AbstractTransform, Cubature
from heliograph.filters.modes.arrival_patterns import ChannelByPattern, describe_by_pattern, has_same_law_in_every_mode
from heliograph.model.assumed.assumed_model import AssumedModel, with_assumed
from heliograph.model.channel import Channel, check_link
from heliograph.model.estimate import Claim, lower_claim_by_noise
from heliograph.model.fading import uncertain_chain
from heliograph.model.over_time import OverTime, first, unstack, vary_over_steps
from heliograph.model.plant import AnyPlant, read_first_plant
from heliograph.model.sensor import AnySensor, is_linear, refuse_angles
from heliograph.model.trigger import AbstractThreshold, AbstractTrigger, Periodic, StochasticTrigger
from heliograph.numerics.check import check_count, fail, instance
from heliograph.numerics.types import PyTree
from heliograph.random_affine.memories_of_channels import memories
from heliograph.random_affine.modes import joint_modes
from heliograph.random_affine.noises.noise import AbstractNoise, Gaussian


def event_filter(
    plant: AnyPlant,
    sensor: AnySensor,
    channel: Channel,
    trigger: AbstractTrigger,
    known: int = 3,
    lost: int = 2,
    transform: AbstractTransform | None = None,
) -> AbstractFilter:
    """Return the filter that knows when its sender sends, and so what it means that nothing came.

    Silence says that y lies within delta of the sender's reference, or that what was sent was lost. The filter carries
    a sum of Gaussians of (x, r), r the sender's reference. In `known` of them r is the value that came last; each of
    these has its own part of the interval in which y - r lay last. In at most `lost` others r is a value that was lost.
    With one of each it costs a third, and claims up to 9 % too little variance in slow plants.

    `channel` has the losses in it (`erasure`, `gilbert_elliott` of erasures): which of them the receiver knows of,
    `trigger` says. A nonlinear plant or sensor goes through `transform`, `Cubature()` unless given (`Linearization()`
    makes it an extended filter).

    Claim: "exact" where plant and sensor are linear and no gain is random, behind `Periodic`, and behind a
    `StochasticTrigger` whose losses are none or known, if all noise is Gaussian and what arrives is y itself up to a
    known gain (through a noisy link, that it was sent says more of y than the filter uses); else "nominal".

    Args:
        plant: linear or not; it may vary over time.
        sensor: whose components are sent.
        channel: link of the sender, with its losses.
        trigger: rule by which the sender sends.
        known: number of Gaussians where the reference is the value that came last (default 3).
        lost: number of Gaussians where it may be a value that was lost (default 2).
        transform: of moments, for a plant or sensor that is not linear (default `Cubature()`).

    Raises:
        ValueError: parts that do not fit, angles, a link whose memory drifts or whose delays are not 0, several
            components that are each sent alone through links that are not lost one by one.
    Source: the sum over the sender's reference; Sijs and Lazar, Event based state estimation with time synchronous
        updates (2012), for what silence says; Han et al. (2015) for the stochastic trigger.
    """
    start = read_first_plant(plant)
    instance("trigger", trigger, AbstractTrigger, "a trigger, such as SendOnDelta(0.5)")
    check_link(first(sensor), first(channel), len(start.states))
    refuse_angles("event filter", plant, sensor)
    trigger.check_outputs(len(first(sensor).outputs))
    known, lost = check_count("known", known), check_count("lost", lost, least=0)
    rule = Cubature() if transform is None else instance("transform", transform, AbstractTransform, "a transform")
    # Law of what arrives at each step, by mode of the link and by which components arrive.
    described, initial = _describe_channel(channel)
    steps = unstack(described)
    outputs = len(first(sensor).outputs)
    # A value is lost by the link, or by its receiver, who refuses it: where losses are told, that is told too.
    may_lose = trigger.losses != "unknown" or any(_may_lose_components(step) for step in steps)
    received = first(channel).outputs + trigger.side_information(outputs)
    fields_of_both: dict[str, Any] = {  # of the filter of a random trigger, and of that of a threshold
        "plant": plant, "sensor": sensor, "channel": described, "initial": initial, "transform": rule,
        "may_lose": may_lose, "outputs": outputs,
    }  # fmt: skip
    # A random trigger: one Gaussian is enough. The claim rests on the laws of noises, not on their moments alone.
    assumed = AssumedModel(plant, sensor, channel, trigger, order=None)
    if isinstance(trigger, StochasticTrigger | Periodic):
        claim = _decide_claim(plant, sensor, channel, trigger)
        return with_assumed(
            StochasticEventFilter(trigger=trigger, **fields_of_both, **make_sizes(claim, start, received)), assumed
        )
    # A threshold: a sum of Gaussians, by the value with which the sender compares. Ages of that value are counted up to
    # the heartbeat.
    filter = EventFilter(
        trigger=_check_threshold_rule(trigger, lost if may_lose else None, outputs, first(channel).outputs, steps),
        pieces=known,
        lost_references=lost,
        delivers_signal=all(_delivers_y_unchanged(step) for step in steps),
        same_law_in_modes=all(has_same_law_in_every_mode(step) for step in steps),
        age_count=1 if trigger.heartbeat is None else int(trigger.heartbeat) + 1,
        **fields_of_both,
        **make_sizes("nominal", start, received),
    )
    return with_assumed(filter, assumed)


def _describe_channel(channel: Channel) -> tuple[ChannelByPattern | OverTime, np.ndarray]:
    """Return the law of what arrives, by mode of the channel and by pattern of arrivals, and the modes' initial law.

    A pattern of arrivals says which components of a message arrive. A channel whose memory drifts (a state on a
    continuum, such as a gain that is a Gauss-Markov process) has no finite number of modes, and is refused.
    """
    drifting = [memory for memory in memories(first(channel)).values() if memory.drifts]
    if drifting:
        raise fail("channel of a sender with a trigger", "one that remembers by Markov chains", "one that drifts")
    steps = [joint_modes(step) for step in unstack(channel)]
    # Nothing of the mode is reported to the receiver: every mode has the same flag, with probability 1.
    by_pattern = describe_by_pattern(steps, np.ones((len(steps[0].initial), 1)))
    return vary_over_steps(by_pattern, channel), np.asarray(steps[0].initial)


def _decide_claim(plant: AnyPlant, sensor: AnySensor, channel: Channel, trigger: StochasticTrigger | Periodic) -> Claim:
    """Return what the filter of one Gaussian says its covariance is: "exact" if that of the posterior, else "nominal".

    Behind a schedule (`Periodic`) silence says nothing of x, so that the Kalman filter's conditions are enough: linear
    models and known gains. Behind a random trigger the noise must be Gaussian too.
    """
    described, _ = _describe_channel(channel)
    steps = unstack(described)
    if not is_linear(plant, sensor) or uncertain_chain(channel) or not all(_has_known_gain(step) for step in steps):
        return "nominal"
    if isinstance(trigger, Periodic):
        return lower_claim_by_noise("exact", plant, sensor, channel)
    # Given silence x stays Gaussian, unless silence may also be a loss. Given a value x stays Gaussian if the value
    # determines y: then the fact that it was sent says nothing more.
    losses_are_hidden = trigger.losses == "unknown" and any(_may_lose_components(step) for step in steps)
    value_determines_y = all(_arrival_determines_y(step) for step in steps)
    is_exact = value_determines_y and _has_gaussian_noise(plant, sensor) and not losses_are_hidden
    return "exact" if is_exact else "nominal"


def _may_lose_components(channel: ChannelByPattern) -> bool:
    """Return whether with positive probability not all components arrive."""
    return bool(np.any(np.asarray(channel.chance)[:, ~np.all(channel.present, axis=1)] > 0))


def _has_known_gain(channel: ChannelByPattern) -> bool:
    """Return whether no gain is random, and what arrives is all that was sent, in every mode."""
    return has_same_law_in_every_mode(channel) and not np.any(_gain_and_noise_covariance(channel)[..., :-1, :-1])


def _gain_and_noise_covariance(channel: ChannelByPattern) -> np.ndarray:
    """Return the covariance of (G, n) by mode and pattern of arrivals, with z = G y + n, and 0 for mere rounding.

    A known gain has covariance 0, but E[G G'] - M M' with M = E G is computed as some eps of |M M'|. `squared_gain`
    holds |M M'|, with a last row and column of zeros for n.
    """
    gain = np.asarray(channel.mean)[..., :-1]
    covariance = np.asarray(channel.covariance)
    size = np.abs(gain)
    squared_gain = size[..., :, None, :, None] * size[..., None, :, None, :]
    leading_axes = squared_gain.ndim - 2
    squared_gain = np.pad(squared_gain, [(0, 0)] * leading_axes + [(0, 1)] * 2)
    return np.where(np.abs(covariance) <= 100 * np.finfo(float).eps * squared_gain, 0.0, covariance)


def _has_gaussian_noise(*models: PyTree) -> bool:
    """Return whether all noise of these models is Gaussian: silence of probability exp(-e' W e / 2) leaves it so."""
    leaves = jax.tree.leaves(models, is_leaf=lambda leaf: isinstance(leaf, AbstractNoise))
    return all(isinstance(leaf, Gaussian) for leaf in leaves if isinstance(leaf, AbstractNoise))


def _arrival_determines_y(channel: ChannelByPattern) -> bool:
    """Return whether whatever arrives determines y, without noise.

    The fact that y was sent then says nothing more. It holds if in each possible mode and pattern of arrivals all
    components arrive, gain and noise have no covariance, and the gain has as many independent rows as y has components.
    """
    # The pairs (mode, pattern of arrivals) that can occur and in which something arrives.
    possible = [(j, a) for j, a in np.argwhere(np.asarray(channel.chance) > 0) if channel.present[a].any()]
    for j, a in possible:
        gain = np.asarray(channel.mean)[j, a, :, :-1]
        arrives = np.asarray(channel.present)[a]
        # Rows are scaled to 1, so that the rank does not depend on units.
        row_size = np.abs(gain).max(axis=1, keepdims=True)
        scaled_gain = gain / np.where(row_size > 0, row_size, 1.0)
        is_noise_free = arrives.all() and not np.any(_gain_and_noise_covariance(channel)[j, a])
        if not is_noise_free or np.linalg.matrix_rank(scaled_gain) < gain.shape[1]:
            return False
    return True


def _delivers_y_unchanged(channel: ChannelByPattern) -> bool:
    """Return whether what arrives is y itself, all of it.

    y has p numbers, and m numbers are received. `channel.mean` is E[(G, n)] of z = G y + n by mode and pattern.
    """
    m, p = channel.mean.shape[-2], channel.mean.shape[-1] - 1
    if m != p:
        return False
    all_or_nothing = np.all(channel.present, axis=1) | ~np.any(channel.present, axis=1)
    if not all_or_nothing.all():
        return False
    # E[(G, n)] = (I, 0) without covariance, in each mode in which something arrives.
    arriving = [(j, a) for j, a in np.argwhere(np.asarray(channel.chance) > 0) if channel.present[a].all()]
    identity = np.eye(m, p + 1)
    return all(
        np.array_equal(channel.mean[j, a], identity) and not np.any(channel.covariance[j, a]) for j, a in arriving
    )


def _check_threshold_rule(
    rule: AbstractTrigger, lost: int | None, outputs: int, received: int, steps: list[ChannelByPattern]
) -> AbstractThreshold:
    """Return the sending rule, if the filter's sum of Gaussians has a form for its region and its losses.

    Args:
        rule: the sending rule.
        lost: number of Gaussians for a reference that was lost; None if nothing is lost.
        outputs: length of the signal y.
        received: length of what arrives.
        steps: the law of what arrives, at each step.

    Raises:
        ValueError: no threshold rule; losses of a reference that is the value sent last without a Gaussian for them; a
            ball of too many components; components that are sent each alone, but not over links of their own.
    """
    trigger = instance("trigger", rule, AbstractThreshold, "SendOnDelta, SendOnPredictionError or another of these")
    if lost == 0 and trigger.reference == "sent":
        raise fail("lost", "at least 1, since transmissions may be lost", lost)
    if outputs == 1:
        return trigger
    if trigger.region == "ball" and outputs > MOST_COMPONENTS:
        raise fail(
            "outputs of a sensor behind a ball", f"{MOST_COMPONENTS} at most, for which a filter can cut to it", outputs
        )
    if trigger.region == "each":
        if received != outputs:
            raise fail("channel of components that are each sent alone", f"{outputs} outputs", received)
        if not all(_has_independent_losses(step) for step in steps):
            raise fail("channel of components that are each sent alone", "links side by side that lose them one by one "
                       "and remember nothing, such as parallel([erasure(perfect(), .9)] * 2)", "another")  # fmt: skip
    return trigger


def _has_independent_losses(channel: ChannelByPattern) -> bool:
    """Return whether components arrive unchanged, and are lost independently of each other, without modes.

    The probability of each pattern of arrivals is then the product of the probabilities of its components.
    `channel.mean` is E[(G, n)] of z = G y + n.
    """
    m = channel.mean.shape[-2]
    chance = np.asarray(channel.chance)
    if len(chance) > 1:
        return False
    arrival_probability = chance[0] @ np.asarray(channel.present)
    chance_if_independent = np.prod(np.where(channel.present, arrival_probability, 1 - arrival_probability), axis=1)
    for a in np.flatnonzero(chance[0] > 0):
        arriving = channel.present[a]
        is_unchanged = np.array_equal(channel.mean[0, a][arriving], np.eye(m, m + 1)[arriving])  # E[(G, n)] = (I, 0)
        if not is_unchanged or np.any(channel.covariance[0, a]):
            return False
    return np.allclose(chance_if_independent, chance[0], rtol=0, atol=1e-12)
