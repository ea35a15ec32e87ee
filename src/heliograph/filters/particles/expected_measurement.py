"""Mean and covariance of the innovation, from what each particle expects of a measurement, where h(x) is a number."""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp

from heliograph.filters.particles.moments import FirstSums
from heliograph.filters.particles.received_density import ReceivedAtoms
from heliograph.model.estimate import Innovation
from heliograph.numerics.angles.angle import Angles, wrap_near
from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.types import Array


class InnovationSums(NamedTuple):
    """Weighted sums over pairs of particle and Gaussian of their innovations d (m,), less a reference innovation.

    `first`: sums of w, w^2 and w d; `second`: the sum of w d d' (m, m).
    """

    first: FirstSums
    second: jax.Array


class ExpectedMeasurement(NamedTuple):
    """The law of z (m,) given y = h(x), as a mixture of Gaussians (atoms), and y (p,) of a reference particle.

    Innovations are summed as differences from a base, that of the reference under the first atom: no digits are lost if
    z is far from 0, and angles are within half a turn of it. The reference is NaN if y of every particle is.
    """

    atoms: ReceivedAtoms
    z: jax.Array
    reference: jax.Array
    angles: Angles

    @property
    def base(self) -> jax.Array:
        """Return the base of the sums, z - E[z | y of the reference particle, first Gaussian of the mixture] (m,)."""
        value = self.z - self.atoms.expected(jnp.nan_to_num(self.reference, nan=0.0, posinf=0.0, neginf=0.0))[0]
        return wrap_near(value, jnp.zeros(len(self.z)), self.angles)

    def find_innovations(self, weight: jax.Array, predicted: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return weights (B a,) of all pairs of particle and atom, and their innovations less the base (B a, m).

        An atom is one of the a Gaussians whose mixture is the law of z given h(x). The base is the innovation of the
        reference particle under the first atom.

        Args:
            weight: weights (B,) of particles before z is known, of any sum.
            predicted: their h(x), (B, p). A particle with an infinite or NaN h(x) has no weight, unless all have one.
        """
        is_finite = jnp.all(jnp.isfinite(predicted), axis=1)
        some_is_finite = jnp.all(jnp.isfinite(self.reference))  # a finite reference is chosen if there is one
        joint_weight = jnp.where(is_finite | ~some_is_finite, weight, 0.0)[:, None] * jnp.asarray(self.atoms.weight)
        value = self.z - jax.vmap(self.atoms.expected)(jnp.where(is_finite[:, None], predicted, 0.0))
        difference = wrap_near(value - self.base, jnp.zeros(len(self.z)), self.angles)
        return joint_weight.ravel(), difference.reshape(-1, len(self.z))

    def compute_innovation(self, sums: InnovationSums, density: jax.Array) -> Innovation:
        """Return the innovation z - E z, its covariance Cov z, and log p(z).

        Given y = h(x), z is a mixture of Gaussians (atoms). Cov z is the mean covariance of these Gaussians, plus the
        covariance of their means over all particles and atoms.

        Args:
            sums: of the innovations of all particles and atoms, less the base: a reference innovation.
            density: log p(z), used only if something arrived.
        """
        first, second = sums
        mean, present = first.mean(angles=()), ~jnp.isnan(self.z)
        noise = jnp.einsum("a,aij->ij", jnp.asarray(self.atoms.weight), jnp.asarray(self.atoms.noise))
        noise = jnp.where(present[:, None] & present, noise, jnp.nan)
        covariance_of_means = second / first.weight - jnp.outer(mean, mean)
        nothing_arrived = ~jnp.any(present)  # then the density is exactly 1
        return Innovation(self.base + mean, noise + covariance_of_means, jnp.where(nothing_arrived, 0.0, density))


def find_reference_particle(weight: Array, predicted: tuple[Array, ...]) -> Array:
    """Return the index of the heaviest particle (N,) with finite expectations, or of the heaviest if no one has any.

    Its innovation is subtracted from all others before they are summed, so that differences keep their digits.
    `predicted` holds what particles expect of z, in several arrays (N, ...).
    """
    xp = library(weight, predicted)
    finite_by_array = [
        xp.all(xp.isfinite(xp.reshape(expectations, (len(expectations), -1))), axis=1) for expectations in predicted
    ]
    is_candidate = functools.reduce(xp.logical_and, finite_by_array) & (weight > 0)
    heaviest: Array = xp.argmax(xp.where(is_candidate | ~xp.any(is_candidate), weight, 0.0))
    return heaviest
