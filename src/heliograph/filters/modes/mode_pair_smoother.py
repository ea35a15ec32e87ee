"""Smoothing of filters of modes: by pairs of the mode before a step and that after it.

Of each later mode j the future says the ratio of the smoothed N(s_j, S_j) to what the filter had, N(q_j, Q_j). With
V' Q V = I, V' S V = diag(e) that is an observation, where e < 1: V'x = (V's - e V'q) / (1 - e) with noise e / (1 - e).
Each pair (i, j), the Gaussian of mode i moved by mode j, observes it; Rauch's step goes back to mode i, and the pairs'
probabilities P(i, j | all) ~ m_j mu_i T_ij times the likelihood of the observation merge them over j.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.covariance_factors import WeightedColumns, decorrelate, join_columns, unit_lower
from heliograph.factors.factored_gaussian import (
    Gaussian,
    from_columns,
    merge_mixture,
    moments_of_mixture,
    sum_unexplained,
)
from heliograph.factors.state_given_next import BackwardGain, condition_on_next_state, rts_step
from heliograph.filters.gaussian.gaussian_prediction import factor_process_noise, find_transition_moments
from heliograph.filters.gaussian.moment_transforms import AbstractTransform
from heliograph.filters.gaussian.signal_moments import condition_on_measurement
from heliograph.filters.modes.mixing import normalise_columns
from heliograph.filters.smoother_step import EarlierState, SmootherStep
from heliograph.filters.truncation import hold_mean_within_limits, truncate_to_limits
from heliograph.model.estimate import Estimate
from heliograph.model.plant import AbstractPlant
from heliograph.numerics.angles.angle import wrap_angles, wrap_near
from heliograph.numerics.check import fail
from heliograph.numerics.lapack import eigh
from heliograph.numerics.types import Float

NOTHING = 1e-9  # of the information of what the filter had: less is rounding
SINGULAR = 1e-12  # of a variance, given the components before it: it is known


class ModalLaw(NamedTuple):
    """Joint law of state and mode: the Gaussian of x in each of M modes, and the probabilities of the modes.

    Shapes: gaussian (M, n), law (M,).
    """

    gaussian: Gaussian
    law: Float[jax.Array, "*time M"]


class MovedPairs(NamedTuple):
    """The Gaussian of each mode i moved by the plant of each mode j, [i, j] (M, M, n), and the smoother gain back.

    The gain gives the law of x before the step given x after it.
    """

    gaussian: Gaussian
    back: BackwardGain


def move_pairs(
    plants: tuple[AbstractPlant, ...],
    plant_of: np.ndarray,
    transform: AbstractTransform,
    gaussians: Gaussian,
    u: jax.Array,
    initial_power: jax.Array,
) -> MovedPairs:
    """Return the Gaussian of each mode i moved by the plant of each mode j, [i, j], and the smoother gain back.

    A smoother of a plant that switches between modes needs each pair of successive modes: the law of the next state,
    and for the backward pass the law of the state given the next one.

    Args:
        plants: the different plants; several modes may share one.
        plant_of: [j], number in `plants` of the plant of mode j.
        transform: how moments pass through a nonlinear plant, such as by cubature.
        gaussians: the Gaussian of each mode (M, n).
        u: input.
        initial_power: E[x_i^2] before any data (n,); rounding is in proportion to it.
    """

    def move(plant: AbstractPlant, x: Gaussian) -> MovedPairs:
        """Move one Gaussian x by one plant: return the law of f(x, u) + w, and x given the next state.

        f(x, u) is described by its slopes in x and the covariance that they do not explain. `transform` gives these for
        a nonlinear f. u is the input. `initial_power` is E[x_i^2] at the start, for rounding.
        """
        # With x = m + L xi, the next state is mean + slopes xi + (what xi does not explain: error of f's linearisation
        # and noise).
        image = find_transition_moments(plant, transform, x, u)
        unexplained = sum_unexplained(image, factor_process_noise(plant, u, initial_power))
        mean = image.mean + plant.noise_mean()
        predicted = from_columns(mean, join_columns(image.explained, unexplained))
        return MovedPairs(predicted, condition_on_next_state(x, image.slopes, mean, unexplained))

    # Each Gaussian moved by each plant, [i, plant]; then for each mode j the one by its plant, [i, j].
    by_plant = [jax.vmap(lambda x, plant=plant: move(plant, x))(gaussians) for plant in plants]
    pairs: MovedPairs = jax.tree.map(lambda *leaves: jnp.stack(leaves, axis=1)[:, plant_of], *by_plant)
    return pairs


class PairSmootherTerms(NamedTuple):
    """What a smoother by pairs (mode i before, mode j after) needs of a step of M modes.

    What later data say of mode j is the ratio of its smoothed Gaussian to `reference`, the Gaussian of mode j without
    them: predicted, or filtered if pairs take z before they are merged. This ratio corrects the Gaussians of the pairs
    (i, j), `pairs` (M^2, n), of probabilities `weights` (M, M). `smoother_gains` take them back to mode i.
    """

    reference: Gaussian
    pairs: Gaussian
    weights: jax.Array
    smoother_gains: BackwardGain


class FutureObservation(NamedTuple):
    """What the future says of a mode's state: h x + noise = value, NaN where it says nothing.

    Shapes: rows h (n, n), value and noise (n,).
    """

    rows: jax.Array
    value: jax.Array
    noise: jax.Array


def divide_gaussians(later: Gaussian, known: Gaussian) -> FutureObservation:
    """Return the ratio of two densities N(x; s, S) / N(x; q, Q) as an observation that turns N(q, Q) into N(s, S).

    It is what the later data alone say of x, which a smoother can use with another N(q, Q). The columns of V make both
    covariances diagonal: V' Q V = I, V' S V = diag(e). Component by component, where e < 1, the observation is V'x +
    noise = (V's - e V'q) / (1 - e), its noise of variance e / (1 - e). Rows are multiplied by sqrt(1 - e), so that no
    noise is infinite: its variance is then e.

    Args:
        later: N(s, S), what is known with later data.
        known: N(q, Q), what is known without the later data.
    """
    # Q = L diag(d) L' by `known.root` and `known.variances`. W = diag(d)^-1/2 L^-1 has W Q W' = I, but for rows of
    # zeros where d_j is 0 to rounding, as `known` has such a component exactly given those before it.
    variances = jnp.sum(known.root**2 * known.variances, axis=1)  # Q_jj
    varies = known.variances > SINGULAR * variances
    scale = jnp.where(varies, 1 / jnp.sqrt(jnp.where(varies, known.variances, 1.0)), 0.0)
    n, lower = len(known.mean), unit_lower(known.lower)
    whitening = scale[:, None] * decorrelate(lower, jnp.eye(n))
    # W S W' = T diag(e) T' and V' = T' W. What is known exactly gets e = 1: later data add no information.
    root = whitening @ later.root
    e, T = eigh((root * later.variances) @ root.T + jnp.diag(jnp.where(varies, 0.0, 1.0)))
    information = 1 - jnp.maximum(e, 0.0)  # what later data add, as a share of what is known with them
    is_informative = information > NOTHING
    # sqrt(1 - e) (V's - e V'q) / (1 - e) = sqrt(1 - e) V'q + V'(s - q) / sqrt(1 - e).
    scaling = jnp.sqrt(jnp.where(is_informative, information, 1.0))  # sqrt(1 - e)
    V_transposed = T.T @ whitening
    rows = scaling[:, None] * V_transposed
    value = rows @ known.mean + V_transposed @ (later.mean - known.mean) / scaling
    return FutureObservation(
        rows=rows,
        value=jnp.where(is_informative, value, jnp.nan),  # NaN: no observation
        noise=jnp.where(is_informative, jnp.maximum(e, 0.0), 1.0),
    )


class ModalSmootherStep(SmootherStep):
    """Smoother step of a filter of modes: the Gaussian of each pair of modes, and the whole mixture as one Gaussian.

    law: Gaussian and probability of each mode j after the step. known: the Gaussian of each mode j that a smoothed one
    is divided by (M, n), to find what later data say. pairs: for mode i before and mode j after the step a Gaussian
    [i, j], (M, M, n), with its probability in `weights` (M, M), and the smoother gain back to mode i in `ways`.

    The pass back keeps a Gaussian for each mode. Smoothing of a fixed point, and draws of paths, use the whole mixture
    as one Gaussian; they need one plant for all modes.
    """

    law: ModalLaw = eqx.field(kw_only=True)
    known: Gaussian = eqx.field(kw_only=True)
    pairs: Gaussian = eqx.field(kw_only=True)
    weights: Float[jax.Array, "*time M M"] = eqx.field(kw_only=True)
    ways: BackwardGain = eqx.field(kw_only=True)

    @property
    def end(self) -> ModalLaw:
        """Gaussians and probabilities of the modes after the step: where a pass back over the data starts."""
        return self.law

    def back(self, later: ModalLaw) -> ModalLaw:  # type: ignore[override]
        """Return mode probabilities and Gaussians before the step, given all data, from those after it given all data.

        A filter of modes has a Gaussian of the state in each mode of a Markov chain. Smoothing goes back step by step.
        Indices [i, j] are mode i before the step and mode j after it: `pairs` are the Gaussians of mode i moved by mode
        j, `ways` their smoother gains back, `weights` their probabilities P(i, j). What later data say of the state in
        mode j is the ratio of its smoothed Gaussian `later` to the filter's one, `known`. This ratio acts as an
        observation of each pair (i, j).
        """
        # The ratio of the Gaussians as an observation, with angles of `later` within half a turn of those of `known`.
        near = wrap_near(later.gaussian.mean, self.known.mean, self.angles)
        observations = jax.vmap(divide_gaussians)(later.gaussian._replace(mean=near), self.known)

        def observe(x: Gaussian, observed: FutureObservation) -> tuple[Gaussian, jax.Array]:
            """Condition the Gaussian x of one pair (mode, next mode) on later data; return it and the log-likelihood.

            Later data act like a measurement value = rows x + noise with uncorrelated noises, NaN where they say
            nothing.
            """
            noise = WeightedColumns(jnp.eye(len(x.mean)), observed.noise)
            expected, slopes = observed.rows @ x.mean, observed.rows @ x.root
            corrected, innovation = condition_on_measurement(x, slopes, noise, observed.value, expected)
            return corrected, jnp.asarray(innovation.log_likelihood)

        corrected, log_likelihood = jax.vmap(jax.vmap(observe), in_axes=(0, None))(self.pairs, observations)
        # P(i, j | all data) = P(j | all data) P(i | j, all data), where P(i | j, all data) is proportional to P(i, j)
        # times the likelihood of the observation.
        possible = self.weights > 0
        log_weight = jnp.where(possible, jnp.log(jnp.where(possible, self.weights, 1.0)) + log_likelihood, -jnp.inf)
        # Subtract the largest logarithm of each j before exp, so that not all weights of j underflow to 0.
        largest = jnp.max(log_weight, axis=0)
        weight = jnp.where(possible, jnp.exp(log_weight - jnp.where(jnp.isfinite(largest), largest, 0.0)), 0.0)
        total = jnp.sum(weight, axis=0)
        joint = later.law * weight / jnp.where(total > 0, total, 1.0)
        # Rauch's step takes each pair (i, j) back to mode i. Then the pairs of mode i are merged.
        smoothed = jax.vmap(jax.vmap(rts_step))(self.ways, corrected)
        merged = jax.vmap(merge_mixture)(smoothed, normalise_columns(joint.T).T)
        law = jnp.sum(joint, axis=1)
        return ModalLaw(merged, law / jnp.sum(law))

    def estimate_from(self, law: "ModalLaw | Gaussian") -> Estimate:
        """Return the estimate of the plant's state, with the modes' probabilities where these are smoothed.

        `law`: a Gaussian of the whole mixture, or one for each mode with its probability. `limits`: of states, within
        which it is cut.
        """
        if isinstance(law, Gaussian):
            return super().estimate_from(law)
        gaussians = law.gaussian
        if self.limits:
            within_limits = jax.vmap(lambda x: hold_mean_within_limits(x, self.limits))(gaussians)
            log_mass, gaussians = truncate_to_limits(within_limits, self.limits)
            weight = law.law * jnp.exp(log_mass - jnp.max(log_mass))
            law = ModalLaw(gaussians, weight / jnp.sum(weight))
        # Angles of all modes within half a turn of those of the likeliest.
        mean = wrap_near(gaussians.mean, gaussians.mean[jnp.argmax(law.law)], self.angles)
        covariances = jax.vmap(lambda x: x.covariance)(gaussians)
        mean, covariance = moments_of_mixture(mean, covariances, law.law)
        return Estimate(wrap_angles(mean, self.angles), covariance, self.claim, law.law)

    def start(self) -> EarlierState:
        """Return the state after this step as an earlier state, whose law is then carried from step to step."""
        # With several plants no single function moves the whole mixture, and `before` is None.
        if self.before is None:
            raise fail("smoothing of plants with modes", "FixedInterval or FixedLag", "a fixed point")
        return super().start()
