"""Density of what is received given the sensor's h(x): a mixture of Gaussians, for each set of what arrives."""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.covariance_factors import WeightedColumns, factor_covariances
from heliograph.factors.factored_gaussian import Gaussian, condition_on_observation
from heliograph.filters.modes.arrival_patterns import pattern_of
from heliograph.model.sensor import AbstractSensor
from heliograph.numerics.angles.angle import Angles, wrap_near
from heliograph.numerics.check import fail
from heliograph.numerics.gaussian_density import LOG_TURN
from heliograph.numerics.module import Module
from heliograph.numerics.numpy_or_jax import is_traced
from heliograph.numerics.types import Array, Bool, Float
from heliograph.random_affine.base import AbstractRandomAffine, ArrivalOutcome
from heliograph.random_affine.hop import GainAndNoise
from heliograph.random_affine.laws.law import Constant
from heliograph.random_affine.moments.mixture_components import AffineComponent
from heliograph.random_affine.series_and_stack import Series

CERTAIN = 1e-14  # of the largest eigenvalue of a noise's correlations: below it a combination has no noise


class ReceivedAtoms(Module):
    """Atoms of z given y = h(x) for one set of arrivals: z = gain y + offset + N(0, noise) with probability `weight`.

    Shapes: weight (a,), gain (a, m, p), offset (a, m), noise (a, m, m).
    """

    weight: Array
    gain: Array
    offset: Array
    noise: Array

    def expected(self, y: jax.Array) -> jax.Array:
        """Return E[z | y, atom] = gain y + offset of each Gaussian (atom) of the mixture, (a, m)."""
        expected: jax.Array = jnp.asarray(self.gain) @ y + jnp.asarray(self.offset)
        return expected

    def log_densities(self, y: jax.Array, z: jax.Array, angles: Angles) -> jax.Array:
        """Return log p(z | y) of the components of z (m,) that arrived, for each y (N, p); -inf where y is not finite.

        p is the sum over the atoms a of weight_a N(z; gain_a y + offset_a, noise_a). `angles` are those among z.
        """

        def compute_log_density(gain: jax.Array, offset: jax.Array, noise: jax.Array) -> jax.Array:
            """Return log N(z; gain y + offset, noise) of one atom (N,)."""
            return _log_density_of_atom(y @ gain.T + offset, noise, z, angles)

        # log of the weighted sum over the atoms.
        atoms = jnp.asarray(self.gain), jnp.asarray(self.offset), jnp.asarray(self.noise)
        by_atom = jax.vmap(compute_log_density)(*atoms)
        joint = jnp.log(jnp.asarray(self.weight))[:, None] + by_atom
        total = joint[0] if len(joint) == 1 else jax.nn.logsumexp(joint, axis=0)
        return jnp.where(jnp.isnan(total), -jnp.inf, total)

    def moments(self) -> tuple[jax.Array, jax.Array, jax.Array]:
        """Return the mean gain (m, p), the mean offset (m,), and the noise's covariance (m, m) of one Gaussian.

        It replaces the atoms. The spread of their offsets counts as noise.
        """
        weight, offset = jnp.asarray(self.weight), jnp.asarray(self.offset)
        mean = weight @ offset
        second = jnp.asarray(self.noise) + jnp.einsum("ai,aj->aij", offset, offset)  # E[n n'] of each atom
        covariance = jnp.einsum("a,aij->ij", weight, second) - jnp.outer(mean, mean)
        return jnp.einsum("a,aij->ij", weight, jnp.asarray(self.gain)), mean, covariance


def _log_density_of_atom(expected: jax.Array, noise: jax.Array, z: jax.Array, angles: Angles) -> jax.Array:
    """Return log N(z; expected, noise) of the components of z (m,) that arrived, for each expectation (N, m).

    `noise` is a covariance (m, m), and `angles` are the components of z that are angles. The result is -inf where an
    expectation is not finite. LOG_TURN is log 2 pi.
    """
    present = ~jnp.isnan(z)
    # z - E z, and 0 for what did not arrive and where E z is not finite.
    valid = jnp.all(jnp.isfinite(expected) | ~present, axis=1)
    value = wrap_near(z - expected, jnp.zeros(len(z)), angles)
    value = jnp.where(valid[:, None] & present, value, 0.0)
    # The noise's factor whitens z - E z. What did not arrive gets the variance 1.
    factor = jnp.linalg.cholesky(jnp.where(present[:, None] & present, noise, jnp.eye(len(z))))
    whitened = value @ jax.scipy.linalg.solve_triangular(factor, jnp.eye(len(z)), lower=True).T
    log_determinant = 2 * jnp.sum(jnp.log(jnp.diagonal(factor))) + LOG_TURN * jnp.sum(present)
    return jnp.where(valid, -(jnp.sum(whitened**2, axis=1) + log_determinant) / 2, -jnp.inf)


class ReceivedDensity(Module):
    """Law of z given h(x) at one step: in each of M modes, for each of A sets of components that arrive together.

    `present` (A, m) are the sets, `chance` (M, A) the probability of each set in each mode, and `atoms` the Gaussians
    whose mixture is the law of what arrives, with first axes (M, A).
    """

    present: Bool[Array, "A m"]
    chance: Float[Array, "M A"]
    atoms: ReceivedAtoms

    def given_arrivals(self, z: jax.Array) -> tuple[ReceivedAtoms, jax.Array]:
        """Return for each mode the Gaussians (atoms) of z given h(x), and P(set of arrivals | mode) (M,).

        The set is the smallest possible one in which all components of z arrive that are no NaN; a larger one is
        possible too, if numbers that arrived were replaced by NaN.
        """
        pattern = pattern_of(self, ~jnp.isnan(z)) if len(self.present) > 1 else 0
        atoms: ReceivedAtoms = jax.tree.map(lambda leaf: jnp.asarray(leaf)[:, pattern], self.atoms)
        return atoms, jnp.asarray(self.chance)[:, pattern]


class ReceivedByMode(NamedTuple):
    """What arrived: z (m,), and in each mode the mixture of Gaussians that is its law given y = h(x).

    z = gain y + offset + N(0, noise) with probability `weight`, for each Gaussian a (atom) of the mixture. `overall`
    holds gain, offset and noise of one Gaussian with the moments of the mixture.

    Shapes: weight (M, a), gain (M, a, m, p), offset (M, a, m), noise columns (M, a, m, m); `overall` without a.
    """

    z: jax.Array
    weight: jax.Array
    gain: jax.Array
    offset: jax.Array
    noise: WeightedColumns
    overall: tuple[jax.Array, jax.Array, WeightedColumns]


def find_received_by_mode(z: jax.Array, atoms: ReceivedAtoms) -> ReceivedByMode:
    """Return z (m,) with its law given h(x) in each mode: the mixture of Gaussians (atoms), and one Gaussian.

    The one Gaussian has the moments of the mixture: with it a particle's posterior is computed to draw from. Noises are
    returned as columns of their covariances.
    """
    gain, offset, noise = jax.vmap(lambda atoms_of_mode: atoms_of_mode.moments())(atoms)
    return ReceivedByMode(
        z=z,
        weight=jnp.asarray(atoms.weight),
        gain=jnp.asarray(atoms.gain),
        offset=jnp.asarray(atoms.offset),
        noise=jax.vmap(factor_covariances)(jnp.asarray(atoms.noise)),
        overall=(gain, offset, factor_covariances(noise)),
    )


def condition_on_received(
    x: Gaussian, slopes: jax.Array, expected: jax.Array, noise: WeightedColumns, z: jax.Array, angles: Angles
) -> tuple[Gaussian, jax.Array]:
    """Return x = m + L xi given z = expected + slopes xi + noise, and the log density of z.

    Only the components of z that arrived are used; `angles` are those that are angles.
    """
    innovation = wrap_near(z - expected, jnp.zeros(len(z)), angles)
    present = ~jnp.isnan(z)
    corrected, innovations = condition_on_observation(x, slopes, innovation, noise, present)
    return corrected, innovations.log_density(present, jnp.abs(z) + jnp.abs(expected))


def find_received_density(
    sensors: Sequence[AbstractSensor], channels: Sequence[AbstractRandomAffine]
) -> ReceivedDensity:
    """Return the density of z given h(x), as atoms by mode and by set of components that arrive.

    An atom is a Gaussian law of z = G (h(x) + v) + n for one value of the gain G and one branch of the noise v, with
    its probability. A particle filter weighs its particles by this density.

    Args:
        sensors: the sensor of each mode.
        channels: the channel of each mode, without memory.

    Raises:
        ValueError: gains not of finitely many values, noises not Gaussian; a received number, or a combination
            of several, without noise.
    """
    # For each mode its outcomes by set of components that arrive; then all sets, small ones first.
    by_mode = [{tuple(outcome.arrived): outcome for outcome in channel.list_outcomes()} for channel in channels]
    sets = sorted({arrived for outcomes in by_mode for arrived in outcomes}, key=lambda flags: (sum(flags), flags))
    # Atoms and chance by mode and set. A set that cannot arrive in a mode has a chance of 0, and atoms of another set.
    atoms_by_mode, chance = [], []
    for sensor, outcomes in zip(sensors, by_mode, strict=True):
        any_outcome = next(iter(outcomes.values()))
        atoms_by_mode.append([_list_atoms(sensor, outcomes.get(arrived, any_outcome)) for arrived in sets])
        chance.append([outcomes[arrived].probability if arrived in outcomes else 0.0 for arrived in sets])
    # Stacked along (mode, set, atom), with as many atoms everywhere.
    most = max(len(atoms) for of_mode in atoms_by_mode for atoms in of_mode)
    padded = [[_stack_atoms(atoms, most) for atoms in of_mode] for of_mode in atoms_by_mode]
    stacked = [jax.tree.map(lambda *leaves: np.stack(leaves), *of_mode) for of_mode in padded]
    return ReceivedDensity(
        present=np.array(sets, dtype=bool),
        chance=np.array(chance, dtype=float),
        atoms=jax.tree.map(lambda *leaves: np.stack(leaves), *stacked),
    )


def _list_atoms(sensor: AbstractSensor, outcome: ArrivalOutcome) -> list[AffineComponent]:
    """Return the atoms of one set of arrivals; raise ValueError unless each has noise in all that arrives.

    An atom is one Gaussian of what arrives, given the signal: gain, offset, noise covariance and weight.
    """
    outputs = len(sensor.outputs)
    received = GainAndNoise(Constant(1.0), np.eye(outputs), sensor.noise)
    try:
        atoms = Series([received, outcome.map]).list_atoms()
    except ValueError as error:
        expected = "gains of finitely many values and Gaussian noises"
        raise fail("channel of particles", expected, str(error).rsplit("got ", 1)[-1]) from error
    if is_traced(atoms):
        raise fail("plant, sensor and channel of particles", "numbers: their likelihood jumps", "what is to be learned")
    for atom in atoms:
        _check_noise(np.asarray(atom.noise)[np.ix_(outcome.arrived, outcome.arrived)])
    return [atom for atom in atoms if atom.weight > 0]


def _check_noise(covariance: np.ndarray) -> None:
    """Raise ValueError unless every combination of what arrives has noise.

    A combination has no noise if its eigenvalue of the noise's correlations is at most CERTAIN, 1e-14.
    """
    deviation = np.sqrt(np.diagonal(covariance))
    unit = np.where(deviation > 0, deviation, 1.0)
    correlation = covariance / np.outer(unit, unit)
    if len(covariance) and not np.min(np.linalg.eigvalsh(correlation)) > CERTAIN:
        expected = "noise in everything that arrives, so that it has a density (give the sensor or the link a variance)"
        raise fail("output of particles", expected, f"the covariance {covariance.tolist()}")


def _stack_atoms(atoms: Sequence[AffineComponent], count: int) -> ReceivedAtoms:
    """Stack atoms, the Gaussians of what arrives, into arrays of length `count`.

    Atoms of weight 0 fill up the arrays. The weights are divided by their sum.
    """
    padded = [*atoms, *[atoms[0]._replace(weight=0.0)] * (count - len(atoms))]
    fields = zip(*padded, strict=True)
    weight, gain, offset, noise = (np.stack([np.asarray(x, float) for x in field]) for field in fields)
    return ReceivedAtoms(weight=weight / weight.sum(), gain=gain, offset=offset, noise=noise)
