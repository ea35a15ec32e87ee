"""Fusion centre as a filter: its measurements are the nodes' reports, and it propagates the moments of their errors."""

from collections.abc import Sequence
from typing import NamedTuple, Protocol

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractSizedFilter, Step, corrects, predicts
from heliograph.filters.innovation import gaussian_innovation
from heliograph.filters.linear.plan import Plan
from heliograph.fusion.all_reports import Knowledge, begin, fused_estimate, moved, receive_reports
from heliograph.fusion.cross_covariance import Errors
from heliograph.fusion.report_link import Links
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.over_time import OverTime, at
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.types import ArrayLike, PyTree
from heliograph.simulation.centres.centre import Centre


class NodesFilters(Protocol):
    """The nodes' filters as their centre steps them: without data, on which their gains do not depend."""

    @property
    def informed(self) -> tuple[Centre, ...]:
        """The centre of their errors' moments, alone."""

    def init(self) -> PyTree:
        """States before the first step."""

    def matrices(self, centre: Centre, states: PyTree, u: jax.Array, k: jax.Array) -> Sequence[PyTree]:
        """Matrices of the filters' next step."""

    def followed(self, states: PyTree, u: jax.Array, k: jax.Array) -> PyTree:
        """States after a step."""


class CentreState(NamedTuple):
    """States of the nodes' filters, of which only covariances matter; moments of their errors; the estimate."""

    nodes: PyTree
    errors: Errors
    known: Knowledge


class CentreFilter(AbstractSizedFilter):
    """Filter form of `AllReports`, whose measurement is the reports: for streams, recordings and simulated runs.

    The measurement is, for each age in steps and each node in turn, the part of the report that arrived: NaN for a
    report that did not. `rows`: their places among (age, node, m). Local filters are propagated without data: their
    gains depend on none.
    """

    filters: NodesFilters
    links: Links | OverTime
    rows: np.ndarray
    ages: int = eqx.field(static=True)
    widest: int = eqx.field(static=True)
    quantized: bool = eqx.field(static=True)

    @in_float64
    def init(self) -> CentreState:
        """Return the state before any report."""
        states, _, _, known, *_ = self.filters.init()
        errors = known[0].errors
        return CentreState(states, errors, begin(errors, self.ages - 1, self.widest, self.quantized))

    @predicts
    def predict(self, state: CentreState, u: ArrayLike = (), k: Step = 0) -> CentreState:
        """Predict plant and all errors; the nodes send their reports."""
        (centre,), u, step = self.filters.informed, jnp.asarray(u), jnp.asarray(k)
        plan: Plan = centre.gathered(self.filters.matrices(centre, state.nodes, u, step))
        happened = centre.moved(state.errors, plan, u, step)
        following = self.filters.followed(state.nodes, u, step)
        return CentreState(following, happened.errors, moved(state.known, happened, at(self.links, k)))

    @corrects
    def correct(self, state: CentreState, z: ArrayLike, k: Step = 0) -> tuple[CentreState, Innovation]:
        """Correct with the reports that arrived."""
        nodes = state.known.past.gain.shape[1]
        everything = jnp.full(self.ages * nodes * self.widest, jnp.nan).at[self.rows].set(jnp.asarray(z))
        known, expected = receive_reports(state.known, everything.reshape(self.ages, nodes, self.widest))
        mean, covariance = expected.mean[self.rows], expected.covariance[self.rows][:, self.rows]
        return state._replace(known=known), gaussian_innovation(jnp.asarray(z), mean, covariance)

    @in_float64
    def estimate(self, state: CentreState) -> Estimate:
        """Best linear estimate of the plant's state."""
        return Estimate(*fused_estimate(state.known, len(self.states)), self.claim)
