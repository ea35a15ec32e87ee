"""The fusion centre as a filter of one network: its measurements are the nodes' reports."""

import math
from collections.abc import Sequence
from typing import NamedTuple, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractSizedFilter, Step, corrects, estimates, predicts
from heliograph.filters.innovation import gaussian_innovation
from heliograph.filters.linear.precomputed_filter import LinearStep
from heliograph.fusion.all_reports_fusion import (
    ReportsBelief,
    correct_with_reports,
    estimate_state,
    make_initial_belief,
    propagate_errors,
)
from heliograph.fusion.cross_covariance import (
    ErrorMoments,
)
from heliograph.fusion.report_link import ReportModel
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.over_time import OverTime, at
from heliograph.numerics.float64 import compile_in_float64
from heliograph.numerics.types import ArrayLike, PyTree
from heliograph.simulation.centres.fusion_centre import FusionCentre


class NodeFiltersWithoutData(Protocol):
    """The nodes' filters as their centre steps them: without data, on which their gains do not depend."""

    @property
    def linear_centres(self) -> tuple[FusionCentre, ...]:
        """The centre of their errors' moments, alone."""

    def init(self) -> PyTree:
        """Return the states before the first step."""

    def list_step_matrices(self, centre: FusionCentre, states: PyTree, u: jax.Array, k: jax.Array) -> Sequence[PyTree]:
        """Return the matrices of the filters' step k for each source of the centre, from their states before it."""

    def step_without_data(self, states: PyTree, u: jax.Array, k: jax.Array) -> PyTree:
        """Return the filters' states after step k."""


class CentreJointState(NamedTuple):
    """What the centre knows after a step.

    Args:
        nodes: states of the nodes' filters, of which only covariances matter.
        errors: moments of their errors.
        known: joint estimate of the plant's state, the errors and the reports that may still arrive.
    """

    nodes: PyTree
    errors: ErrorMoments
    known: ReportsBelief


class CentreFilter(AbstractSizedFilter):
    """Filter form of `AllReports`, whose measurement is the reports: for streams, recordings and simulated runs.

    The measurement is, for each age in steps and each node in turn, the report that arrived, NaN where none did.

    Args:
        filters: of the nodes, propagated without data: their gains depend on none.
        links: model of the uplinks, by which the reports come.
        rows: which of all (age, node, component), flattened, can arrive.
        ages: how many ages in steps a report can have, 0 included.
        widest: components of the longest report.
        quantized: whether reports are quantized.
    """

    filters: NodeFiltersWithoutData
    links: ReportModel | OverTime
    rows: tuple[int, ...] = eqx.field(static=True)
    ages: int = eqx.field(static=True)
    widest: int = eqx.field(static=True)
    quantized: bool = eqx.field(static=True)

    @compile_in_float64
    def init(self) -> CentreJointState:
        """Return the state before any report: nodes' filters, moments of their errors, and the centre's estimate.

        The centre estimates the plant's state, all nodes' errors, and the reports that may still arrive late.
        """
        # Of all initial states those of the nodes' filters by stack, and those of centres, of which there is one.
        filter_states, _, _, (centre_state,), *_ = self.filters.init()
        errors = centre_state.errors
        longest_delay = self.ages - 1  # ages of reports are 0, 1, ... steps
        joint_estimate = make_initial_belief(
            errors, delays=longest_delay, received=self.widest, quantized=self.quantized
        )
        return CentreJointState(nodes=filter_states, errors=errors, known=joint_estimate)

    @predicts
    def predict(self, state: CentreJointState, u: ArrayLike = (), k: Step = 0) -> CentreJointState:
        """Predict the plant's state and all nodes' errors over step k, in which each node filters and sends a report.

        The nodes' gains depend on no data, so that the centre computes them itself.
        """
        (centre,) = self.filters.linear_centres  # it has the models of the nodes' errors
        u, step = jnp.asarray(u), jnp.asarray(k)
        # Matrices of the nodes' filters, then the step of their errors e_i = x - m_i that these make.
        filters: LinearStep = centre.gather_matrices(self.filters.list_step_matrices(centre, state.nodes, u, step))
        error_step = centre.step_errors(state.errors, filters, u, step)
        # The nodes' filters after the step, and the centre's estimate of (x, e_1, ..., e_nodes, past reports).
        node_states = self.filters.step_without_data(state.nodes, u, step)
        joint_estimate = propagate_errors(state.known, error_step, at(self.links, k))
        return CentreJointState(nodes=node_states, errors=error_step.errors, known=joint_estimate)

    @corrects
    def correct(self, state: CentreJointState, z: ArrayLike, k: Step = 0) -> tuple[CentreJointState, Innovation]:
        """Return the state corrected by the reports that arrived, and the innovation.

        z is NaN for reports that did not arrive. `self.rows` are the indices of z among all numbers that could come,
        flattened from (age, node, widest): reports of every delay, padded to the longest report.
        """
        shape = self.ages, state.known.past.gain.shape[1], self.widest
        indices = np.array(self.rows)
        reports = jnp.full(math.prod(shape), jnp.nan).at[indices].set(jnp.asarray(z))
        belief, expected = correct_with_reports(state.known, reports.reshape(shape))
        mean, covariance = expected.mean[indices], expected.covariance[indices][:, indices]
        return state._replace(known=belief), gaussian_innovation(jnp.asarray(z), mean, covariance)

    @estimates
    def estimate(self, state: CentreJointState) -> Estimate:
        """Return the best linear estimate of the plant's state."""
        return Estimate(*estimate_state(state.known, len(self.states)), self.claim)
