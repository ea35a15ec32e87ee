"""Filter for laws of finite support: every combination of gains and noises, then one Gaussian by moment matching."""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.factors.covariance_factors import WeightedColumns, factor_covariances, join_columns, rounding_of
from heliograph.factors.factored_gaussian import (
    Gaussian,
    condition_on_observation,
    from_covariance,
    merge_mixture,
    predict_affine,
)
from heliograph.factors.pivots import square_root
from heliograph.filters.base import (
    AbstractSizedFilter,
    FilterAngles,
    Step,
    corrects,
    estimates,
    make_sizes,
    predicts,
)
from heliograph.filters.gaussian.gaussian_prediction import factor_process_noise, second_moments_at_start
from heliograph.filters.innovation import mixed_innovation, posterior_weights
from heliograph.filters.smoother_step import SmootherStep, StepTrace, smoother_step_of
from heliograph.filters.wrappers.accepted_models import accept_limits, accept_told_numbers
from heliograph.model.assumed.assumed_model import believes
from heliograph.model.channel import Channel, check_link, find_received_angles
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.over_time import OverTime, at, first, list_models_by_step, steps_covered, vary_over_steps
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor, LinearSensor, is_linear
from heliograph.numerics.angles.angle import Angles, wrap_angles, wrap_near
from heliograph.numerics.check import fail, scalar
from heliograph.numerics.module import Module
from heliograph.numerics.numpy_or_jax import is_traced, stack_parts
from heliograph.numerics.trace_settings import write_for_derivatives
from heliograph.numerics.types import Array, ArrayLike, Bool, Float, Int
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.hop import GainAndNoise
from heliograph.random_affine.laws.law import Constant
from heliograph.random_affine.memories_of_channels import memories
from heliograph.random_affine.modes import JointModes, joint_modes
from heliograph.random_affine.moments.mixture_components import COMPONENT_LIMIT
from heliograph.random_affine.series_and_stack import Series


class AtomCombinations(Module):
    """All combinations of values of gains and noises of finite support at one step, each with its mode of the links.

    In combination a, z = gain_a x + offset_a + N(0, noise_a). weight: P(combination | mode). transition: of the modes
    from the step before; a single mode for links without memory.

    Shapes: weight, mode (a,), gain (a, m, n), offset (a, m), noise (a, m, m) columns, transition (M, M).
    """

    weight: Array
    gain: Array
    offset: Array
    noise: WeightedColumns
    mode: np.ndarray
    transition: Array


class MixtureBelief(NamedTuple):
    """One Gaussian for the state (n,), and the modes' probabilities (M,). `moved`: from the first prediction on."""

    gaussian: Gaussian
    law: Float[jax.Array, " M"]
    moved: Bool[jax.Array, ""]


class _CombinationUpdate(NamedTuple):
    """Update by one combination: the state after it, log-likelihood, innovation z - E z, and covariance of z.

    `certain` counts components of z that arrived and that the combination determines.
    """

    posterior: Gaussian
    log_likelihood: jax.Array
    certain: jax.Array
    value: jax.Array
    covariance: jax.Array


class MixtureFilter(AbstractSizedFilter):
    """One Gaussian for the state; at each step every combination of the measurement's atoms, then moment matching.

    With z = G_a x + c_a + N(0, R_a) and probability p_a, the posterior is a mixture of as many Gaussians with weights
    p_a N(z; G_a m + c_a, G_a P G_a' + R_a), replaced by its mean and covariance (GPB1). Behind links with memory p_a is
    the mode's probability times that of the combination in it; the modes' probabilities are propagated, but not the
    correlation of state and mode. Nominal: after the first step the prior is not Gaussian, and process noise enters by
    its covariance only. The log-likelihood is that of the mixture, log sum_a p_a N(z; ...), as is the innovation
    covariance. A value that no combination can produce is not used: its log-likelihood is -inf, the state stays.

    Source: Ackerson and Fu, On state estimation in switching environments (1970), with random gains as modes.
    """

    plant: AnyPlant
    components: AtomCombinations | OverTime
    initial: Float[Array, " M"]
    observed_angles: Angles = eqx.field(static=True)

    def angles_used(self) -> FilterAngles:
        """Return the indices of states that are angles, and of components of z that are."""
        return FilterAngles(first(self.plant).angles, self.observed_angles)

    @property
    def of_atoms(self) -> bool:
        """True: z has a mixture law over finitely many gains and noises, so likelihood 0 says that it is impossible."""
        return True

    @compile_on_call
    def init(self) -> MixtureBelief:
        """Return the prior and the initial law of the modes; `moved` is False until a step is predicted."""
        start = at(self.plant, k=0)
        prior = from_covariance(start.initial_mean, start.initial_covariance)
        return MixtureBelief(gaussian=prior, law=jnp.asarray(self.initial), moved=jnp.asarray(False))

    @predicts
    def predict(self, state: MixtureBelief, u: ArrayLike = (), k: Step = 0) -> MixtureBelief:
        """Return the mean A m + B u + E w and the covariance A P A' + Q, and the modes' law after a transition.

        At the first prediction the modes keep their initial law.
        """
        plant, u = at(self.plant, k), jnp.asarray(u)
        noise = factor_process_noise(plant, u, second_moments_at_start(self.plant))
        predicted = predict_affine(state.gaussian, plant.transition_matrix(u), plant.shift(u), noise)
        law = jnp.where(state.moved, state.law @ jnp.asarray(at(self.components, k).transition), state.law)
        return MixtureBelief(gaussian=predicted, law=law, moved=jnp.asarray(True))

    @corrects
    def correct(self, state: MixtureBelief, z: ArrayLike, k: Step = 0) -> tuple[MixtureBelief, Innovation]:
        """Correct with z: one Kalman update per combination, weighted by its likelihood, then moment matching.

        A combination is one choice of the values of all gains and noises of finite support: it is a gain, an offset and
        a Gaussian noise. The state holds the law of the links' modes and one Gaussian of x, which after the correction
        has the mean and covariance of the mixture of all updates (moment matching).
        """
        combinations, z, x = at(self.components, k), jnp.asarray(z), state.gaussian
        # P(combination) = P(mode) P(combination | mode).
        prior = state.law[combinations.mode] * jnp.asarray(combinations.weight)
        size = square_root(second_moments_at_start(self.plant))  # of the states, for the rounding of gain @ x
        present = ~jnp.isnan(z)

        def condition_on_combination(gain: jax.Array, offset: jax.Array, noise: WeightedColumns) -> _CombinationUpdate:
            """Return the Kalman update by z = gain x + offset + noise.

            x is the predicted Gaussian. `certain` is the number of components of z that the combination determines
            exactly.
            """
            slopes, value = gain @ x.root, wrap_angles(z - gain @ x.mean - offset, self.observed_angles)
            noise = join_columns(noise, rounding_of((jnp.abs(gain) @ size) ** 2))
            posterior, innovations = condition_on_observation(x, slopes, value, noise, present)
            log_likelihood = innovations.log_density(present, jnp.abs(z) + jnp.abs(z - value))
            covariance = join_columns(WeightedColumns(slopes, x.variances), noise).covariance
            certain = jnp.sum(present & innovations.determined)
            return _CombinationUpdate(posterior, log_likelihood, certain, value=value, covariance=covariance)

        updates = jax.vmap(condition_on_combination)(combinations.gain, combinations.offset, combinations.noise)
        # Posterior weights prior * likelihood. A combination that determines more of z exactly has an infinitely larger
        # density, so that only those with the most count. `excluded`: none can produce z, and the state stays.
        log_likelihood = drop_below_point_mass(updates.log_likelihood, updates.certain)
        weight, density, excluded = posterior_weights(prior, log_likelihood)
        # Innovation of the mixture, angles near that of the most probable combination.
        value = wrap_near(updates.value, updates.value[jnp.argmax(prior)], self.observed_angles)
        covariance = jnp.where(present[:, None] & present, updates.covariance, jnp.nan)
        innovation = mixed_innovation(prior, value, covariance, density)
        # The probability of a mode is that of all its combinations.
        law = weight @ (combinations.mode[:, None] == jnp.arange(len(state.law)))
        updated = MixtureBelief(gaussian=merge_mixture(updates.posterior, weight), law=law, moved=state.moved)
        return jax.tree.map(lambda old, new: jnp.where(excluded, old, new), state, updated), innovation

    @estimates
    def estimate(self, state: MixtureBelief) -> Estimate:
        """Return the mean and covariance of x given the data, with angles between -pi and pi."""
        x = state.gaussian
        return Estimate(wrap_angles(x.mean, first(self.plant).angles), x.covariance, self.claim)

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return the smoother step of x+ = A x + b + w, of the one Gaussian before and after.

        The mixture was merged to one Gaussian, so that the claim is nominal.
        """
        plant, u = at(self.plant, step.k), jnp.asarray(step.u)
        slopes = plant.transition_matrix(u) @ step.before.gaussian.root
        noise = factor_process_noise(plant, u, second_moments_at_start(self.plant))
        return smoother_step_of(step, (slopes, noise), "nominal", plant.manifold)


def drop_below_point_mass(log_likelihood: Float[Array, " a"], certain: Int[Array, " a"]) -> Float[Array, " a"]:
    """Return the log-likelihoods, with -inf for combinations of gains and noises that others outweigh by a point mass.

    `certain` (a,) counts the components that each combination determines exactly. It has a point mass there, against
    which a density is negligible. So only combinations with the largest count among those that agree with z are kept.
    """
    agrees = jnp.isfinite(log_likelihood)
    # -1: no combination agrees with z.
    largest_count = jnp.max(jnp.where(agrees, certain, -1))
    return jnp.where(agrees & (certain < largest_count), -jnp.inf, log_likelihood)


@accept_limits
@believes
@accept_told_numbers
def mixture_filter(plant: AnyPlant, sensor: AnySensor, channel: Channel, resolution: float = 0.0) -> MixtureFilter:
    """Return the filter on the full laws of gains and noises of finitely many values, with one Gaussian a step.

    Gains may be constant or discrete, noises of finite support (used atom by atom) or Gaussian. Behind links with
    memory it propagates the modes' probabilities, with one Gaussian for all; `imm_filter` and `gpb2_filter` have one
    per mode. Behind slow fading its claim is too small.

    Args:
        plant: a linear plant, n states.
        sensor: a linear sensor, m outputs.
        channel: from the sensor to the filter.
        resolution: standard deviation of a noise added to z, 0 by default, for a z that does not follow the model to
            the last digit. A combination of atoms that leaves z without randomness, as a link that is off does, counts
            where z agrees with it to this resolution, and only there.

    Claim: "nominal". With next to no noise in plant and link the one Gaussian after each step may leave out the true
        mode: squared errors were 1e11 times the claim.

    Raises:
        ValueError: a plant or sensor that is not linear, a gain that drifts, parts that do not fit, a law with no
            atoms, more than COMPONENT_LIMIT combinations.

    Source: Ackerson and Fu (1970), first-order generalised pseudo-Bayes.
    """
    if not is_linear(plant, sensor):
        got = f"{type(first(plant)).__name__} and {type(first(sensor)).__name__}"
        raise fail("mixture filter", "a LinearPlant and a LinearSensor", got)
    check_link(first(sensor), first(channel), len(first(plant).states))
    # All combinations of atoms, mode by mode, for each step where they vary; one step stands for all where none do.
    added_variance = float(scalar("resolution", resolution, low=0.0, high=1e100)) ** 2
    steps = steps_covered((sensor, channel)) or 1
    modes = [_joint_modes_of(channel_of_step) for channel_of_step in list_models_by_step(channel, steps)]
    modes_before = [modes[0], *modes[:-1]]
    combinations = [
        _list_combinations(sensor_of_step, present, previous, added_variance)
        for sensor_of_step, present, previous in zip(
            list_models_by_step(sensor, steps), modes, modes_before, strict=True
        )
    ]
    return MixtureFilter(
        plant=plant,
        components=vary_over_steps(combinations, sensor, channel),
        initial=modes[0].initial,
        observed_angles=find_received_angles(plant, sensor, channel),
        **make_sizes("nominal", first(plant), first(channel).outputs),
    )


def _joint_modes_of(channel: AbstractRandomAffine) -> JointModes:
    """Return the modes of all links with memory as one Markov chain, with the links' law in each joint mode.

    Raises:
        ValueError: a gain that drifts continuously, which has no finite number of values.
    """
    if any(memory.drifts for memory in memories(channel).values()):
        raise fail("mixture filter", "gains of finitely many values", "one that drifts")
    return joint_modes(channel)


def _list_combinations(
    sensor: AnySensor, modes: JointModes, modes_before: JointModes, added_variance: float
) -> AtomCombinations:
    """Return all combinations of values of the gains and noises of z = G (C x + v) + n at one step, mode after mode.

    Gains and noises have finite support, or noises are mixtures of finitely many Gaussians. An atom is one combination:
    z = gain x + offset + noise with a Gaussian noise, and a weight, its probability in the mode.

    Args:
        sensor: C and v.
        modes: the links' modes, each with its law of G and n.
        modes_before: modes of the step before, which hold the transition to this step.
        added_variance: variance that is added to each component of each noise.

    Raises:
        ValueError: more than COMPONENT_LIMIT combinations.
    """
    assert isinstance(sensor, LinearSensor)  # checked before
    # In each mode the atoms of sensor and link in series; those of probability 0 are left out where it is known.
    sensed = GainAndNoise(Constant(1.0), sensor.matrix, sensor.noise)
    atoms, mode_of_atom = [], []
    for mode, link in enumerate(modes.maps):
        for atom in Series([sensed, link]).list_atoms():
            if is_traced(atom.weight) or atom.weight > 0:
                atoms.append(atom)
                mode_of_atom.append(mode)
    if len(atoms) > COMPONENT_LIMIT:
        raise fail("mixture filter", f"at most {COMPONENT_LIMIT:,} combinations of atoms", f"{len(atoms):,}")
    weight, gain, offset, noise = (stack_parts(column) for column in zip(*atoms, strict=True))
    with write_for_derivatives():  # of a traced noise
        columns = factor_covariances(noise + added_variance * np.eye(noise.shape[-1]))
    return AtomCombinations(
        weight=weight,
        gain=gain,
        offset=offset,
        noise=columns,
        mode=np.array(mode_of_atom),
        transition=modes_before.transition,
    )
