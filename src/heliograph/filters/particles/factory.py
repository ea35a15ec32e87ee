"""Particle filters of the state and of modes, made of what `particle_filter` takes, and what they refuse."""

from collections.abc import Sequence

import numpy as np

from heliograph.filters.base import make_sizes
from heliograph.filters.modes.models_by_mode import find_models
from heliograph.filters.particles.affine_check import is_affine
from heliograph.filters.particles.rao_blackwellised import PartlyDrawnFilter
from heliograph.filters.particles.received_density import find_received_density
from heliograph.model.channel import Channel, check_link, find_received_angles
from heliograph.model.markov_jump_models import list_mode_models
from heliograph.model.over_time import first, list_models_by_step, steps_covered, unstack, vary_over_steps
from heliograph.model.plant import AbstractPlant, AnyPlant, LinearPlant
from heliograph.model.sensor import AbstractSensor, AnySensor, LinearSensor
from heliograph.numerics.check import check_count, fail, instance, items, scalar
from heliograph.random_affine.memories_of_channels import drop_names
from heliograph.random_affine.modes import joint_modes
from heliograph.random_affine.noises.noise import AbstractNoise, Gaussian


def build_partly_drawn(
    plant: AnyPlant,
    sensor: AnySensor,
    channel: Channel,
    particles: int,
    seed: int,
    proposal: str,
    resample: float,
    drawn: Sequence[str] | None,
    nodes: int,
) -> PartlyDrawnFilter:
    """Return the particle filter that draws modes and named states; each particle keeps a Gaussian of the others.

    A mode chooses the laws of plant, sensor and links; modes follow one Markov chain.

    Args:
        plant: the plant, maybe of several modes.
        sensor: its sensor, maybe of several modes.
        channel: from the sensor to the filter.
        particles: their number.
        seed: of the random numbers.
        proposal: "optimal" draws with z, "prior" without.
        resample: share of `particles` below which the effective number leads to resampling.
        drawn: names of the drawn states; None for all.
        nodes: number of modes that stand for a gain that drifts.
    """
    start = list_mode_models(instance("plant", first(plant), AbstractPlant, "a plant"))[0]
    for model in list_mode_models(instance("sensor", first(sensor), AbstractSensor, "a sensor")):
        model.refuse_inputs("particle_filter")
        check_link(model, first(channel), len(start.states), moments=False)
    drawn_indices = _find_indices_of_drawn(start, drawn)
    _check_linear_given(plant, sensor, drawn_indices)
    # One chain of the modes of plant, sensor and links: joint.beside has the pair (plant, sensor) of each joint mode.
    joint = joint_modes(first(channel), nodes, beside=(first(plant), first(sensor)))
    # For each joint mode the index of its sensor among the sensor's models.
    sensor_modes = find_models("sensor", sensor, [model for _, model in joint.beside])
    # The density of z in each mode, from the mode's sensor and link (`maps`), for each step that sensor or channel
    # covers; one step stands for all if none varies.
    steps = steps_covered((sensor, channel)) or 1
    densities = []
    for sensor_of_step, link in zip(
        list_models_by_step(sensor, steps), list_models_by_step(channel, steps), strict=True
    ):
        link_by_mode = joint_modes(link, nodes, beside=(first(plant), first(sensor))).maps
        sensors = list_mode_models(sensor_of_step)
        densities.append(find_received_density([sensors[i] for i in sensor_modes], link_by_mode))
    return PartlyDrawnFilter(
        plant=drop_names(plant),
        sensor=drop_names(sensor),
        density=vary_over_steps(densities, sensor, channel),
        initial=joint.initial,
        transition=joint.transition,
        resample=np.asarray(scalar("resample", resample, low=0.0, high=1.0)),
        observed_angles=find_received_angles(plant, sensor, channel),
        plant_modes=find_models("plant", plant, [model for model, _ in joint.beside]),
        sensor_modes=sensor_modes,
        order=(*drawn_indices, *(i for i in range(len(start.states)) if i not in drawn_indices)),  # drawn ones first
        drawn=len(drawn_indices),
        particles=check_count("particles", particles),
        optimal=proposal == "optimal",
        seed=np.asarray(check_count("seed", seed, least=0)),
        **make_sizes("nominal", start, first(channel).outputs),
    )


def _find_indices_of_drawn(start: AbstractPlant, drawn: Sequence[str] | None) -> tuple[int, ...]:
    """Return the indices of the drawn states in the plant's order; None means that all states are drawn."""
    if drawn is None:
        return tuple(range(len(start.states)))
    wanted = [str(name) for name in items("drawn", drawn, "names of states")]
    if not set(wanted) <= set(start.states) or len(set(wanted)) < len(wanted):
        raise fail("drawn", f"some of {list(start.states)}, each once", wanted)
    return tuple(i for i, name in enumerate(start.states) if name in wanted)


def _check_linear_given(plant: AnyPlant, sensor: AnySensor, drawn: tuple[int, ...]) -> None:
    """Raise ValueError unless, given the drawn states, the rest is Gaussian and moves and is measured linearly.

    Only then may each particle hold a Gaussian of the rest. It is asked of the plants and sensors of all modes and
    steps; whether a function is affine in the rest is read off its operations.
    """
    for model in [model for step in unstack(plant) for model in list_mode_models(step)]:
        rest = [i for i in range(len(model.states)) if i not in drawn]
        names = [model.states[i] for i in rest]
        if isinstance(model.noise, AbstractNoise) and not isinstance(model.noise, Gaussian):
            raise fail("particle_filter with drawn= or modes", "Gaussian process noise", type(model.noise).__name__)
        if model.deviation is not None:
            expected = "a Gaussian law of x_0 (a covariance)"
            raise fail("particle_filter with drawn= or modes", expected, type(model.deviation).__name__)
        if set(names) & set(model.circular):
            raise fail("drawn", "all states that are angles", f"{sorted(set(names) & set(model.circular))} not drawn")
        u = np.zeros(len(model.inputs))
        if not isinstance(model, LinearPlant) and not is_affine(model.transition, model.initial_mean, rest, u):
            expected = f"states given which the plant is linear in {names}, as its operations show (draw more)"
            raise fail("drawn", expected, f"{[model.states[i] for i in drawn]}")
        for sensing in [model for step in unstack(sensor) for model in list_mode_models(step)]:
            if not isinstance(sensing, LinearSensor) and not is_affine(sensing.measure, model.initial_mean, rest):
                expected = f"states given which the sensor is linear in {names}, as its operations show (draw more)"
                raise fail("drawn", expected, f"{[model.states[i] for i in drawn]}")
