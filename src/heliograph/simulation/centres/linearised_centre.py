"""Fusion centre of nonlinear filters: cross-covariances of their errors, linearised along the centre's estimate."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.linear.precomputed_filter import LinearisedStep, linearise_step
from heliograph.fusion.all_reports_fusion import AllReports, ReportsBelief
from heliograph.fusion.cross_covariance import (
    ErrorMap,
    ErrorMoments,
    ErrorStep,
    Motion,
    make_initial_errors,
    propagate_errors_jointly,
)
from heliograph.fusion.joint_covariance_fusion import AbstractInformedFusion, CentreStep
from heliograph.model.estimate import Claim, Estimate
from heliograph.model.over_time import at
from heliograph.model.plant import AnyPlant
from heliograph.numerics.module import Module
from heliograph.numerics.types import PyTree
from heliograph.simulation.centres.fusion_centre import join_step_matrices


class LinearisedFusionState(NamedTuple):
    """State of one fusion: moments of the nodes' errors, its last estimate `known` (n,), and its rule's state."""

    errors: ErrorMoments
    known: jax.Array
    rule: PyTree


class LinearisedCentre(Module):
    """A `FusionCentre` of filters whose gains depend on data; its claim is nominal, as theirs are.

    P_ij+ = F_i (A P_ij A' + Q) F_j' + K_i S_ij K_j', F_i = I - K_i C_i: K_i and C_i are derivatives of each filter's
    step, S_ij = 0, and S_ii is the innovation covariance less C_i P_i C_i'. A is common, the plant's derivative at the
    fusion's last estimate: with each filter's A, nodes that share an error would seem to differ by their linearisations
    alone, and weights of such differences claim information that is not there.

    `sources` are (stack, number in the stack) of the filters that are fused, `order` brings their nodes, one source
    after another, into the order of the nodes; `size` is the length of the longest measurement.
    """

    plant: AnyPlant
    rules: dict[str, AbstractInformedFusion]
    order: np.ndarray
    sources: tuple[tuple[int, int], ...] = eqx.field(static=True)
    size: int = eqx.field(static=True)
    claim: Claim = eqx.field(static=True)

    compute_matrices = staticmethod(linearise_step)

    def init(self, starts: Sequence[jax.Array]) -> dict[str, LinearisedFusionState]:
        """Return the states of all fusions before the first step, by name.

        `starts`: initial means (node, n) of the filters, by group of nodes. `self.order` sorts their rows by node.
        """
        plant = at(self.plant, k=0)
        initial_means = jnp.concatenate(starts)[self.order]
        errors = make_initial_errors(plant.initial_mean, plant.initial_covariance, initial_means)
        mean = jnp.asarray(plant.initial_mean)
        return {name: LinearisedFusionState(errors, mean, rule.start(errors)) for name, rule in self.rules.items()}

    def step(
        self,
        state: dict[str, LinearisedFusionState],
        derivatives_by_source: Sequence[LinearisedStep],
        means_by_source: Sequence[jax.Array],
        u: jax.Array,
        k: jax.Array,
    ) -> tuple[dict[str, LinearisedFusionState], dict[str, Estimate]]:
        """Return the next state and the fused estimates of step k, both by name of the fusion.

        The centre fuses the estimates of nodes with nonlinear filters. Weights need the joint covariance of the nodes'
        errors, which is propagated here with models linearised at the estimates; so the claim is nominal.

        Args:
            state: moments of the errors, last fused estimate (`known`) and the rule's state, by name of the fusion.
            derivatives_by_source: gain, output matrix and noise of the nodes' filters in the step, for each stack of
                filters, with a leading axis of nodes.
            means_by_source: the nodes' estimates after the step (node, n), for each stack of filters.
            u: inputs of the plant over the step.
            k: number of the step.
        """
        # The stacks of filters joined, and sorted in the order of the nodes.
        linear = join_step_matrices(derivatives_by_source, self.order, self.size)
        reports = jnp.concatenate(means_by_source)[self.order]
        plant = at(self.plant, k)
        error_factor = jnp.eye(reports.shape[-1]) - linear.gain @ linear.output  # F_i = I - K_i C_i (node, n, n)
        following, results = {}, {}
        for name, rule in self.rules.items():
            before = state[name]
            # x+ = A x + b + w, linearised for all nodes at the fusion's last estimate.
            matrix = jax.jacfwd(lambda x: plant.transition(x, u))(before.known)
            moved = plant.transition(before.known, u) + plant.noise_mean()
            motion = Motion(matrix, moved - matrix @ before.known, plant.noise_covariance(u))
            # Moments of the errors, by which the rule weights the reports.
            step = _make_joint_error_step(motion, error_factor, linear)
            errors = _replace_plant_moments(before.errors, propagate_errors_jointly(before.errors, step))
            # `AllReports` estimates the errors themselves, so that their means matter too.
            if isinstance(rule, AllReports):
                drift = _compute_drift_of_mean_errors(before.rule, matrix, moved, error_factor, linear)
                step = step._replace(offset=jnp.concatenate([motion.offset, drift.reshape(-1)]))
            rule_state, (mean, covariance) = rule.fuse_step(before.rule, CentreStep(step, errors), reports)
            following[name] = LinearisedFusionState(errors, known=mean, rule=rule_state)
            results[name] = Estimate(mean, covariance, self.claim)
        return following, results


def _make_joint_error_step(motion: Motion, error_factor: jax.Array, linear: LinearisedStep) -> ErrorStep:
    """Return the step x+ = A x + b + w of the plant, and e_i+ = F_i (A e_i + w) - K_i nu_i of all nodes' errors.

    A, b and w are the matrix, offset and noise of the plant's `motion`. K_i and nu_i are the gain and the measurement
    noise of node i, from `linear`. F_i = I - K_i C_i is `error_factor` (node, n, n). Errors do not depend on x and are
    not shifted, so errors of mean zero keep that mean.
    """
    nodes, n, _ = error_factor.shape
    return ErrorStep(
        transition=ErrorMap(
            plant=motion.matrix, of_state=jnp.zeros_like(error_factor), errors=error_factor @ motion.matrix
        ),
        offset=jnp.pad(motion.offset, (0, nodes * n)),
        noise_input=jnp.concatenate([jnp.eye(n), error_factor.reshape(nodes * n, n)]),
        process=motion.noise,
        gain=linear.gain,
        received=linear.noise,
    )


def _replace_plant_moments(before: ErrorMoments, after: ErrorMoments) -> ErrorMoments:
    """Return the moments `after` a step of the errors, and those `before` it of the plant's state x.

    Models are linearised along an estimate here, which does not give moments of x before any data. No rule uses those;
    they stay as they are, so that they stay finite.
    """
    n = before.mean.shape[1]
    # Moments are of (x, e_1, ..., e_nodes): row 0 of the means (1 + node, n), and the first n rows and columns of the
    # covariance, belong to x.
    is_of_error = np.arange(len(before.covariance)) >= n
    covariance = jnp.where(np.outer(is_of_error, is_of_error), after.covariance, before.covariance)
    return ErrorMoments(mean=jnp.concatenate([before.mean[:1], after.bias]), covariance=covariance)


def _compute_drift_of_mean_errors(
    state: ReportsBelief, matrix: jax.Array, predicted_mean: jax.Array, error_factor: jax.Array, linear: LinearisedStep
) -> jax.Array:
    """Return the offset F_i (E e_i- - A E e_i) (node, n) of the mean errors, which the linear step does not give.

    The linear step takes E e_i to F_i A E e_i. But the plant is not linear: the predicted error has the mean
    E e_i- = E x- - m_i- with the filter's prediction m_i-, and a correction leaves F_i = I - K_i C_i of it.

    Args:
        state: the rule's state, with the means E e_i before the step.
        matrix: A (n, n).
        predicted_mean: E x- (n,).
        error_factor: F_i of all nodes (node, n, n).
        linear: the linearised step, with the filters' predictions m_i- (node, n).
    """
    nodes, n, _ = error_factor.shape
    mean_errors = state.gaussian.mean[n:].reshape(nodes, n)
    mean_errors_predicted = predicted_mean - linear.predicted  # E e_i-
    return jnp.einsum("iab,ib->ia", error_factor, mean_errors_predicted - mean_errors @ matrix.T)
