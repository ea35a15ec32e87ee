"""Upper bound behind Markov chains with uncertain, time-varying transition probabilities.

The estimated vector is zeta = (x~ 1{mode = 1}, x~ 1{mode = 2}, ...), with the nominal transition F = Pi' (x) A~
(Kronecker's product). The true chain is Pi + Delta, where |Delta_ij| <= radius_ij and each row Delta_i sums to 0. So
the error e = zeta - (its estimate), whose second moment Sigma bounds, becomes

    e+ = F e + (Delta' (x) A~) zeta + w        w: the draw of the next mode, and the plant's noise

By Young's inequality (a + c)(a + c)' <= (1 + b) a a' + (1 + 1/b) c c' with any b > 0, and with p the modes' law,

    E[e+ e+'] <= (1 + b) F Sigma F' + (1 + 1/b) D + W
    D >= sum_i p_i Delta_i' Delta_i (x) A~ E[x~ x~'] A~'
    W >= sum_i p_i Cov(1{next mode} | mode = i) (x) A~ E[x~ x~'] A~' + diag(p+) (x) Q~

D and W bound the right-hand sides for every such Delta, and for every p between the bounds of the modes' law.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp

from heliograph.engine.choice import compile_on_call
from heliograph.factors.covariance_factors import WeightedColumns, join_columns, triangularise
from heliograph.factors.factored_gaussian import Gaussian, from_columns
from heliograph.filters.base import Step, corrects, predicts
from heliograph.filters.gaussian.signal_moments import factor_covariance
from heliograph.filters.modes.jump_linear_filter import (
    AbstractJointModalFilter,
    MeasurementModel,
    claim_of_modes,
    compute_initial_moments,
    concatenate_modes,
    condition_modes_on_received,
    fields_of_joint_modes,
    mean_from_centre,
    rounding_of_received,
    subtract_mean_output,
)
from heliograph.filters.modes.linear_by_mode import (
    centred_measurement,
    centred_transition,
    factor_with_last_mode,
    multiply_by_transition,
)
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
        """Return the prior of zeta = (x~ 1{mode = 1}, x~ 1{mode = 2}, ...), where x~ = (x - centre, 1).

        State and mode are independent at the start, and the initial law of the mode is known: its lower and upper
        bounds `low` and `high` are equal. `second_moment` is E[x~ x~'].
        """
        start, law = at(self.plant, k=0), jnp.asarray(self.initial)
        prior, second_moment = compute_initial_moments(start, self.initial)
        centre = jnp.asarray(start.initial_mean)
        return UncertainBelief(
            gaussian=prior, second=second_moment, centre=centre, law=law, low=law, high=law, moved=jnp.asarray(False)
        )

    @predicts
    def predict(self, state: UncertainBelief, u: ArrayLike = (), k: Step = 0) -> UncertainBelief:
        """Predict zeta = (x~ 1{mode = 1}, ...) by the nominal chain, and a bound on its error's covariance Sigma.

        x~ = (x - c, 1) with c = E[x] before any data, and A~ is the plant's matrix for x~. The mode is a Markov chain
        with the nominal transition matrix Pi, each entry of which is known within a radius. The nominal transition F of
        zeta has the blocks F_ji = Pi_ij A~. For every chain within the radius, and any b > 0 (Young's inequality),
        Sigma+ <= (1 + b) F Sigma F' + (1 + 1/b) D + W: D bounds what the error of Pi adds, W is the noise's covariance.
        """
        zeta = state.gaussian
        transition, radius = self._chain_and_radius(state, k)  # Pi; at the first prediction I, with radius 0
        A, Q, next_centre = centred_transition(at(self.plant, k), u, state.centre)  # A~ and Q~
        # The mean of zeta counts x from 0: P(j) (c, 0) for each mode j, plus `deviation`, which F moves.
        next_law = state.law @ transition
        deviation = zeta.mean - mean_from_centre(state.law, state.centre)
        moved_deviation = multiply_by_transition(deviation[:, None], A, transition)[:, 0]
        mean = moved_deviation + mean_from_centre(next_law, next_centre)
        # Sigma = L diag(variances) L' becomes (1 + b) F L diag(variances) (F L)' + columns of (1 + 1/b) D + W.
        slopes, b, added_noise = self._transition_factors(state, u, k)
        predicted = from_columns(mean, join_columns(WeightedColumns(slopes, (1 + b) * zeta.variances), added_noise))
        # The least and the greatest probability of each next mode, over all chains within the radius.
        low, high = _bound_next_law(transition, radius, state.low, state.high)
        return UncertainBelief(
            gaussian=predicted,
            second=A @ state.second @ A.T + Q,  # E[x~+ x~+']
            centre=next_centre,
            law=next_law,
            low=low,
            high=high,
            moved=jnp.asarray(True),
        )

    def _chain_and_radius(self, state: UncertainBelief, k: Step) -> tuple[jax.Array, jax.Array]:
        """Return the modes' nominal transition matrix to step k, and how far each entry may be off (M, M) each.

        They are I and 0 at the first step, before which the modes do not move.
        """
        channel = at(self.channel, k)
        # Modes keep their initial law up to the first step.
        transition = jnp.where(state.moved, jnp.asarray(channel.transition), jnp.eye(len(state.law)))
        return transition, jnp.where(state.moved, jnp.asarray(channel.radius), 0.0)

    def _transition_factors(
        self, state: UncertainBelief, u: ArrayLike, k: Step
    ) -> tuple[jax.Array, jax.Array, WeightedColumns]:
        """Return F L, b, and columns of (1 + 1/b) D + W, for the bound Sigma+ <= (1 + b) F Sigma F' + (1 + 1/b) D + W.

        The filter estimates zeta = (x~ 1{mode = 1}, x~ 1{mode = 2}, ...), x~ = (x - c, 1), c = `state.centre`. Sigma =
        L diag(variances) L' (`state.gaussian`) bounds the covariance of its error. F has the blocks F_ji = Pi_ij A~.
        The chain of modes is known up to a radius: its row i is Pi_i + Delta_i. The modes have the law p, then p+; p
        lies between `state.low` and `state.high`. A~ moves x~, and Q~ is the noise's covariance. With X = A~ E[x~ x~']
        A~' and Kronecker's product (x), for all possible Delta and p,

            D = D_m (x) X,                 D_m >= sum_i p_i Delta_i' Delta_i
            W = J_m (x) X + N_m (x) Q~,    J_m >= sum_i p_i Cov(1{next mode} | mode = i),    N_m >= diag(p+)
        """
        A, _, _ = centred_transition(at(self.plant, k), u, state.centre)  # A~
        transition, radius = self._chain_and_radius(state, k)
        X = A @ state.second @ A.T
        # J_m and D_m: bounds for each mode i, then on their mean over all laws p: |p - middle| is at most `reach`.
        middle, reach = _find_middle_law(state.low, state.high)
        J_m, D_m = (_bound_mean(by_mode, middle, reach) for by_mode in _bound_moves(transition, radius))
        # b = sqrt(tr D / tr(F Sigma F')) makes the trace of the bound least; tr D = tr D_m tr X.
        slopes = multiply_by_transition(state.gaussian.root, A, transition)
        nominal_trace = jnp.sum(slopes**2 @ state.gaussian.variances)
        b = jnp.sqrt(_divide_or_zero(jnp.trace(D_m) * jnp.trace(X), nominal_trace))
        # Columns of ((1 + 1/b) D_m + J_m) (x) X, whose blocks sum to 0 over the modes, and of N_m (x) Q~.
        modes_bound = J_m + jnp.where(b > 0, 1 + 1 / jnp.where(b > 0, b, 1.0), 0.0) * D_m
        chain_noise = factor_with_last_mode(jnp.einsum("jl,ab->jalb", modes_bound[:-1, :-1], X))
        low, high = _bound_next_law(transition, radius, state.low, state.high)
        process_noise = self.process_noise_by_mode(u, k, factor_covariance(_bound_diagonal(low, high)))
        return slopes, b, join_columns(chain_noise, process_noise)

    @corrects
    def correct(self, state: UncertainBelief, z: ArrayLike, k: Step = 0) -> tuple[UncertainBelief, Innovation]:
        """Correct with the components of z that arrived: z = common + H zeta + v, with a bound on Cov v.

        The state holds zeta = (x~ 1{mode = 1}, ...), x~ = (x - centre, 1), of which z is linear. The sensor sends
        y~ = (y, 1) = C~ x~ + noise of covariance R~. In mode j, z = G y~ with a random G of mean Hbar_j, whose last
        column is the noise of the link. So H = (Hbar_1 C~, Hbar_2 C~, ...), and Cov v = sum_j p_j V_j with
        V_j = E[(G - Hbar_j) E[y~ y~'] (G - Hbar_j)' | j] + Hbar_j R~ Hbar_j'. The law p of the modes is known up to
        its bounds, so this sum is bounded over all p between them.
        """
        sensor, channel = at(self.sensor, k), at(self.channel, k)
        gains, (C, R) = jnp.asarray(channel.mean), centred_measurement(sensor, state.centre)  # Hbar_j, C~ and R~
        signal_moment = C @ state.second @ C.T + R  # E[y~ y~']
        gain_noise = jnp.einsum("jmlab,ab->jml", jnp.asarray(channel.covariance), signal_moment)
        noise_by_mode = gain_noise + gains @ R @ gains.swapaxes(1, 2)  # V_j
        middle, reach = _find_middle_law(state.low, state.high)
        noise_bound = _bound_mean(noise_by_mode, middle, reach)
        # A part of Hbar_j C~ x~ that is the same in all modes is a constant, as the modes' indicators sum to 1.
        matrix, common = subtract_mean_output(gains @ C, state.law)
        rounding = rounding_of_received(gains, state.law[:, None, None] * signal_moment)
        noise = join_columns(rounding, factor_covariance(noise_bound))
        # state.gaussian is about (x, 1) 1{mode = j}, with x from 0, but H acts on x~, from the centre: `deviation` is
        # E[x~ 1{mode = j}], mode after mode.
        deviation = state.gaussian.mean - mean_from_centre(state.law, state.centre)
        model = MeasurementModel(concatenate_modes(matrix), common, noise)
        corrected, innovation = condition_modes_on_received(state.gaussian, deviation, model, z)
        return state._replace(gaussian=corrected), innovation

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return the smoother step of zeta+ = F zeta + noise, zeta = (x~ 1{mode = 1}, ...) for x~ = (x - centre, 1).

        The filter's bound is P+ = (1 + b) F P F' + N for a scalar b: here b F P F' + N is taken as the covariance of
        the noise. The claim is nominal, since no bound is proved for smoothing.
        """
        slopes, b, added_noise = self._transition_factors(step.before, step.u, step.k)  # F L, b, columns of N
        growth = WeightedColumns(slopes, b * step.before.gaussian.variances)
        slopes_and_noise = slopes, triangularise(join_columns(growth, added_noise))
        return smoother_step_of(step, slopes_and_noise, "nominal", projection=self._projection_to_state())


def _divide_or_zero(numerator: jax.Array, denominator: jax.Array) -> jax.Array:
    """Return numerator / denominator, and 0 where the denominator is 0 (or negative, by rounding)."""
    return jnp.where(denominator > 0, numerator / jnp.where(denominator > 0, denominator, 1.0), 0.0)


def _bound_moves(transition: jax.Array, radius: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return for each mode i bounds on Cov(1{next mode} | mode = i) and on Delta Delta' (M, M, M), for every Delta.

    pi, row i of `transition`, is the nominal law of the next mode, and pi + Delta the true one, with |Delta_j| <= r_j
    for row i of `radius`. Both are columns here.
    """
    modes = len(transition)
    # Cov = sum_j (pi_j + Delta_j)(e_j - pi)(e_j - pi)' - Delta Delta' is at most that with r_j for Delta_j, without
    # the last term.
    difference = jnp.eye(modes)[None] - transition[:, None, :]  # [i, j] = e_j - pi
    indicator_covariance = jnp.einsum("ij,ija,ijb->iab", transition + radius, difference, difference)
    # Delta Delta' <= P diag(r_j sum_l r_l) P: P removes the mean, so Delta = P Delta, and |Delta_j Delta_l| <= r_j r_l.
    projection = jnp.eye(modes) - 1 / modes
    delta_bound = radius * jnp.sum(radius, axis=1, keepdims=True)
    return indicator_covariance, jnp.einsum("aj,ij,jb->iab", projection, delta_bound, projection)


def _find_middle_law(low: jax.Array, high: jax.Array) -> tuple[jax.Array, jax.Array]:
    """Return a law in the middle of all possible ones (M,), and how far a possible probability may be from it (M,).

    `low` and `high` (M,) are the least and the greatest probability of each mode. The middle law sums to 1.
    """
    middle = (low + high) / 2
    middle = middle + (1 - jnp.sum(middle)) / len(low)
    return middle, jnp.maximum(high - middle, middle - low)


def _bound_mean(matrices: jax.Array, middle: jax.Array, reach: jax.Array) -> jax.Array:
    """Return a bound on sum_i p_i X_i for all laws p with |p_i - middle_i| <= reach_i, as a matrix.

    Since p - middle sums to 0, sum_i p_i X_i = sum_i middle_i X_i + sum_i (p_i - middle_i) (X_i - Xbar) with the mean
    Xbar of all X_i, and X <= |X|, which has the absolute eigenvalues of X. So the bound is
    sum_i middle_i X_i + sum_i reach_i |X_i - Xbar|. `matrices`: the symmetric X_i (M, s, s).
    """
    values, vectors = jax.vmap(eigh)(matrices - jnp.mean(matrices, axis=0))
    absolute = (vectors * jnp.abs(values)[:, None, :]) @ vectors.swapaxes(1, 2)
    return jnp.einsum("i,iab->ab", middle, matrices) + jnp.einsum("i,iab->ab", reach, absolute)


def _bound_diagonal(low: jax.Array, high: jax.Array) -> jax.Array:
    """Return a bound on diag(p) for all laws p of the modes with low <= p <= high, (M, M).

    p = middle + delta with |delta_i| <= reach_i, and the delta_i sum to 0. With u = (1, ..., 1) / sqrt(M), P = I - u u'
    and d = delta / sqrt(M),

        diag(p) = diag(middle) + P diag(delta) P + u d' + d u'

    Each term is bounded alone. The bound is tight in the direction u, in which all modes count alike.
    """
    modes = len(low)
    middle, reach = _find_middle_law(low, high)
    projection, total = jnp.eye(modes) - 1 / modes, jnp.sum(reach)
    # u d' + d u' <= e u u' + d d' / e by Young's inequality, with d d' <= P diag(reach) P sum(reach) / M by Cauchy and
    # Schwarz, and d = P d.
    e = total / modes / 2
    safe_e = jnp.where(e > 0, e, 1.0)
    cross_term = projection @ jnp.diag(reach * total) @ projection / (safe_e * modes)
    # P diag(delta) P <= P diag(reach) P, and for two modes it is 0.
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
    """Return the filter behind a channel whose modes have uncertain transition probabilities, with an upper bound.

    The covariance bounds the error's for all transition matrices within the given radius, "upper", if the laws of gain
    and noise in each mode are known; else it is "nominal". `linear_filter` has checked that the parts fit.
    """
    claim: Claim = "upper" if claim_of_modes(channel) == "exact" else "nominal"
    fields = fields_of_joint_modes(plant, sensor, channel, claim)
    return UncertainModalFilter(plant=plant, sensor=sensor, **fields)
