"""Fusion centre that knows the network: joint moments of the local errors, before any data; and it as a filter."""

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.filters.gaussian.gaussian import GaussianFilter
from heliograph.filters.linear.precomputed_filter import LinearisedStep, LinearStep, linear_step
from heliograph.fusion.cross_covariance import (
    ErrorMoments,
    ErrorStep,
    Motion,
    SourceFactors,
    make_error_step,
    make_initial_errors,
    propagate_errors_jointly,
    propagate_factors,
    propagate_state,
)
from heliograph.fusion.joint_covariance_fusion import AbstractInformedFusion, CentreStep
from heliograph.fusion.network_fusion import Fusion
from heliograph.model.channel import Channel
from heliograph.model.estimate import Claim, Estimate, lower_claim_by_noise, weakest
from heliograph.model.over_time import at, first, unstack
from heliograph.model.plant import AnyPlant, LinearPlant
from heliograph.model.sensor import AnySensor, LinearSensor, refuse_angles
from heliograph.numerics.check import fail
from heliograph.numerics.module import Module
from heliograph.numerics.types import Array, PyTree
from heliograph.simulation.centres.observation_model import SeparateObservations, SharedObservation


class CentreState(NamedTuple):
    """State of a centre: moments of the nodes' errors, and the states of its rules by name of the fusion."""

    errors: ErrorMoments
    rules: dict[str, PyTree]


class FusionCentre(Module):
    """All informed fusions of one filter's estimates, at the nodes that have it: each step propagates their errors.

    Args:
        plant: the linear plant that the filters estimate.
        observation_model: of the nodes' measurements.
        rules: by name of the fusion.
        order: brings what is gathered from the sources into the order of the nodes.
        sources: (stack, number within the stack) of the stacked filters, one group of nodes after another.
        size: length of the longest measurement, to which others are padded.
        claim: of the fused estimates.
    """

    plant: AnyPlant
    observation_model: SeparateObservations | SharedObservation
    rules: dict[str, AbstractInformedFusion]
    order: np.ndarray
    sources: tuple[tuple[int, int], ...] = eqx.field(static=True)
    size: int = eqx.field(static=True)
    claim: Claim = eqx.field(static=True)

    compute_matrices = staticmethod(linear_step)

    def init(self, starts: Sequence[jax.Array]) -> CentreState:
        """Return the centre's state before the first step: moments of all nodes' errors, and the rules' states.

        `starts`: initial means (node, n) of the filters, by group of nodes. `self.order` sorts their rows by node.
        """
        plant = at(self.plant, k=0)
        initial_means = jnp.concatenate(starts)[self.order]
        errors = make_initial_errors(plant.initial_mean, plant.initial_covariance, initial_means)
        return CentreState(errors, {name: rule.start(errors) for name, rule in self.rules.items()})

    def step_errors(self, errors: ErrorMoments, filters: LinearStep, u: jax.Array, k: jax.Array) -> CentreStep:
        """Return the linear maps by which the nodes' errors move in step k, and the errors' moments after it.

        `errors`: moments before step k. `filters`: matrices of the nodes' filters, in the order of the nodes.
        """
        step = self.compute_error_maps(errors.state_mean, errors.state_covariance, filters, u, k)
        return CentreStep(step, propagate_errors_jointly(errors, step))

    def compute_error_maps(
        self, mean: jax.Array, covariance: jax.Array, filters: LinearStep, u: jax.Array, k: jax.Array
    ) -> ErrorStep:
        """Return the linear maps of the errors in step k, for a plant with these moments before it.

        `mean` (n,) and `covariance` (n, n): of the plant's state. `filters`: matrices in the order of the nodes.
        """
        plant: LinearPlant = at(self.plant, k)
        # x+ = A x + offset + w. The measurement is taken after the step, so its model needs the moments after the step.
        motion = Motion(plant.transition_matrix(u), plant.shift(u), plant.noise_covariance(u))
        mean_after, covariance_after = propagate_state(mean, covariance, motion)
        observation = self.observation_model.observe(mean_after, covariance_after, k)
        return make_error_step(filters, motion, observation)

    def propagate_error_factors(
        self,
        start: tuple[PyTree, SourceFactors],
        compute_matrices: Callable[[PyTree, jax.Array, jax.Array], LinearStep],
        step_filters: Callable[[PyTree, jax.Array, jax.Array], PyTree],
        u: Array,
    ) -> SourceFactors:
        """Return the factors of the errors' joint covariance after all steps.

        Errors are correlated, since all nodes follow the same plant. Factors are a root of their joint covariance.

        Args:
            start: the filters' states and the factors before the first step.
            compute_matrices: (states, u, k) -> the matrices of the filters' step k in the order of the nodes.
            step_filters: (states, u, k) -> the filters' states after step k.
            u: inputs of the plant (step, inputs), one row for each step.
        """

        def propagate(
            carry: tuple[PyTree, SourceFactors], row: tuple[jax.Array, jax.Array]
        ) -> tuple[tuple[PyTree, SourceFactors], None]:
            """Step the filters' states over step k, and the factors of the errors' covariance by their matrices.

            Row 0 of the means `factors.mean` is the plant's state x, and Cov x = S S' with S = `factors.state`. `row`:
            (number of the step, inputs of the plant over it).
            """
            states, factors = carry
            k, u_k = row
            covariance = jnp.asarray(factors.state @ factors.state.T)
            matrices = compute_matrices(states, u_k, k)
            step = self.compute_error_maps(factors.mean[0], covariance, matrices, u_k, k)
            return (step_filters(states, u_k, k), propagate_factors(factors, step, k)), None

        (_, factors), _ = jax.lax.scan(propagate, start, (jnp.arange(len(u)), jnp.asarray(u)))
        return factors

    def gather_matrices(self, matrices_by_source: Sequence[LinearStep]) -> LinearStep:
        """Return the filters' matrices in the order of the nodes, padded with zeros to the longest measurement.

        `matrices_by_source`: of each stack of filters (of one structure, at the nodes of a group), with a leading axis
        of nodes.
        """
        return join_step_matrices(matrices_by_source, self.order, self.size)

    def step(
        self,
        state: CentreState,
        matrices_by_source: Sequence[LinearStep],
        means_by_source: Sequence[jax.Array],
        u: jax.Array,
        k: jax.Array,
    ) -> tuple[CentreState, dict[str, Estimate]]:
        """Propagate the moments of all nodes' errors over step k, and fuse the nodes' estimates by every rule.

        A source is a stack of filters of one structure. `self.order` brings their nodes, one source after another, into
        the order of the nodes. Returned are the next state, and the fused estimates by name of the fusion.

        Args:
            state: moments of the errors, and states of the rules, before the step.
            matrices_by_source: matrices of the filters in the step, with a leading axis of nodes.
            means_by_source: estimates of the nodes' filters after the step (node, n), for each source.
            u: inputs of the plant over the step.
            k: number of the step.
        """
        error_step = self.step_errors(state.errors, self.gather_matrices(matrices_by_source), u, k)
        reports = jnp.concatenate(means_by_source)[self.order]  # the nodes' estimates (node, n)
        rules_after, estimates = {}, {}
        for name, rule in self.rules.items():
            rules_after[name], (mean, covariance) = rule.fuse_step(state.rules[name], error_step, reports)
            estimates[name] = Estimate(mean, covariance, self.claim)
        return CentreState(error_step.errors, rules_after), estimates


# Axes of a filter's matrices that are as long as its measurement, counted from the last.
MEASURED = {"gain": (-1,), "output": (-2,), "offset": (-1,), "innovation": (-2, -1), "noise": (-2, -1)}
Matrices = TypeVar("Matrices", LinearStep, LinearisedStep)


def join_step_matrices(matrices_by_source: Sequence[Matrices], order: np.ndarray, size: int) -> Matrices:
    """Return the matrices of several stacks of filters as one stack: one stack after another, then in this order.

    A stack has the filters of some nodes, of one structure. Axes as long as the measurement may differ between stacks:
    they are padded with zeros to `size`. `order` sorts the joined rows by node.
    """

    def pad(name: str, leaf: jax.Array) -> jax.Array:
        """Return the matrix that is the field `name`, with its measurement axes padded to `size`.

        MEASURED: by field the axes, counted from the last (-1), that are as long as a measurement.
        """
        padding = [(0, 0)] * leaf.ndim  # zeros before and after, along each axis
        for axis in MEASURED.get(name, ()):
            padding[axis] = (0, size - leaf.shape[axis])
        return jnp.pad(leaf, padding)

    matrices_class = type(matrices_by_source[0])
    joined = {
        field: jnp.concatenate([pad(field, getattr(matrices, field)) for matrices in matrices_by_source])
        for field in matrices_class._fields
    }
    return matrices_class(**{field: leaf[order] for field, leaf in joined.items()})


NodeModels = Mapping[str, tuple[AnySensor, Channel, AbstractFilter]]  # sensor, channel and filter of each node


def find_claim_of_informed_fusion(rule: str, plant: AnyPlant, nodes: NodeModels, shared: bool) -> Claim:
    """Return the claim of fusion by a rule that knows how errors are correlated: "exact", "upper" or "nominal".

    The claim says what the fused covariance is: "upper" (a bound) where noise is known by bounds, "nominal" (neither)
    where probabilities are uncertain or gains depend on data.

    Args:
        rule: name of the rule, for errors.
        plant: the plant that all nodes estimate.
        nodes: sensor, channel and filter of each node.
        shared: whether the nodes receive parts of one channel.

    Raises:
        ValueError: naming the knowledge that is missing.
    """
    # A channel's memory would have to be part of the errors' joint state, which it is not: refused.
    for name, (_, channel, _) in nodes.items():
        if first(channel).remembers:
            expected = f"fusion by {rule}: node {name!r}"
            raise fail(expected, "a channel that forgets", f"{type(first(channel)).__name__}, which remembers")
    refuse_angles(f"fusion by {rule}", plant, *(sensor for sensor, _, _ in nodes.values()))
    if has_data_dependent_gains(nodes):
        _check_data_dependent_gains(rule, nodes, shared)
        return "nominal"
    _check_linear_and_planned(rule, plant, nodes)
    are_uncertain = any(_has_uncertain_law(channel) for _, channel, _ in nodes.values())
    claim: Claim = "nominal" if are_uncertain else "exact"
    return lower_claim_by_noise(claim, plant, [(sensor, channel) for sensor, channel, _ in nodes.values()])


def has_data_dependent_gains(nodes: NodeModels) -> bool:
    """Return whether some filter's gains depend on data, so that errors can only be propagated along the estimates."""
    return any(isinstance(filter, GaussianFilter) and not filter.linear for _, _, filter in nodes.values())


def _check_data_dependent_gains(rule: str, nodes: NodeModels, shared: bool) -> None:
    """Raise ValueError unless all filters are cubature or extended ones, and the nodes share no channel.

    The joint covariance of the errors is then propagated along the estimates, with derivatives of each filter's step:
    all filters must have such, and their measurement noises must be independent.
    """
    for name, (_, _, filter) in nodes.items():
        if not isinstance(filter, GaussianFilter) or filter.linear:
            raise fail(f"fusion by {rule}: node {name!r}", "a cubature or extended filter, as other nodes have", filter)
    if shared:
        raise fail(f"fusion by {rule}", "nodes that share nothing but the plant, or filters whose gains depend on no "
                   "data", "nodes that share a channel")  # fmt: skip


def _check_linear_and_planned(rule: str, plant: AnyPlant, nodes: NodeModels) -> None:
    """Raise ValueError unless plant and sensors are linear, and the gains of all filters depend on no data.

    Then the joint covariance of the nodes' errors can be propagated before any data. `rule`: name of the fusion rule,
    for errors. `nodes`: sensor, channel and filter of each node.
    """
    if not isinstance(first(plant), LinearPlant):
        raise fail(f"fusion by {rule}", "a LinearPlant", type(first(plant)).__name__)
    for name, (sensor, _, filter) in nodes.items():
        node_in_words = f"fusion by {rule}: node {name!r}"
        if not isinstance(first(sensor), LinearSensor):
            raise fail(node_in_words, "a LinearSensor", type(first(sensor)).__name__)
        if not filter.is_linear:
            raise fail(
                node_in_words, "a filter of the plant's state whose gains depend on no data", type(filter).__name__
            )


def find_claim_of_report_fusion(rule: str, claim: Claim, fusion: Fusion, complete: Mapping[str, bool]) -> Claim:
    """Return the claim of a fusion of the reports that nodes send to a centre: `claim`, or a weaker one.

    Quantizers of the reports weaken it. So do uplinks (channels from node to centre) of uncertain probabilities.
    `complete`: for each node, True if it loses no measurement.

    Raises:
        ValueError: nodes that lose measurements, which the centre cannot know from a missing report.
    """
    nodes_that_lose = [name for name, receives_all in complete.items() if not receives_all]
    if nodes_that_lose:
        raise fail(f"fusion by {rule} of reports", "nodes that lose no measurements, of which the centre would have "
                   "to know", f"losses at {nodes_that_lose}")  # fmt: skip
    names = list(complete)
    channels = [link.channel for link in fusion.links(names) if link.channel is not None]
    for quantizer in fusion.quantizers(names):
        claim = quantizer.claim(claim)
    return weakest([claim, "nominal"]) if any(map(_has_uncertain_law, channels)) else claim


def _has_uncertain_law(channel: Channel) -> bool:
    """Return whether the channel's laws have probabilities that are known only up to a radius.

    The set of possible laws then has several extreme laws (its corners), and a law that is known has one. A channel
    that varies over time is judged at each step.
    """
    try:
        return any(step.condition_on_arrival().corner_count() > 1 for step in unstack(channel))
    except ValueError:  # too many corners to list
        return True
