"""Parts of filters of modes: plant, sensor and channel in each mode of their joint chain."""

from collections.abc import Sequence
from typing import Any

import numpy as np

from heliograph.filters.base import make_sizes
from heliograph.filters.gaussian.moment_transforms import AbstractTransform, Cubature
from heliograph.filters.modes.arrival_patterns import ChannelByPattern, describe_by_pattern
from heliograph.model.channel import Channel, check_link, find_received_angles
from heliograph.model.markov_jump_models import ModalPlant, ModalSensor, list_mode_models
from heliograph.model.over_time import OverTime, first, unstack, vary_over_steps
from heliograph.model.plant import AbstractPlant, AnyPlant
from heliograph.model.sensor import AbstractSensor, AnySensor
from heliograph.numerics.check import fail, instance
from heliograph.numerics.numpy_or_jax import is_traced
from heliograph.random_affine.memories_of_channels import drop_names
from heliograph.random_affine.modes import JointModes, joint_modes


def describe_joint_modes(
    plant: AbstractPlant, sensor: AbstractSensor, channel: Channel, nodes: int
) -> tuple[JointModes, ChannelByPattern | OverTime]:
    """Return the joint modes of plant, sensor and links as one chain, and the law of what arrives at each step.

    The law is given for each mode and each pattern of components that arrive. A gain that drifts is replaced by a chain
    of `nodes` modes.
    """
    steps = [joint_modes(step, nodes, beside=(plant, sensor)) for step in unstack(channel)]
    modes = len(steps[0].initial)
    # Nothing that is received reports the mode: all modes have the same flag, with probability 1.
    by_pattern = describe_by_pattern(steps, np.ones((modes, 1)))
    if modes > 1:
        for step in by_pattern:
            _check_density(step)
    # The chain is the same at all steps, so the first one is returned. The links' effect on the signal may vary.
    return steps[0], vary_over_steps(by_pattern, channel)


def _check_density(channel: ChannelByPattern) -> None:
    """Raise ValueError unless z has a density in every mode and pattern of arrivals, for an x that has one.

    Otherwise z in this mode lies in a subspace, and such a value would have an infinite likelihood in it.
    `channel.present` says which components arrive in a pattern. `channel.mean` and `channel.covariance` are those of
    (G, n) with z = G y + n. Traced moments have no numbers, and are not checked: their assumed values
    were checked before.
    """
    if is_traced((channel.mean, channel.gain_covariance, channel.noise)):
        return
    for j, a in np.argwhere(np.asarray(channel.chance) > 0):
        # With E[y y'] = I, E[z z'] = E[G] E[G]' + sum_a Cov(G_ia, G_la) + Cov n. It is regular if every combination of
        # the components that arrive is random.
        arriving, gain = np.flatnonzero(channel.present[a]), np.asarray(channel.mean[j, a])[:, :-1]
        second_moment = gain @ gain.T + np.einsum("ilaa->il", np.asarray(channel.covariance[j, a]))
        if np.linalg.matrix_rank(second_moment[np.ix_(arriving, arriving)]) < len(arriving):
            raise fail("filter of modes", "outputs that are random in every mode (give the links noise)", f"mode {j}")


def find_models(kind: str, model: Any, by_mode: Sequence[Any]) -> tuple[int, ...]:
    """Return for each joint mode the index of its plant (or sensor) among the different ones; all 0 if it has no modes.

    Args:
        kind: "plant" or "sensor", for the message.
        model: the plant or sensor; one with modes lists its different `models`.
        by_mode: the plant or sensor in each joint mode. Its index is found by identity.

    Raises:
        ValueError: models with modes that vary over time.
    """
    if isinstance(model, OverTime) and isinstance(first(model), ModalPlant | ModalSensor):
        raise fail(kind, "one whose models are the same at all steps", "modes in over_time")
    if not isinstance(model, ModalPlant | ModalSensor):
        return (0,) * len(by_mode)
    number_of_model = {id(candidate): i for i, candidate in reversed(list(enumerate(model.models)))}
    return tuple(number_of_model[id(of_mode)] for of_mode in by_mode)


def fields_of_mode_filters(
    plant: AnyPlant, sensor: AnySensor, channel: Channel, transform: AbstractTransform | None, nodes: int
) -> dict[str, Any]:
    """Return the fields with which every filter of modes is constructed, from its checked models.

    Joint modes are those of plant, sensor and links together; a gain that drifts is replaced by a chain of `nodes`
    modes. The filter's covariance is nominal.
    """
    start = instance("plant", first(plant), AbstractPlant, "a plant")
    for model in list_mode_models(first(sensor)):
        check_link(model, first(channel), len(start.states))
    angles = find_received_angles(plant, sensor, channel)
    joint, channel_by_pattern = describe_joint_modes(first(plant), first(sensor), channel, nodes)
    plant_of_mode, sensor_of_mode = zip(*joint.beside, strict=True)
    return {
        "plant": drop_names(plant), "sensor": drop_names(sensor),
        "channel": channel_by_pattern, "initial": joint.initial, "observed_angles": angles,
        "transform": Cubature() if transform is None else transform,
        "plant_modes": find_models("plant", plant, plant_of_mode),
        "sensor_modes": find_models("sensor", sensor, sensor_of_mode),
        **make_sizes("nominal", start, first(channel).outputs),
    }  # fmt: skip
