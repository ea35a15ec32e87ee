"""Rao-Blackwellised particle filter: particles for the modes of links with memory, each with a Gaussian state."""

from collections.abc import Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from typing_extensions import TypeAliasType

from heliograph.engine.choice import compile_on_call
from heliograph.factors.factored_gaussian import Gaussian, from_covariance, moments_of_mixture
from heliograph.filters.base import (
    AbstractSizedFilter,
    FilterAngles,
    Step,
    corrects,
    estimates,
    predicts,
)
from heliograph.filters.gaussian.gaussian_prediction import predict_gaussian, second_moments_at_start
from heliograph.filters.gaussian.moment_transforms import AbstractTransform
from heliograph.filters.gaussian.signal_moments import find_signal_moments
from heliograph.filters.modes.arrival_patterns import ChannelByPattern
from heliograph.filters.modes.correction_by_mode import correct_in_every_mode
from heliograph.filters.modes.mixing import align_angles, replicate
from heliograph.filters.modes.models_by_mode import fields_of_mode_filters
from heliograph.filters.particles.factory import build_partly_drawn
from heliograph.filters.particles.rao_blackwellised import PartlyDrawnFilter
from heliograph.filters.particles.resampling import (
    effective_number,
    fold_in_bits,
    invert_distribution,
    resample_systematically,
)
from heliograph.filters.particles.state_particles import MANY, StateParticleFilter, build_state_particles
from heliograph.filters.wrappers.accepted_models import accept_limits
from heliograph.model.assumed.assumed_model import believes
from heliograph.model.channel import Channel
from heliograph.model.estimate import Estimate, Innovation
from heliograph.model.markov_jump_models import ModalPlant, ModalSensor
from heliograph.model.over_time import OverTime, at, first
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor
from heliograph.numerics.angles.angle import Angles, wrap_angles
from heliograph.numerics.check import check_count
from heliograph.numerics.types import Array, ArrayLike, Bool, Float, Int
from heliograph.random_affine.memories_of_channels import memories

FEW = 300  # particles of modes
NODES = 9  # modes that stand for a gain that drifts: they cost no more than few


class Particles(NamedTuple):
    """Gaussian, present mode and weight of each particle, and the key of the next random numbers.

    Shapes: the Gaussians (N, n), mode (N,), weight (N,), key (2,). `moved` is true from the first prediction on.
    """

    gaussian: Gaussian
    mode: Int[jax.Array, " N"]
    weight: Float[jax.Array, " N"]
    key: Int[jax.Array, " 2"]
    moved: Bool[jax.Array, ""]

    @property
    def components(self) -> tuple[jax.Array, Gaussian]:
        """The mixture: weights (N,), and the Gaussian of each particle."""
        return self.weight, self.gaussian


class ParticleFilter(AbstractSizedFilter):
    """Particles draw the modes; given their path the state is Gaussian (Rao-Blackwell). Built by `particle_filter`.

    Its random numbers come from the seed and from the data, so that runs draw independently and the same data give the
    same estimate.
    """

    plant: AnyPlant
    sensor: AnySensor
    channel: ChannelByPattern | OverTime
    initial: Float[Array, " M"]
    transform: AbstractTransform
    observed_angles: Angles = eqx.field(static=True)
    plant_modes: tuple[int, ...] = eqx.field(static=True)
    sensor_modes: tuple[int, ...] = eqx.field(static=True)
    particles: int = eqx.field(static=True)
    seed: Int[Array, ""]  # a number, so that filters of all seeds are one program

    def angles_used(self) -> FilterAngles:
        """Return the indices of states that are angles, and of components of z that are."""
        return FilterAngles(first(self.plant).angles, self.observed_angles)

    @compile_on_call
    def init(self) -> Particles:
        """Return the prior in every particle, with modes in proportion to their initial law.

        Particle i of n has the mode at which the distribution function of the law passes (i + 1/2) / n. `moved` is
        False until a step is predicted: the first prediction draws no new modes, since these are those of the first
        step.
        """
        start, n = at(self.plant, k=0), self.particles
        gaussians = replicate(from_covariance(start.initial_mean, start.initial_covariance), n)
        mode = invert_distribution(jnp.asarray(self.initial), (jnp.arange(n) + 0.5) / n)
        return Particles(
            gaussian=gaussians,
            mode=mode,
            weight=jnp.full(n, 1 / n),
            key=jax.random.PRNGKey(self.seed),
            moved=jnp.asarray(False),
        )

    @predicts
    def predict(self, state: Particles, u: ArrayLike = (), k: Step = 0) -> Particles:
        """Draw each particle's next mode, and predict its Gaussian.

        The next mode is drawn from the row of the transition matrix that belongs to the present mode. At the first step
        the particles keep the modes of the start.
        """
        plant, u = at(self.plant, k), jnp.asarray(u)
        key = jax.random.fold_in(state.key, 0)
        transition = jnp.asarray(at(self.channel, k).transition)[state.mode]
        uniform = jax.random.uniform(key, state.weight.shape, state.weight.dtype)
        drawn_mode = jax.vmap(invert_distribution)(transition, uniform)
        initial_power = second_moments_at_start(self.plant)
        gaussians = jax.vmap(lambda x: predict_gaussian(plant, self.transform, x, u, initial_power))(state.gaussian)
        mode = jnp.where(state.moved, drawn_mode, state.mode)
        gaussians = gaussians._replace(mean=align_angles(plant, gaussians.mean, state.weight))
        return Particles(gaussian=gaussians, mode=mode, weight=state.weight, key=key, moved=jnp.asarray(True))

    @corrects
    def correct(self, state: Particles, z: ArrayLike, k: Step = 0) -> tuple[Particles, Innovation]:
        """Correct each particle with z, weight it by its likelihood, and resample if too few particles have weight.

        A particle is a mode of the link (what it remembers, such as good or bad) with a Gaussian of the plant's state
        in that mode. Too few: the effective number 1 / sum w_i^2 is below half the number of particles.

        `state` holds the particles predicted to step k, and z (received,) is the measurement, NaN where none arrived.
        Returned with the particles: the innovation of their mixture.
        """
        # The models as they are at step k, and the moments of the signal y = h(x) for each particle's Gaussian.
        (plant, sensor, channel), z = at((self.plant, self.sensor, self.channel), k), jnp.asarray(z)
        initial_power = second_moments_at_start(self.plant)
        signals = jax.vmap(lambda x: find_signal_moments(plant, sensor, self.transform, x, initial_power))(
            state.gaussian
        )
        # Each particle is corrected in its own mode: w_i becomes proportional to w_i p(z | mode_i, Gaussian_i).
        corrected, weight, innovation = correct_in_every_mode(
            signal=signals,
            channel=channel,
            mode=state.mode,
            weight=state.weight,
            z=z,
            angles=self.observed_angles,
        )
        corrected = corrected._replace(mean=align_angles(plant, corrected.mean, weight))
        # Systematic resampling: one uniform number places as many equidistant points on the cumulated weights. The data
        # are folded into the key, so a step draws anew without a counter. All particles weigh the same afterwards.
        key = fold_in_bits(state.key, z)
        resampled = resample_systematically(weight, jax.random.uniform(key, (), weight.dtype))
        too_few = effective_number(weight) < self.particles / 2
        indices = jnp.where(too_few, resampled, jnp.arange(self.particles))
        weight = jnp.where(too_few, 1 / self.particles, weight)
        chosen: Gaussian = jax.tree.map(lambda leaf: leaf[indices], corrected)
        particles = Particles(chosen, mode=state.mode[indices], weight=weight, key=key, moved=state.moved)
        return particles, innovation

    @estimates
    def estimate(self, state: Particles) -> Estimate:
        """Return the mean and covariance of the whole mixture, angles between -pi and pi."""
        mean, covariance = moments_of_mixture(state.gaussian.mean, state.gaussian.covariance, state.weight)
        return Estimate(wrap_angles(mean, first(self.plant).angles), covariance, self.claim)


AnyParticleFilter = TypeAliasType("AnyParticleFilter", ParticleFilter | PartlyDrawnFilter | StateParticleFilter)


@accept_limits
@believes
def particle_filter(
    plant: "AnyPlant",
    sensor: "AnySensor",
    channel: "Channel",
    particles: int | None = None,
    seed: int = 0,
    transform: "AbstractTransform | None" = None,
    nodes: int = NODES,
    proposal: str = "optimal",
    resample: float = 0.5,
    drawn: "Sequence[str] | None" = None,
) -> "AnyParticleFilter":
    """Return a particle filter: of the state, of named states, or of the modes of links with memory (Rao-Blackwell).

    What each of the N particles draws:

    - the state, for any plant, and any sensor and link without memory whose noise has a density. x_i is drawn from a
      proposal q, and its weight multiplied by p(z | x_i) p(x_i | before) / q(x_i);
    - the states named `drawn`. Given these (and a mode) the others are Gaussian, exactly, and the particle carries
      their Kalman filter; p is then the density with the others integrated out;
    - the joint mode too, of a `markov_plant`, a `markov_sensor` and links with them, from its law given z;
    - of links with memory alone a path of modes; the particle carries the Gaussian filter of that path.

    Particles are resampled systematically where the effective number 1 / sum w_i^2 is below a share of N; where states
    are drawn at the start of the next step, so that an estimate has all weights. A row that no particle can explain is
    not used: its log-likelihood is -inf. The error of the mixture's moments is in proportion to 1 / root of N.

    Args:
        plant: the plant, n states.
        sensor: its sensor, m outputs.
        channel: from the sensor to the filter.
        particles: their number; by default 1,000 of the state, 300 of modes.
        seed: of the random numbers, which depend on the data too; 0 by default.
        transform: of modes: moments of a nonlinear function; `Cubature()` by default, not used for linear parts.
        nodes: of modes: number of modes that stand for a gain that drifts; 9 by default.
        proposal: of the state: "optimal", by default, draws the noise given z, to first order in h, a tenth of the
            particles without z where h is not linear or the gain random; "prior" draws it without z, and takes any
            law of the process noise.
        resample: of the state: share of N below which the effective number leads to resampling; 0.5 by default.
        drawn: names of the states that are drawn, such as a heading; given them plant and sensor must be linear in
            the others, angles drawn, and noises Gaussian. [] draws modes alone. By default all are drawn, and of
            links' modes alone none.

    Claim: "nominal": with finitely many particles it approaches the truth from either side.

    Raises:
        ValueError: a count of particles below 1; as for `imm_filter`; of the state also a received number without
            noise, gains that are not of finitely many values, a sensor that depends on inputs; with `drawn` also a
            plant or sensor that is not seen to be linear given these states.

    Source: Doucet, Gordon and Krishnamurthy, Particle filters for state estimation of jump Markov linear systems,
        2001; Gordon, Salmond and Smith (1993) and Doucet, Godsill and Andrieu (2000) of the state; Schoen, Gustafsson
        and Nordlund, Marginalized particle filters for mixed linear/nonlinear state-space models (2005).
    """
    # With named states, or modes of plant or sensor: modes and named states are drawn.
    has_modes = isinstance(plant, ModalPlant) or isinstance(sensor, ModalSensor)
    if drawn is not None or has_modes:
        count = MANY if particles is None else particles
        return build_partly_drawn(plant, sensor, channel, count, seed, proposal, resample, drawn, nodes)
    # Without memory in the link: the whole state is drawn.
    if not memories(channel):
        count = MANY if particles is None else particles
        return build_state_particles(plant, sensor, channel, count, seed, proposal, resample)
    # Else the modes of links are drawn, and each particle has a Gaussian of the state.
    return ParticleFilter(
        particles=check_count("particles", FEW if particles is None else particles),
        seed=np.asarray(check_count("seed", seed, least=0)),
        **fields_of_mode_filters(plant, sensor, channel, transform, nodes),
    )
