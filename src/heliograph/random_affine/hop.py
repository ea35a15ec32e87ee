"""The atom of a channel: one random gain times a known matrix, plus noise."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.angles.angle import Angles
from heliograph.numerics.caching import cache_by_object
from heliograph.numerics.check import array, fail, show_value
from heliograph.numerics.numpy_or_jax import equal_to_rounding, is_traced, is_zero, library, scatter, stack_parts
from heliograph.numerics.types import ArrayLike, Float
from heliograph.random_affine.base import AbstractRandomAffine, KnownGains, SameNoise
from heliograph.random_affine.laws.law import AbstractLaw, Constant
from heliograph.random_affine.moments.gain_and_disturbance_moments import DisturbedGain, disturb_hop, noise_gain
from heliograph.random_affine.moments.interval_products import Interval
from heliograph.random_affine.moments.mixture_components import AffineComponent
from heliograph.random_affine.moments.monomials import (
    JointMoments,
    count_monomials,
    degrees,
    plan_binomial_sums,
    refuse_if_too_large,
    symmetric_power,
)
from heliograph.random_affine.moments.signal_path import ChannelPosition, Visit, refuse_gain_on_angles
from heliograph.random_affine.noises.noise import AbstractNoise, Gaussian, Matrix, Vector, as_noise, noise_moment_vector

NOTHING_SENT = "nothing sent"  # text for a hop whose matrix A is zero
ROUNDING = 1e-12  # a computed gain this near to 1 is taken as 1


class AbstractHop(AbstractRandomAffine):
    """Random affine map z = g A y + n of a known matrix A and a noise n, whatever the law of its gain g is."""

    matrix: eqx.AbstractVar[Matrix]
    noise: eqx.AbstractVar[AbstractNoise]

    @property
    def outputs(self) -> int:
        """Length of z = g A y + n: the number of rows of A."""
        return int(self.matrix.shape[-2])

    @property
    def inputs(self) -> int:
        """Length of the signal y that is sent through this hop z = g A y + n: the number of columns of A."""
        return int(self.matrix.shape[-1])

    @property
    def transmits(self) -> bool:
        """True for a radio; False for a wire, z = A y: a gain g that is the constant 1, and no noise."""
        return not (self._gain_is_one and is_zero(self.noise.covariance))

    @property
    def _gain_is_one(self) -> bool:
        """True if the gain g is known to be the constant 1; by default it is not known."""
        return False

    def visit_hops(self, visit: Visit, position: ChannelPosition) -> tuple[AbstractRandomAffine, ChannelPosition]:
        """Return what visit(name, hop, signal) puts in place of this hop, and the position one hop further.

        The name is the position's prefix and "hop" with the hop's number in the chain; the signal is the second moment
        of what the hop receives. A wire, which does not transmit, is returned unchanged, with the same position.

        A hop is a transmitter with its link. `position` has the name and number of the next one, and the signal there.
        """
        if not self.transmits:
            return self, position
        position_behind = position._replace(hops=position.hops + 1)
        name = f"{position.prefix}hop{position_behind.hops}"
        visited: AbstractRandomAffine = visit(name, self, position.signal)
        return visited, position_behind


class GainAndNoise(AbstractHop):
    """Random affine map z = g A y + n with a scalar random gain g, a known matrix A and noise n, all independent.

    Args:
        law: law of the gain g; `Constant` for a known number.
        matrix: A (m, p).
        noise: law of n with m components, its covariance (m, m), or a variance that all components have.

    Raises:
        ValueError: a gain that is no law, shapes that do not fit, numbers that are not finite.
    """

    law: AbstractLaw
    matrix: Matrix
    noise: AbstractNoise

    def __init__(
        self, law: AbstractLaw, matrix: "Float[ArrayLike, 'm p']", noise: "AbstractNoise | Float[ArrayLike, '*m']"
    ):
        """Hold the law of the scalar gain g, the matrix A and the law of the additive noise n."""
        if not isinstance(law, AbstractLaw):
            raise fail("gain of a hop", "a law (Constant for a number)", show_value(law))
        self.law = law
        self.matrix = array("gain matrix", matrix, ("outputs", "inputs"))
        self.noise = as_noise("channel noise", noise, self.matrix.shape[0])

    def sample(self, key: jax.Array) -> jax.Array:
        """Draw H = [[g A, n], [0, 1]] of z = g A y + n: a random gain g and a noise n."""
        gain_key, noise_key = jax.random.split(key)
        gain = self.law.sample(gain_key) * jnp.asarray(self.matrix)
        noise = self.noise.sample(noise_key)[:, None]
        top = jnp.concatenate([gain, noise], axis=1)
        bottom = np.eye(1, self.inputs + 1, self.inputs)
        return jnp.concatenate([top, bottom], axis=0)

    @property
    def remembers(self) -> bool:
        """Always False: draws are independent over time."""
        return False

    @cache_by_object
    def moments(self, order: int) -> JointMoments:
        """Return E[Sym^order(H)] = sum_k E[g^k] B_k: moments of the gain g, and B_k the `gain_coefficients`.

        Sym^order(H) maps the monomials of (y, 1) of this degree to those of (z, 1).
        """
        gains = tabulate_gain_moments(self.law, order)
        coefficients = self.gain_coefficients(order)
        return JointMoments(
            library(gains, coefficients).tensordot(gains, coefficients, axes=1), self.outputs, self.inputs, order
        )

    @cache_by_object
    def gain_coefficients(self, order: int) -> Float[jax.Array | np.ndarray, "order+1 rows columns"]:
        """Return all B_k, the coefficients of E[g^k] in E[Sym^order(H)] = sum_k E[g^k] B_k.

        The axes are k, the monomials of (z, 1), and those of (y, 1). B_k has the terms with |b| = k of
        E[prod_i (g (A y)_i + n_i)^a_i] = sum_{b <= a} C(a, b) E[g^|b|] (A y)^b E[n^(a-b)].
        """
        rows = count_monomials(self.outputs + 1, order)
        columns = count_monomials(self.inputs + 1, order)
        refuse_if_too_large(rows, columns, f"moments of order {order}")
        of_known_map = symmetric_power(affine_matrix(self.matrix), order)  # rows (A y)^b, made homogeneous with 1
        row, column, remainder, binomials = plan_binomial_sums(self.outputs, order)
        noise_moments = noise_moment_vector(self.noise, order)
        terms = (binomials * noise_moments[remainder])[:, None] * of_known_map[column]
        power_of_gain = degrees(self.outputs, order)[column]
        return scatter((order + 1, rows, columns), (power_of_gain, row), terms)

    def extremes(self) -> tuple[AbstractRandomAffine, ...]:
        """Return one map for each extreme law of the gain."""
        return tuple(GainAndNoise(law, self.matrix, self.noise) for law in self.law.extremes())

    def corner_count(self) -> int:
        """Return the number of extreme laws of the gain."""
        return len(self.law.corner_moments(0))

    def corner_moments(self, order: int) -> Float[jax.Array | np.ndarray, "corner rows columns"]:
        """Return E[Sym^order(H)] = sum_k E[g^k] B_k under each extreme law ("corner") of the gain g.

        Sym^order(H) takes the monomials of (y, 1) of this degree to those of (z, 1), and the B_k are the
        `gain_coefficients`. An extreme law is a vertex of the polytope of possible probabilities of g.
        """
        gains = self.law.corner_moments(order)
        coefficients = self.gain_coefficients(order)
        moment_map: jax.Array | np.ndarray = library(gains, coefficients).tensordot(gains, coefficients, axes=1)
        return moment_map

    def _interval_of_parts(self, order: int) -> Interval:
        """Return the ends of each entry of sum_k E[g^k] B_k, with the exact range of each E[g^k] over the laws of g.

        The `gain_coefficients` B_k are known. Where an entry is negative, the lower moment gives the higher product.
        """
        coefficients = self.gain_coefficients(order)
        xp = library(coefficients)
        gain_intervals = [self.law.moment_interval(k) for k in range(order + 1)]
        lows, highs = [], []
        for b, (low, high) in zip(coefficients, gain_intervals, strict=True):
            lows.append(xp.minimum(b * low, b * high))
            highs.append(xp.maximum(b * low, b * high))
        lowest, highest = sum(lows), sum(highs)
        return lowest, highest

    def covers_kind(self, actual: AbstractRandomAffine, same_noise: SameNoise) -> bool:
        """Return whether `actual` is a hop with this matrix and noise, and a law of the gain that is possible here."""
        if not isinstance(actual, GainAndNoise) or not self.law.covers(actual.law):
            return False
        return equal_to_rounding(self.matrix, actual.matrix) and same_noise(self.noise, actual.noise)

    def carry_known_gains(self, known: KnownGains) -> KnownGains:
        """Return which outputs (m,) have a known gain: an output must use only `known` inputs, by a constant gain g."""
        is_used = np.ones(self.matrix.shape, bool) if is_traced(self.matrix) else np.asarray(self.matrix) != 0
        are_known: KnownGains = (self.law.constant is not None) & ~np.any(is_used & ~known, axis=1)
        return are_known

    def carry_angles(self, sent: Angles) -> Angles:
        """Return the indices of the outputs of z = g A y + n that are angles, from those of y (`sent`).

        An output that takes an angle must take a single one by the gain 1, and no other angle; whole multiples or sums
        of angles are refused.

        Raises:
            ValueError: an angle with a random, unknown or other gain.
        """
        if not sent:
            return ()
        if is_traced(self.matrix):
            raise refuse_gain_on_angles("a gain that is traced")
        # Outputs that take an angle.
        taking = np.flatnonzero(np.any(np.asarray(self.matrix)[:, list(sent)] != 0, axis=1))
        if not taking.size:
            return ()
        gain = self.law.constant
        if gain is None or is_traced(gain):
            raise refuse_gain_on_angles(f"a gain that is {type(self.law).__name__}")
        # In each row of g A the gains must be whole, at least 0, and sum to 1: then a single one is 1, the others 0.
        gains = float(gain) * np.asarray(self.matrix)[taking]
        are_whole = np.abs(gains - np.round(gains)) <= ROUNDING
        if not np.all(are_whole & (np.round(gains) >= 0)) or np.any(np.round(gains).sum(axis=1) != 1):
            raise refuse_gain_on_angles(f"the gains {gains[gains != 0].tolist()}")
        return tuple(int(i) for i in taking)

    def list_atoms(self) -> list[AffineComponent]:
        """Return every combination of a value g of the gain with an atom n = c + N(0, R) of the noise.

        A combination has the product of both probabilities, P(g) P(atom), and is the map y -> g A y + c + N(0, R).
        """
        atoms = []
        for probability_of_gain, g in self.law.list_atoms():
            for probability_of_atom, c, R in self.noise.list_atoms():
                weight = probability_of_gain * probability_of_atom
                atoms.append(AffineComponent(weight, g * self.matrix, c, R))
        return atoms

    def disturb_gain(self) -> DisturbedGain:
        """Return E[H_ab] and E[H_ab H_ij] of H = [g A, N], where N N' is the covariance of the noise.

        In an H-infinity design z = g A y + N d, with a disturbance d of finite energy in place of the noise n.
        """
        noise_root = noise_gain(np.asarray(self.noise.mean), np.asarray(self.noise.covariance))
        gain_moments = float(self.law.moment(1)), float(self.law.moment(2))
        return disturb_hop(np.asarray(self.matrix), gain_moments, noise_root)

    def in_words(self) -> str:
        """Return the hop in words, such as "Rician hop", "hop 1.1" or "known gain 1.1"; "" if it passes y as it is."""
        matrix = np.asarray(self.matrix)
        is_noiseless = not (np.any(np.asarray(self.noise.covariance)) or np.any(np.asarray(self.noise.mean)))
        if not matrix.any():
            return NOTHING_SENT
        is_square = matrix.shape[0] == matrix.shape[1]
        is_multiple_of_identity = is_square and np.array_equal(matrix, matrix[0, 0] * np.eye(len(matrix)))
        if self.law.constant is None:
            return f"{type(self.law).__name__} hop"
        gain = float(self.law.constant) * matrix[0, 0] if is_multiple_of_identity else np.nan
        # Each output is one of the inputs.
        selects = float(self.law.constant) == 1 and np.isin(matrix, (0, 1)).all() and (matrix.sum(axis=1) == 1).all()
        if is_noiseless and (gain == 1 or selects):
            return ""
        kind = "known gain" if is_noiseless else "hop"
        return f"{kind} {gain:.3g}" if is_multiple_of_identity and gain != 1 else kind

    def detach_outliers(self) -> tuple[AbstractRandomAffine, AbstractNoise | None]:
        """Return the hop with only the mean of its noise, and the noise, if the noise's law has outliers.

        The noise's `branches` are deviations from its mean, so that the mean, which stays in the hop, is not counted
        twice. Without outliers, return the hop unchanged and None.
        """
        if not self.noise.has_outliers:
            return self, None
        mean_alone = Gaussian(np.zeros((self.outputs, self.outputs)), self.noise.mean)
        return GainAndNoise(self.law, self.matrix, mean_alone), self.noise

    @property
    def is_silent(self) -> bool:
        """True if the hop is z = n: A is zero, and the gain is the constant 1, as in a packet loss or an off state."""
        return is_zero(self.matrix) and self._gain_is_one

    @property
    def _gain_is_one(self) -> bool:
        """True if the gain g is the constant 1, and its value is known now (not traced by JAX)."""
        gain = self.law.constant
        return gain is not None and not is_traced(gain) and float(gain) == 1.0

    def mean_gain(self) -> AbstractRandomAffine:
        """Return the map E[g] A y + n."""
        return GainAndNoise(self.law.mean_law(), self.matrix, self.noise)


def affine_matrix(matrix: Matrix) -> Matrix:
    """Return [[A, 0], [0, 1]], which maps (y, 1) to (A y, 1)."""
    outputs, inputs = matrix.shape
    zero_column = np.zeros((outputs, 1))
    last_row = np.eye(1, inputs + 1, inputs)
    xp = library(matrix)
    extended: Matrix = xp.concatenate([xp.concatenate([matrix, zero_column], axis=1), last_row])
    return extended


def tabulate_gain_moments(law: AbstractLaw, order: int) -> Vector:
    """Return the moments E[g^k] of a gain, k = 0, ..., order; shape (order + 1,)."""
    moment = law.moment  # looked up once: attribute access of a module is slow
    return stack_parts([moment(k) for k in range(order + 1)])


def known(matrix: "Float[ArrayLike, 'm p']", offset: "Float[ArrayLike, ' m'] | None" = None) -> GainAndNoise:
    """Return the deterministic map z = A y + b.

    Args:
        matrix: A (m, p).
        offset: b (m,), zero unless given.

    Raises:
        ValueError: shapes that do not fit, or numbers that are not finite.
    """
    a = array("matrix", matrix, ("outputs", "inputs"))
    m = a.shape[0]
    b = np.zeros(m) if offset is None else array("offset", offset, (m,))
    return GainAndNoise(Constant(1.0), a, Gaussian(np.zeros((m, m)), mean=b))
