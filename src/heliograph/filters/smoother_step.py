"""Smoother step of a filter: what a backward pass, or the forward update of one earlier state, needs of a step."""

from collections.abc import Callable
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple, Self

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.covariance_factors import WeightedColumns, decorrelate, join_columns, triangularise, unit_lower
from heliograph.factors.factored_gaussian import Gaussian, from_columns
from heliograph.factors.gaussian_on_group import settle, unsettle
from heliograph.factors.state_given_next import BackwardGain, condition_on_next_state, rts_step
from heliograph.filters.plausibility import innovation_distance
from heliograph.model.estimate import Claim, Estimate, Innovation, weakest
from heliograph.numerics.angles.angle import Angles, wrap_angles
from heliograph.numerics.angles.manifold import Manifold
from heliograph.numerics.module import Module
from heliograph.numerics.types import Array, ArrayLike, Float, Int, PyTree

if TYPE_CHECKING:
    from heliograph.filters.truncation import PlacedLimits

EVERY_LINE = Manifold()


class StepTrace(NamedTuple):
    """States of a filter around step k: `before` it, `prior` after the prediction, `after` the correction with z.

    Also the innovation of the correction, the measurement z (received,) and the input u (inputs,).
    """

    before: PyTree
    prior: PyTree
    after: PyTree
    innovation: Innovation
    z: ArrayLike
    u: ArrayLike
    k: int | np.integer | Int[jax.Array, ""]

    def map_states(self, read: Callable[[PyTree], PyTree]) -> "StepTrace":
        """Return the same step of a filter whose states are what `read` returns of these."""
        return self._replace(before=read(self.before), prior=read(self.prior), after=read(self.after))


class EarlierState(NamedTuple):
    """An earlier state x_j regressed on the present state x: x_j = mean + M L^-1 (x - E x) + noise.

    M is `link` (N, N), `lower` has the entries of the unit lower triangular L below its diagonal (N (N - 1) / 2,), and
    the noise (N, columns) is uncorrelated with x. Mean (N,).
    """

    mean: Float[jax.Array, " N"]
    link: Float[jax.Array, "N N"]
    lower: Float[jax.Array, " entries"]
    noise: WeightedColumns

    def through(self, rows: jax.Array) -> jax.Array:
        """Return M L^-1 times rows (N, ...)."""
        return self.link @ decorrelate(unit_lower(self.lower), rows)


class SmootherStep(Module):
    """Smoother step: the law of the filter's state (N numbers) after a step, and the regression of the state before it.

    `after` is the Gaussian after the step. `before` regresses the state before the step on the predicted state, given
    the data before the step; given both, the step's measurement says nothing more of it. So Rauch, Tung and Striebel's
    recursion holds for any state that moves by a prediction with a white noise, whatever the correction is. The plant's
    state is projection y + offset of the filter's state y, or y itself without them. Stacked along time, and over runs,
    it describes a whole run of a filter.

    claim: what smoothed covariances are said to be. manifold: which of the plant's states are angles, which estimates
    (but no backward pass) wrap to within -pi and pi, and which are attitudes, whose law is that of small rotations from
    the mean. limits: of the plant's states, on which estimates are conditioned. nis: e' S^-1 e of the step's
    innovation, with mean `received`, the number of components that arrived.

    Shapes: projection (n, N), offset (n,).
    """

    after: Gaussian
    before: BackwardGain  # None of a filter of modes with several laws of motion, which goes back by pairs
    projection: Float[jax.Array, "*time n N"] | None = eqx.field(default=None, kw_only=True)
    offset: Float[jax.Array, "*time n"] | None = eqx.field(default=None, kw_only=True)
    nis: Float[jax.Array, "*time"] | None = eqx.field(default=None, kw_only=True)
    received: Float[jax.Array, "*time"] | None = eqx.field(default=None, kw_only=True)
    claim: Claim = eqx.field(static=True, kw_only=True)
    manifold: Manifold = eqx.field(static=True, default=EVERY_LINE, kw_only=True)
    limits: "PlacedLimits" = eqx.field(static=True, default=(), kw_only=True)

    @property
    def mean(self) -> Float[Array, "*time N"]:
        """Mean of the filter's state after the step."""
        return self.after.mean

    @property
    def covariance(self) -> Float[Array, "*time N N"]:
        """Covariance of the filter's state after the step."""
        covariance: Array = self.after.covariance
        return covariance

    @property
    def angles(self) -> Angles:
        """Indices of the plant's states that are angles."""
        return self.manifold.angles

    @property
    def end(self) -> Any:
        """The filter's law after the step, from which a backward pass starts."""
        return self.after

    def back(self, later: Gaussian) -> Gaussian:
        """Smooth the state before the step from `later`, the smoothed law of the state after it (one RTS step).

        Attitudes are not vectors: `unsettle` writes `later` as rotation vectors from the predicted mean, the RTS step
        is linear in these, and `settle` rotates the filtered mean before the step by its result.
        """
        filtered_mean, predicted_mean = self.before.left.mean, self.before.ahead
        smoothed = rts_step(self.before, unsettle(self.manifold, predicted_mean, later))
        return settle(self.manifold, filtered_mean, smoothed)

    def mean_back(self, later: jax.Array) -> jax.Array:
        """Return the smoothed mean m_s of the state before the step from `later` = m_s+, the one after it, (N,).

        m_s = m + J (m_s+ - m+), with the filtered mean m before the step and the predicted mean m+. `unsettle` writes
        attitudes as rotation vectors from m+, and `settle` rotates m by the result.
        """
        filtered_mean, predicted_mean = self.before.left.mean, self.before.ahead
        mean = self.before.mean_given(self.manifold.unsettle(predicted_mean, later))
        return jnp.asarray(self.manifold.settle(filtered_mean, mean))

    def start(self) -> EarlierState:
        """Return the state after this step as an earlier state, to be carried on to later steps.

        An earlier state is mean + link L^-1 (x - E x) + noise, with x the present state. Here it is x itself: link and
        L are I, and there is no noise.
        """
        n = len(self.after.mean)
        return EarlierState(
            mean=self.after.mean,
            link=jnp.eye(n),
            lower=jnp.zeros_like(self.after.lower),
            noise=WeightedColumns(jnp.eye(n), jnp.zeros(n)),
        )

    def ahead(self, point: EarlierState) -> EarlierState:
        """Regress an earlier state x_j on the state after this step, given this step's data too.

        `point` regresses it on the state x before the step: x_j = mean + M L^-1 (x - m) + noise. In turn
        x - m = K e + d: the predicted state is x+ = m+ + L+ e, and d, of covariance `before.left`, is uncorrelated with
        it. So x_j = mean + M L^-1 K L+^-1 (x+ - m+) + (M L^-1 d + noise). This step's measurement depends on x+ alone,
        and moves its mean by `change`.
        """
        before = self.before
        noise = WeightedColumns(point.through(before.left.root), before.left.variances)  # M L^-1 d
        regressed = EarlierState(
            mean=point.mean,
            link=point.through(before.gain),  # M L^-1 K
            lower=before.lower,  # L+
            noise=triangularise(join_columns(point.noise, noise)),
        )
        change = self.manifold.unsettle(before.ahead, self.after.mean) - before.ahead
        regressed = regressed._replace(mean=point.mean + regressed.through(change[:, None])[:, 0])
        # Attitudes: the errors so far are rotations from the predicted mean; the Jacobian makes them ones from the
        # corrected mean.
        reset = self.manifold.reset_jacobian(change)
        if reset is None:
            return regressed
        return regressed._replace(link=regressed.through(jnp.linalg.inv(reset)), lower=jnp.zeros_like(before.lower))

    def settle(self, law: Gaussian) -> Gaussian:
        """Return the law of the state after this step, given that of its small rotations from the filtered mean.

        Only attitudes change: the filtered mean is rotated by the mean rotation vector.
        """
        return settle(self.manifold, self.after.mean, law)

    def find_law_of_earlier(self, point: EarlierState) -> Gaussian:
        """Return the law of an earlier state given all data up to this step.

        `point` is x_j = mean + M L^-1 (x - E x) + noise, so Cov x_j = (M L^-1) Cov(x) (M L^-1)' + Cov noise, with
        Cov(x) that of the state after this step.
        """
        explained = WeightedColumns(point.through(self.after.root), self.after.variances)
        return from_columns(point.mean, join_columns(explained, point.noise))

    def with_data(self, mean_before: jax.Array, mean_prior: jax.Array, mean_after: jax.Array) -> Self:
        """Return this step for other data that arrived at the same times: covariances and gains stay, means change.

        The means (N,) are those of the filter's state before the step, after its prediction and after its correction.
        """
        before = self.before._replace(left=self.before.left._replace(mean=mean_before), ahead=mean_prior)
        return replace(self, after=self.after._replace(mean=mean_after), before=before)

    def estimate_from(self, law: Gaussian) -> Estimate:
        """Return the estimate of the plant's state, projection y + offset, from the law of the filter's state y.

        Where the plant's states have `limits`, the law is truncated to them.
        """
        mean, columns = law.mean, law.columns
        if self.projection is not None:
            mean = self.projection @ mean
            columns = columns.through(self.projection)
        mean = mean if self.offset is None else mean + self.offset
        if self.limits:
            from heliograph.filters.truncation import hold_mean_within_limits, truncate_to_limits

            law = hold_mean_within_limits(from_columns(mean, columns), self.limits)
            stack_of_one = jax.tree.map(lambda leaf: leaf[None], law)
            _, truncated = truncate_to_limits(stack_of_one, self.limits)
            return Estimate(wrap_angles(truncated.mean[0], self.angles), truncated.covariance[0], self.claim)
        mean = wrap_angles(mean, self.angles)
        return Estimate(mean, columns.covariance, self.claim, attitude=self.manifold.rotations)


def gaussian_of(state: PyTree) -> Any:
    """Return the Gaussian that a filter's state holds in a field `gaussian`, or the state if it has no such field."""
    return getattr(state, "gaussian", state)


def with_gaussian(state: PyTree, x: Gaussian) -> PyTree:
    """Return a filter's state with `x` as its Gaussian: in its field `gaussian`, or as the state itself."""
    return state._replace(gaussian=x) if hasattr(state, "gaussian") else x


def smoother_step_of(
    step: StepTrace,
    moved: tuple[Array, WeightedColumns],
    claim: Claim,
    manifold: Manifold = EVERY_LINE,
    projection: Array | None = None,
) -> SmootherStep:
    """Build the smoother step from the Gaussians that a filter's states hold.

    A smoother goes back over the steps of a filter (Rauch, Tung and Striebel). It needs the regression of the state x
    before the step on the state x+ after it. With x = m + L xi before the step, the predicted state is
    x+ = E x+ + slopes xi + w: E x+, the slopes and Cov w are all that the regression needs.

    Args:
        step: the filter's states before the step, after the prediction, and after the correction; each holds a Gaussian
            of N numbers.
        moved: (slopes (N, N), columns of the noise's covariance Cov w (N, columns)).
        claim: what smoothed covariances are said to be: exact, upper bound or nominal.
        manifold: which of the plant's states are angles and attitudes.
        projection: from the filter's state to the plant's (n, N).
    """
    slopes, noise = moved
    states = step.before, step.prior, step.after
    # The Gaussian of each state.
    before, prior, after = (Gaussian(*map(jnp.asarray, gaussian_of(state))) for state in states)
    # `condition_on_next_state` is the regression.
    return SmootherStep(
        after,
        condition_on_next_state(before, jnp.asarray(slopes), prior.mean, noise),
        claim=claim,
        manifold=manifold,
        projection=None if projection is None else jnp.asarray(projection),
    )


def make_smoother_step(filter: Any, trace: StepTrace) -> SmootherStep:
    """Return what a backward pass needs of one step of a filter, with the NIS of the step's innovation.

    The NIS is e' S^-1 e of the innovation e with covariance S, and `count` the number of components that arrived. A
    filter may return the smoother step of a filter inside it: what its covariance is said to be (`claim`) is then made
    no stronger than the filter's own claim.
    """
    step: SmootherStep = filter.smoother_step(trace)
    nis, count = innovation_distance(trace.innovation)
    return replace(step, nis=nis, received=count, claim=weakest([step.claim, filter.claim]))
