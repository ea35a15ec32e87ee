"""Upper bound behind Markov chains with uncertain, time-varying transition probabilities.

With Pi + Delta_k for Pi, |Delta| <= radius, rows that sum to 0: the error before z is F e + (Delta x A~) zeta + w, so
Sigma- <= (1 + b) F Sigma F' + (1 + 1/b) D + W with D >= sum_i p_i Delta_i Delta_i' x A~ Xi A~' for every such chain.
Terms that depend on the law p of the modes are bounded over the interval of possible p.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from heliograph.engine.choice import compile_on_call
from heliograph.factors.covariance_factors import WeightedColumns, join_columns, triangularise
from heliograph.factors.factored_gaussian import Gaussian, from_columns
from heliograph.filters.base import Step, corrects, predicts
from heliograph.filters.gaussian.signal_moments import factor_spread
from heliograph.filters.modes.jump_linear_filter import (
    AbstractJointModalFilter,
    MeasurementModel,
    claim_of_modes,
    compute_initial_moments,
    concatenate_modes,
    condition_modes_on_received,
    factor_with_last_mode,
    fields_of_joint_modes,
    mean_from_centre,
    predict_by_mode,
    rounding_of_received,
    subtract_mean_output,
)
from heliograph.filters.modes.linear_by_mode import centred_measurement, centred_transition
from heliograph.filters.smoother_step import SmootherStep, StepTrace, smoother_step_of
from heliograph.model.channel import Channel
from heliograph.model.estimate import Claim, Innovation
from heliograph.model.over_time import at
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor
from heliograph.numerics.lapack import eigh
from heliograph.numerics.types import ArrayLike, Bool, Float


class UncertainBelief(NamedTuple):
    """zeta given the data, with a bound as its covariance, E[x~ x~'], and bounds on the modes' law.

    x~ = (x - c, 1) with the centre c = E[x], as in `ModalBelief`. `moved` is true from the first prediction on.

    Shapes: zeta (M (n + 1),), second (n + 1, n + 1), centre (n,), law, low and high (M,).
    """

    gaussian: Gaussian
    second: Float[jax.Array, "n1 n1"]
    centre: Float[jax.Array, " n"]
    law: Float[jax.Array, " M"]
    low: Float[jax.Array, " M"]
    high: Float[jax.Array, " M"]
    moved: Bool[jax.Array, ""]


class UncertainModalFilter(AbstractJointModalFilter):
    """A linear filter whose covariance bounds its error's for every chain within the radius of the nominal one.

    Source: the filter of Costa (1994) with Young's inequality for the uncertain part of the chain.
    """

    @compile_on_call
    def init(self) -> UncertainBelief:
        """Return the prior, independent of the mode, whose initial law is known.

        `low` and `high`, the ends of the modes' law, are equal at the start. `second_moment` is E[x~ x~'] with
        x~ = (x - centre, 1).
        """
        start, law = at(self.plant, k=0), jnp.asarray(self.initial)
        prior, second_moment = compute_initial_moments(start, self.initial)
        centre = jnp.asarray(start.initial_mean)
        return UncertainBelief(
            gaussian=prior, second=second_moment, centre=centre, law=law, low=law, high=law, moved=jnp.asarray(False)
        )

    @predicts
    def predict(self, state: UncertainBelief, u: ArrayLike = (), k: Step = 0) -> UncertainBelief:
        """Propagate the bound on Sigma-; at the first prediction the mode has its initial law.

        Sigma-: covariance of zeta = (x~ 1{mode = 1}, x~ 1{mode = 2}, ...), x~ = (x - centre, 1). `young`: scalar of
        Young's inequality, by which the bound of the nominal part grows; `added_noise`: noise and the uncertain part.
        """
        x = state.gaussian
        transition, radius = self._chain_and_radius(state, k)
        matrix, noise, centre = centred_transition(at(self.plant, k), u, state.centre)
        root, young, added_noise = self._transition_factors(state, u, k)
        deviation, law = x.mean - mean_from_centre(state.law, state.centre), state.law @ transition
        mean = predict_by_mode(deviation[:, None], matrix, transition)[:, 0] + mean_from_centre(law, centre)
        after = from_columns(mean, join_columns(WeightedColumns(root, (1 + young) * x.variances), added_noise))
        # E[x~ x~'] and nominal law one step later.
        second_moment = matrix @ state.second @ matrix.T + noise
        low, high = _bound_next_law(transition, radius, state.low, state.high)
        return UncertainBelief(
            gaussian=after, second=second_moment, centre=centre, law=law, low=low, high=high, moved=jnp.asarray(True)
        )

    def _chain_and_radius(self, state: UncertainBelief, k: Step) -> tuple[jax.Array, jax.Array]:
        """Return the modes' transition matrix and the radius of its entries; they are I and 0 at the first step."""
        channel = at(self.channel, k)
        # Modes keep their initial law up to the first step.
        transition = jnp.where(state.moved, jnp.asarray(channel.transition), jnp.eye(len(state.law)))
        return transition, jnp.where(state.moved, jnp.asarray(channel.radius), 0.0)

    def _transition_factors(
        self, state: UncertainBelief, u: ArrayLike, k: Step
    ) -> tuple[jax.Array, jax.Array, WeightedColumns]:
        """Return F L, b, and the columns of (1 + 1/b) D + W, of Sigma- = (1 + b) F Sigma F' + (1 + 1/b) D + W."""
        move, _, _ = centred_transition(at(self.plant, k), u, state.centre)
        rows, radius = self._chain_and_radius(state, k)
        # Bounds on Cov(1{next} | i) and on Delta_i Delta_i', over all laws of the mode.
        carried = move @ state.second @ move.T
        of_jumps, of_chain = (
            _bound_mean(matrices, *_find_middle_law(state.low, state.high)) for matrices in _bound_moves(rows, radius)
        )
        # Young's inequality, b = root(tr D / tr F Sigma F').
        root, weights = predict_by_mode(state.gaussian.root, move, rows), state.gaussian.variances
        young = jnp.sqrt(_divide_or_zero(jnp.trace(of_chain) * jnp.trace(carried), jnp.sum(root**2 @ weights)))
        of_both = of_jumps + jnp.where(young > 0, 1 + 1 / jnp.where(young > 0, young, 1.0), 0.0) * of_chain
        # Columns of (1 + 1 / b) D and of the bound W on the covariance of the noise.
        low, high = _bound_next_law(rows, radius, state.low, state.high)
        by_modes = factor_with_last_mode(jnp.einsum("jl,ab->jalb", of_both[:-1, :-1], carried))
        of_process = self.process_noise_by_mode(u, k, factor_spread(_bound_diagonal(low, high)))
        return root, young, join_columns(by_modes, of_process)

    @corrects
    def correct(self, state: UncertainBelief, z: ArrayLike, k: Step = 0) -> tuple[UncertainBelief, Innovation]:
        """Correct with z; the covariance of z given zeta is bounded over the laws of the modes.

        zeta = (x~ 1{mode = 1}, ...), x~ = (x - centre, 1); `signal_moment`: E[y~ y~'] of the signal; `bounded_noise`:
        bound of noise and spread of the gains.
        """
        sensor, channel = at(self.sensor, k), at(self.channel, k)
        gains, (measure, noise) = jnp.asarray(channel.mean), centred_measurement(sensor, state.centre)
        signal_moment = measure @ state.second @ measure.T + noise
        gain_noise = jnp.einsum("jmlab,ab->jml", jnp.asarray(channel.spread), signal_moment)
        middle, reach = _find_middle_law(state.low, state.high)
        bounded_noise = _bound_mean(gain_noise + gains @ noise @ gains.swapaxes(1, 2), middle, reach)
        matrix, mean_output = subtract_mean_output(gains @ measure, state.law)
        rounding = rounding_of_received(gains, state.law[:, None, None] * signal_moment)
        deviation = state.gaussian.mean - mean_from_centre(state.law, state.centre)
        output = MeasurementModel(
            concatenate_modes(matrix), mean_output, join_columns(rounding, factor_spread(bounded_noise))
        )
        after, innovation = condition_modes_on_received(state.gaussian, deviation, output, z)
        return state._replace(gaussian=after), innovation

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return the smoother step of zeta+ = F zeta + noise; nominal, as the bound is not proved for smoothing.

        zeta is the state times each mode's indicator. `young` is the scalar of the bound: F P F' grows by this share.
        `added_noise` holds the process noise and the uncertain part.
        """
        slopes, young, added_noise = self._transition_factors(step.before, step.u, step.k)
        growth = WeightedColumns(slopes, young * step.before.gaussian.variances)
        slopes_and_noise = slopes, triangularise(join_columns(growth, added_noise))
        return smoother_step_of(step, slopes_and_noise, "nominal", projection=self._projection_to_state())


def _divide_or_zero(numerator: jax.Array, denominator: jax.Array) -> jax.Array:
    """Return the quotient, 0 where the denominator is 0."""
    return jnp.where(denominator > 0, numerator / jnp.where(denominator > 0, denominator, 1.0), 0.0)


def _bound_moves(transition: jax.Array, radius: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return bounds on Cov(1{next} | i) and on Delta_i Delta_i' (M, M, M), for each mode i and every Delta_i.

    Row i of `transition` is pi, the nominal law of the next mode after i. Delta_i is its error, with |Delta_ij| <= r_ij
    (`radius`). For each i, Cov = sum_j (pi_j + Delta_j)(e_j - pi)(e_j - pi)' - Delta Delta', and replacing Delta_j by
    r_j bounds it. Delta Delta' <= P diag(r_j sum r) P, with P the projection that removes the mean, since
    Delta = P Delta and |Delta_j Delta_l| <= r_j r_l.
    """
    modes = len(transition)
    difference = jnp.eye(modes)[None] - transition[:, None, :]  # [i, j] = e_j - pi_i
    jump_covariance = jnp.einsum("ij,ija,ijb->iab", transition + radius, difference, difference)
    projection = jnp.eye(modes) - 1 / modes
    delta_bound = radius * jnp.sum(radius, axis=1, keepdims=True)
    return jump_covariance, jnp.einsum("aj,ij,jb->iab", projection, delta_bound, projection)


def _find_middle_law(low: jax.Array, high: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return a law between the ends (its sum is 1), and the largest deviation of a possible law from it.

    `low` and `high` (M,) are the least and the greatest probability of each mode.
    """
    middle = (low + high) / 2
    middle = middle + (1 - jnp.sum(middle)) / len(low)
    return middle, jnp.maximum(high - middle, middle - low)


def _bound_mean(matrices: jax.Array, middle: jax.Array, reach: jax.Array) -> jax.Array:
    """Return a bound on sum_i p_i X_i for all laws p: sum_i middle_i X_i + sum_i reach_i |X_i - mean of all|.

    The X_i are symmetric, and |X| has the absolute eigenvalues of X. `reach` (M,) is how far p_i may be from middle_i.
    """
    values, vectors = jax.vmap(eigh)(matrices - jnp.mean(matrices, axis=0))
    absolute = (vectors * jnp.abs(values)[:, None, :]) @ vectors.swapaxes(1, 2)
    return jnp.einsum("i,iab->ab", middle, matrices) + jnp.einsum("i,iab->ab", reach, absolute)


def _bound_diagonal(low: jax.Array, high: jax.Array) -> jax.Array:
    """Return a bound on diag(p) over all laws p of the modes, tight in the direction of equal entries.

    p = middle + delta with |delta_i| <= reach_i, and the delta_i sum to 0. With u = (1, ..., 1) / root M, P = I - u u'
    and d = delta / root M, diag(delta) = P diag(delta) P + u d' + d u'. By Young's inequality
    u d' + d u' <= e u u' + d d' / e. P diag(delta) P is 0 for two modes. `low` and `high` (M,) are the ends of p.
    """
    modes = len(low)
    middle, reach = _find_middle_law(low, high)
    projection, total = jnp.eye(modes) - 1 / modes, jnp.sum(reach)
    e = total / modes / 2  # d d' <= diag(reach) sum reach / M, by Cauchy and Schwarz
    safe_e = jnp.where(e > 0, e, 1.0)
    cross_term = projection @ jnp.diag(reach * total) @ projection / (safe_e * modes)
    projected = projection @ jnp.diag(reach) @ projection if modes > 2 else jnp.zeros((modes, modes))
    return jnp.diag(middle) + e / modes * jnp.ones((modes, modes)) + cross_term + projected


def _bound_next_law(
    transition: jax.Array, radius: jax.Array, low: jax.Array, high: jax.Array
) -> tuple[jax.Array, jax.Array]:
    """Return the least and the greatest probability of every mode one step later, over laws between low and high.

    `transition` is the nominal transition matrix, and `radius` bounds the error of each entry. `low` and `high` (M,)
    are the ends of the present law.
    """
    lowest, highest = jnp.clip(transition - radius, 0.0, 1.0), jnp.clip(transition + radius, 0.0, 1.0)
    largest_by_mode = jax.vmap(_largest_payoff, (1, None, None))
    # The least payoff is minus the largest payoff of the negative entries.
    return -largest_by_mode(-lowest, low, high), largest_by_mode(highest, low, high)


def _largest_payoff(payoff: jax.Array, low: jax.Array, high: jax.Array) -> jax.Array:
    """Return the maximum of sum_i p_i payoff_i over all laws p with low <= p <= high.

    p begins at `low`, and the mass that is left of 1 goes to the largest payoffs first. All arguments are (M,).
    """
    # is_served_before[i, j]: mode i gets mass before mode j, since its payoff is larger or, if equal, its number lower.
    number = jnp.arange(len(payoff))
    is_served_before = (payoff[:, None] > payoff) | ((payoff[:, None] == payoff) & (number[:, None] < number))
    capacity = high - low
    added = jnp.clip(1 - jnp.sum(low) - capacity @ is_served_before, 0.0, capacity)
    return (low + added) @ payoff


def uncertain_modal_filter(plant: AnyPlant, sensor: AnySensor, channel: Channel) -> UncertainModalFilter:
    """Build the filter behind a channel with an uncertain chain; `linear_filter` has checked that the parts fit."""
    claim: Claim = "upper" if claim_of_modes(channel) == "exact" else "nominal"
    fields = fields_of_joint_modes(plant, sensor, channel, claim)
    return UncertainModalFilter(plant=plant, sensor=sensor, **fields)
