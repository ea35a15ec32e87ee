"""Draw particles with the measurement: by the law of the noise given it, a tenth by the prior; and weigh them.

Notation: x+ = m + G e, e ~ N(0, I), and z = M (h(m) + H G e) + c + r, r ~ N(0, R), to first order: m the `center`, G
the `root` of the process noise, H the sensor's slopes, M the link's mean gain. G may be singular, R is regular.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp

from heliograph.factors.covariance_factors import WeightedColumns, columns_of
from heliograph.filters.particles.received_density import ReceivedAtoms
from heliograph.filters.particles.resampling import draw_uniforms
from heliograph.model.plant import AbstractPlant
from heliograph.model.sensor import AbstractSensor, LinearSensor
from heliograph.numerics.angles.angle import Angles, wrap_near
from heliograph.random_affine.noises.noise import AbstractNoise

PRIOR_SHARE = 0.1  # of the proposal: weights are then bounded, where h saturates too


class MoveLaw(NamedTuple):
    """Law of x+ before the measurement, of each particle: m + G e with e ~ N(0, I), and a draw of e.

    Shapes: center m (N, n), root G (n, n), the same of all particles, zero once x+ was drawn with a measurement; draws
    (N, n), of which the prior's positions and those that know z are made.
    """

    center: jax.Array
    root: jax.Array
    draws: jax.Array


class ProposedParticles(NamedTuple):
    """Positions (N, n) drawn with the measurement; corrections of the log weights, log N(e; 0, I) / q(e) (N,)."""

    position: jax.Array
    correction: jax.Array


def propose_particles(
    moved: MoveLaw,
    sensor: AbstractSensor,
    atoms: ReceivedAtoms,
    z: jax.Array,
    angles: Angles,
    key: jax.Array,
    numbers: jax.Array | None,
    particles: int,
) -> ProposedParticles:
    """Draw x = m + G e of each particle, e from its law q given z, and weigh it for not being drawn from N(0, I).

    To first order z = M (h(m) + H G e) + c + N(0, R), with the mean gain M and slopes H of h. So
    q = N(C' S^-1 r, I - C' S^-1 C), with C = M H G, S = C C' + R and r = z - E z; its covariance is also
    (I + C' R^-1 C)^-1. If the sensor is not linear, or the noise is a mixture of several Gaussians (atoms), e is drawn
    from N(0, I) with probability PRIOR_SHARE, which bounds the weights.

    Args:
        moved: center m (N, n) and root G (n, n) of each particle's law before z, and standard normal draws (N, n).
        sensor: h, with slopes H.
        atoms: of z given h(x), of which the mean gain M and the noise's covariance R are used.
        z: measurement (m,), NaN for what did not arrive.
        angles: components of z that are angles.
        key: of the choice between prior and q.
        numbers: of the particles; None for all of them at once.
        particles: how many there are in all.

    Returns:
        States, and log N(e; 0, I) - log q(e) of each.
    """
    is_exact = isinstance(sensor, LinearSensor) and len(atoms.weight) == 1
    prior_share = 0.0 if is_exact else PRIOR_SHARE
    gain, offset, noise = atoms.moments()
    arrived = ~jnp.isnan(z)
    noise = jnp.where(arrived[:, None] & arrived, noise, jnp.eye(len(z)))
    drawn = draw_uniforms(key, numbers, 1, particles)[:, 0]
    from_prior = jnp.zeros(len(drawn), bool) if is_exact else drawn < prior_share

    def propose_one(center: jax.Array, draw: jax.Array, from_prior: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return the position center + G e of one particle, and log N(e; 0, I) - log q(e).

        `draw` (n,) is standard normal. It is e itself if the particle is drawn `from_prior`, else e is made of it by q.
        """
        # C = M H G, and r = z - M h(m) - c.
        slope = jnp.asarray(sensor.matrix) if isinstance(sensor, LinearSensor) else jax.jacfwd(sensor.measure)(center)
        columns = jnp.where(arrived[:, None], gain @ slope @ moved.root, 0.0)
        innovation = wrap_near(z - gain @ sensor.measure(center) - offset, jnp.zeros(len(z)), angles)
        # The law of e given z, N(mean, (L L')^-1), by its precision L L' = I + C' R^-1 C, and a draw of it.
        scaled = jnp.linalg.solve(noise, columns)
        lower = jnp.linalg.cholesky(jnp.eye(len(center)) + columns.T @ scaled)
        # As matrices rather than solves for each particle: of a linear sensor they are the same for all particles.
        kalman_gain = jax.scipy.linalg.cho_solve((lower, True), scaled.T)
        factor = jax.scipy.linalg.solve_triangular(lower.T, jnp.eye(len(center)), lower=False)
        mean = kalman_gain @ jnp.where(arrived, innovation, 0.0)
        from_posterior = mean + factor @ draw
        e = jnp.where(from_prior | ~jnp.all(jnp.isfinite(from_posterior)), draw, from_posterior)
        # log N(e; 0, I) - log q(e), without the constants that both have; q with its share of N(0, I).
        log_prior = -e @ e / 2
        log_q = -jnp.sum((lower.T @ (e - mean)) ** 2) / 2 + jnp.sum(jnp.log(jnp.diagonal(lower)))
        if not is_exact:
            log_q = jnp.logaddexp(jnp.log(1 - prior_share) + log_q, jnp.log(prior_share) + log_prior)
        return center + moved.root @ e, jnp.where(jnp.isfinite(log_q), log_prior - log_q, 0.0)

    return ProposedParticles(*jax.vmap(propose_one)(moved.center, moved.draws, from_prior))


def share_drawn_from_prior(sensors: Sequence[AbstractSensor], atoms: int, optimal: bool) -> float:
    """Return the share of particles drawn without z: all if not `optimal`, none if the law that uses z is exact.

    It is exact for linear sensors and a noise that is one Gaussian (`atoms` = 1). Else a few draws from the prior bound
    the weights, where the law that uses z has little mass but the posterior has some.
    """
    if not optimal:
        return 1.0
    is_exact = all(isinstance(sensor, LinearSensor) for sensor in sensors) and atoms == 1
    return 0.0 if is_exact else PRIOR_SHARE


def factor_noise_covariance(plant: AbstractPlant, u: jax.Array) -> WeightedColumns:
    """Return columns W and weights w of Cov w = W diag(w) W' (n, n), of a plant x+ = f(x, u) + w under the input u."""
    return plant.noise.columns if isinstance(plant.noise, AbstractNoise) else columns_of(plant.noise_covariance(u))
