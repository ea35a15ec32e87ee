"""Second moments of a channel, bounded under every possible law, and intervals of every moment."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.factors.columns import Columns, columns_of
from heliograph.numerics.caching import cached
from heliograph.numerics.check import fail
from heliograph.numerics.linalg import contract, diagonal, diagonal_of, summed
from heliograph.numerics.module import Module
from heliograph.numerics.traced import is_traced, library, placed, stacked
from heliograph.numerics.types import Float
from heliograph.random_affine.base import AbstractRandomAffine, as_maps, check_forgets, fold
from heliograph.random_affine.combine import GainAndNoise, Series, Stack, stack_rows
from heliograph.random_affine.law import Constant, Discrete
from heliograph.random_affine.moments.monomials import Moments, count, product_table

CORNERS = 2048  # corner laws evaluated one by one; above, intervals are combined (sound, but looser)

Entries = Float[jax.Array | np.ndarray, "..."]
Interval = tuple[Entries, Entries]


def moment_interval(channel: AbstractRandomAffine, order: int) -> Interval:
    """Lowest and highest value of each entry of E[Sym^order(H)].

    Up to CORNERS corner laws the ends are attained, since every entry is linear in each uncertain law; above, the
    intervals of the parts are multiplied: sound but not attained.
    """
    check_forgets("channel of a bound", channel)
    corners = _corner_count(channel)
    # Every entry is multilinear in the uncertain probabilities, so corner laws attain its ends.
    if corners is not None and corners <= CORNERS:
        matrices = channel.corner_moments(order)
        return matrices.min(axis=0), matrices.max(axis=0)
    # Too many corners: interval products of the parts.
    match channel:
        case Series():
            low, high = moment_interval(channel.maps[0], order)
            for affine in channel.maps[1:]:
                low, high = _multiply_matrices(moment_interval(affine, order), (low, high))
            return low, high
        case Stack():
            return _stack_interval(channel, order)
        case GainAndNoise(law=Discrete() as law):
            return _atom_interval(channel, law, order)
    raise fail("uncertain channel", f"at most {CORNERS} corner laws", corners)


def _corner_count(channel: AbstractRandomAffine) -> int | None:
    try:
        return channel.corner_count()
    except ValueError:  # one law with more uncertain atoms than corners are listed for
        return None


def _multiply_matrices(second: Interval, first: Interval) -> Interval:
    """Interval matrix product by centres and radii: C2 C1 and |C2| R1 + R2 (|C1| + R1)."""
    c2, r2 = (second[1] + second[0]) / 2, (second[1] - second[0]) / 2
    c1, r1 = (first[1] + first[0]) / 2, (first[1] - first[0]) / 2
    size = library(c1, c2).abs
    center, radius = c2 @ c1, size(c2) @ r1 + r2 @ (size(c1) + r1)
    return center - radius, center + radius


def _atom_interval(channel: GainAndNoise, law: Discrete, order: int) -> Interval:
    """Moments are sum_k E[g^k] B_k with known B_k; each E[g^k] has its exact range from the closed-form LP."""
    basis = channel.gain_coefficients(order)
    ends = [(-law.worst(-(law.values**k)), law.worst(law.values**k)) if k else (1.0, 1.0) for k in range(order + 1)]
    xp = library(basis)
    products = [
        (xp.minimum(b * lo, b * hi), xp.maximum(b * lo, b * hi)) for b, (lo, hi) in zip(basis, ends, strict=True)
    ]
    return sum(low for low, _ in products), sum(high for _, high in products)


def _stack_interval(channel: Stack, order: int) -> Interval:
    """Products of the parts' interval polynomials, row by row."""
    tables = [[stacked(moment_interval(m, k)) if k else None for k in range(order + 1)] for m in channel.maps]
    rows = stacked(stack_rows(channel, order, tables, _multiply_rows))
    return rows[:, 0], rows[:, 1]


def _multiply_rows(a: Entries, first: int, b: Entries, second: int, variables: int) -> Entries:
    """Interval product of two polynomials: ends of the products of ends, summed over equal monomials.

    Shapes: a (ends, n), b (ends, m), with one pair of ends, or (n,) where they are one.
    """
    table = product_table(variables, first, second)
    size = (count(variables, first + second),)
    products = a.reshape(-1, 1, a.shape[-1], 1) * b.reshape(1, -1, 1, b.shape[-1])
    return stacked([placed(size, table, products.min(axis=(0, 1))), placed(size, table, products.max(axis=(0, 1)))])


PROPORTIONAL_TOLERANCE = 1e-12  # of each entry's own scale: two tensors from different sums are one's multiples


Tensor = Float[jax.Array | np.ndarray, "m m p+1 p+1"]
Matrix = Float[jax.Array | np.ndarray, "m p"]


class QuadraticMap(Module):
    """A map from second moments W of (y, 1) to a matrix that dominates T_v(W) for every possible law v.

    Value: C:W + diag_i(sum_j R_ij:|W| d_i / d_j). The second term is zero where one law dominates all others; otherwise
    T_v(W) - C:W has entries within R:|W|, and a matrix with these row sums on the diagonal dominates it (Gershgorin,
    in units d of each component's own, d_i^2 = |C_ii:W| + R_ii:|W|).

    Shapes: center, radius (m, m, p + 1, p + 1).
    """

    center: Tensor
    radius: Tensor

    def __call__(self, second_moment: jax.Array, present: jax.Array) -> jax.Array:
        """Evaluate at W of shape (p + 1, p + 1); rows and columns of components that are not present are zero."""
        mask = present[:, None] & present[None, :]
        center = self.middle(second_moment, present)
        entries = jnp.where(mask, contract(self.radius, jnp.abs(second_moment)), 0.0)
        unit = jnp.sqrt(_or_one(jnp.abs(diagonal_of(center)) + diagonal_of(entries)))
        return center + diagonal(unit * summed(entries / unit, 1))

    def middle(self, second_moment: jax.Array, present: jax.Array) -> jax.Array:
        """C:W alone, which is all where the law is known."""
        return jnp.where(present[:, None] & present[None, :], contract(self.center, second_moment), 0.0)


class SecondOrder(Module):
    """Mean and second moments of z = G y + n, nominal where the law is known, dominating where it is not.

    mean_gain, offset: M = E[G] and b = E[n] under the nominal law; spread: E_v[((G - M) y + n - b)(...)'];
    shift: ((M_v - M) y + b_v - b)(...)'; power: E_v[G y y' G'] (the last row and column of W are ignored).

    nominal: the spread under the nominal law itself, which is gain_spread : W + Cov n with the columns `noise` of the
    latter: apart from the gain, so that a combination of outputs that is free of noise stays free of it. Where gain and
    noise are correlated, gain_spread is all and noise zero.

    Shapes: mean_gain (m, p), offset (m,), gain_spread (m, m, p + 1, p + 1), noise (m, m).
    """

    mean_gain: Matrix
    offset: Float[jax.Array | np.ndarray, " m"]
    spread: QuadraticMap
    shift: QuadraticMap
    power: QuadraticMap
    nominal: QuadraticMap
    gain_spread: Tensor
    noise: Columns
    uncertain: bool = eqx.field(static=True)


def described_by(
    mean: Matrix, spread: QuadraticMap, shift: QuadraticMap, power: QuadraticMap, nominal: QuadraticMap, uncertain: bool
) -> SecondOrder:
    """Second moments of z = G y + n from E[(G, n)] and the maps, the nominal one divided into gain and noise."""
    gain, noise = divided(nominal.center)
    return SecondOrder(mean[:, :-1], mean[:, -1], spread, shift, power, nominal, gain, noise, uncertain)


def divided(spread: Tensor) -> tuple[Tensor, Columns]:
    """Spread of the gain alone, and m columns of Cov n, from the spread of both; of none where they are correlated."""
    xp, covariance = library(spread), spread[..., -1, -1]
    apart = xp.all(spread[..., :-1, -1] == 0)
    corner = np.zeros(spread.shape[-2:])
    corner[-1, -1] = 1.0
    noise = columns_of(xp.where(apart, covariance, 0.0))
    lacking = len(covariance) - noise.matrix.shape[1]
    padded = Columns(xp.pad(noise.matrix, ((0, 0), (0, lacking))), xp.pad(noise.weights, (0, lacking)))
    return spread - xp.where(apart, covariance, 0.0)[..., None, None] * corner, padded


def undivided(gain: Tensor, noise: Columns) -> Tensor:
    """Spread of gain and noise together, from what `divided` returns; both may have leading axes."""
    xp = library(gain, noise)
    covariance = (noise.matrix * noise.weights[..., None, :]) @ xp.swapaxes(noise.matrix, -1, -2)
    corner = np.zeros(gain.shape[-2:])
    corner[-1, -1] = 1.0
    whole: Tensor = gain + covariance[..., None, None] * corner
    return whole


def _or_one(value: jax.Array) -> jax.Array:
    return jnp.where(value > 0, value, 1.0)


def has_random_gain(channel: AbstractRandomAffine, described: SecondOrder) -> bool:
    """Return whether z depends on y through more than a known gain; a law with traced parameters counts as random."""
    if described.uncertain or is_traced(described.spread):
        return described.uncertain or not has_known_gain(channel)
    block = np.abs(described.spread.center[..., :-1, :]) + np.abs(described.spread.radius[..., :-1, :])
    return bool(np.any(block > 0)) and not has_known_gain(channel)


def has_known_mean(described: SecondOrder) -> bool:
    """Return whether E[G] and E[n] are the same under every possible law, to rounding; False for traced parameters."""
    if is_traced((described.shift, described.mean_gain, described.offset)):
        return False
    size = np.max(np.abs(described.mean_gain), initial=0.0) ** 2 + np.max(np.abs(described.offset), initial=0.0) ** 2
    largest = max(np.max(np.abs(bound), initial=0.0) for bound in (described.shift.center, described.shift.radius))
    return bool(largest <= PROPORTIONAL_TOLERANCE**2 * size)


def has_known_gain(channel: AbstractRandomAffine) -> bool:
    """Return whether z = G y + n with a constant G."""
    holds: bool = fold(channel, {
        GainAndNoise: lambda hop, _: isinstance(hop.law, Constant),
        Series | Stack: lambda _, parts: all(parts),
        AbstractRandomAffine: lambda *_: False,
    })  # fmt: skip
    return holds


@cached
def second_order(channel: AbstractRandomAffine) -> SecondOrder:
    """Return mean and second moments of z = G y + n, bounded over the polytope of uncertain probabilities.

    Exact for a gain common to all components, else dominating. With one scalar gain g, the largest E_v (g - mu)^2,
    (mu_v - mu)^2 and E_v g^2 are taken at corner laws, where these multilinear (or convex) functions of the
    probabilities have their maxima.

    Args:
        channel: one that forgets.

    Raises:
        ValueError: more corner laws than can be listed in a channel that is no series or stack, or one that remembers.
    """
    as_maps("channel of a filter", [channel])
    check_forgets("channel of a filter", channel)
    nominal = channel.moments(2)
    mean = nominal.mean[:-1]
    corners = _corner_count(channel)
    known = corners == 1
    # Known law: the moments themselves.
    if known:
        spread, shift, power = _tensors(nominal, mean)
        parts = [QuadraticMap(t, np.zeros(t.shape)) for t in (spread, shift, power)]
    # Uncertain law: blocks of a stack, maxima over corner laws, or intervals of moments.
    elif isinstance(channel, Stack):
        parts = _from_stack(channel)
    elif corners is not None and corners <= CORNERS:
        laws = (
            Moments(corner_moment, nominal.outputs, nominal.inputs, 2) for corner_moment in channel.corner_moments(2)
        )
        stacks = zip(*(_tensors(corner, mean) for corner in laws), strict=True)
        parts = [_dominate(stacked(tensors), mean) for tensors in stacks]
    else:
        parts = _from_intervals(channel, nominal, mean)
    center = parts[0] if known else nominal_spread(channel)
    return described_by(mean, parts[0], parts[1], parts[2], center, not known)


def nominal_spread(channel: AbstractRandomAffine) -> QuadraticMap:
    """Cov(z | y) under the nominal law."""
    nominal = channel.moments(2)
    spread = _tensors(nominal, nominal.mean[:-1])[0]
    return QuadraticMap(spread, np.zeros(spread.shape))


def second_moment_tensor(matrix: Matrix, outputs: int, inputs: int) -> Tensor:
    """E[z_i z_j | y] = sum_ab T[i, j, a, b] Y_a Y_b, symmetric in (i, j) and in (a, b), from E[Sym^2(H)]."""
    rows = product_table(outputs + 1, 1, 1)[:-1, :-1]
    columns = product_table(inputs + 1, 1, 1)
    shares = np.where(np.eye(inputs + 1, dtype=bool), 1, 2)  # a coefficient of Y_a Y_b stands at (a, b) and at (b, a)
    return matrix[rows[:, :, None, None], columns] / shares


def symmetric_product(a: Matrix, b: Matrix) -> Tensor:
    """(A y)(B y)' as a tensor, made symmetric in the two factors y."""
    forward: Tensor = library(a, b).einsum("ia,jb->ijab", a, b)
    return (forward + forward.swapaxes(2, 3)) / 2


def _tensors(moments: Moments, mean: Matrix) -> tuple[Tensor, Tensor, Tensor]:
    """Spread about the nominal mean H0, shift of the mean, and power, all of one law."""
    raw = second_moment_tensor(moments.matrix, moments.outputs, moments.inputs)
    law_mean = moments.mean[:-1]
    spread = raw - symmetric_product(mean, law_mean) - symmetric_product(law_mean, mean) + symmetric_product(mean, mean)
    return spread, symmetric_product(law_mean - mean, law_mean - mean), _of_signal(raw)


def _of_signal(tensor: Tensor) -> Tensor:
    """The tensor without its last row and column, those of the constant 1."""
    signal = np.arange(tensor.shape[-1]) < tensor.shape[-1] - 1
    signal_part: Tensor = library(tensor).where(signal[:, None] & signal, tensor, 0.0)
    return signal_part


def _dominate(tensors: Tensor, mean: Matrix) -> QuadraticMap:
    """One map above all of the (law, m, m, p + 1, p + 1) tensors.

    Where y enters as s_v M y y' M' and the noise part has a largest matrix, that of the largest s_v and the largest
    noise; else the middle of the range of each entry, with its half as radius.
    """
    xp = library(tensors)
    low, high = tensors.min(axis=0), tensors.max(axis=0)
    exact, holds = _common_gain(tensors, mean)
    return QuadraticMap(xp.where(holds, exact, (low + high) / 2), xp.where(holds, 0.0, (high - low) / 2))


def _common_gain(tensors: Tensor, mean: Matrix) -> tuple[Tensor, np.ndarray | jax.Array]:
    """Return the tensor of the largest common gain and the largest noise, and whether it dominates all of them."""
    xp = library(tensors, mean)
    shape = symmetric_product(mean[:, :-1], mean[:, :-1])
    gains, noises, cross = tensors[..., :-1, :-1], tensors[..., -1, -1], tensors[..., :-1, -1]
    mean_size: Matrix = xp.abs(mean[:, :-1])
    # Sizes of the entries, for relative tolerances.
    scale = xp.max(xp.abs(gains), axis=0, initial=0.0) + symmetric_product(mean_size, mean_size)
    loud = xp.sqrt(xp.max(xp.abs(xp.diagonal(noises, axis1=1, axis2=2)), axis=0)) + xp.abs(mean[:, -1])
    reach = xp.sqrt(xp.einsum("iiaa->ia", scale))[:, None, :] * loud[:, None]
    size = xp.sum(shape**2)
    # Least squares for s_v in gains_v = s_v M y y' M'.
    multiples = xp.einsum("vijab,ijab->v", gains, shape) / xp.where(size > 0, size, 1.0)
    residual = xp.abs(gains - multiples[:, None, None, None, None] * shape)
    # Largest noise matrix: N_max - N_v >= 0 for all v, judged of correlations.
    largest = noises[xp.argmax(xp.trace(noises, axis1=1, axis2=2))]
    unit = xp.sqrt(xp.diagonal(largest))
    unit = _still(xp.where(unit > 0, unit, 1.0))
    gaps = xp.linalg.eigvalsh(_still(largest - noises) / (unit[:, None] * unit))
    holds = xp.all(residual <= PROPORTIONAL_TOLERANCE * scale)
    holds = holds & xp.all(xp.abs(cross) <= PROPORTIONAL_TOLERANCE * (reach + reach.swapaxes(0, 1)))
    corner = np.zeros((mean.shape[1], mean.shape[1]))
    corner[-1, -1] = 1.0
    # max_v s_v M y y' M' + N_max.
    widened = xp.pad(xp.max(multiples) * shape, [(0, 0), (0, 0), (0, 1), (0, 1)])
    exact = widened + largest[:, :, None, None] * corner
    return exact, holds & (xp.min(gaps, initial=0.0) >= -PROPORTIONAL_TOLERANCE)


def _still(value: Matrix) -> Matrix:
    """Stop the gradient of a number on which a decision depends."""
    return jax.lax.stop_gradient(value) if is_traced(value) else value


def _from_stack(channel: Stack) -> list[QuadraticMap]:
    """Diagonal blocks from each part; off the diagonal, independent parts meet through their means only.

    E[(H_i - M_i) Y Y' (H_j - M_j)'] = D_i Y Y' D_j' with |D| at most the reach of each mean.
    """
    n, mean, start = channel.outputs, channel.moments(1).mean[:-1], 0
    blocks: list[list[QuadraticMap]] = []
    reach = []
    for affine in channel.maps:
        stop = start + affine.outputs
        # Diagonal block, and the reach |H_i - M_i| of the mean of each part.
        moments = second_order(affine)
        low, high = moment_interval(affine, 1)
        xp = library(low, high, mean)
        reach.append(xp.maximum(xp.abs(high[:-1] - mean[start:stop]), xp.abs(low[:-1] - mean[start:stop])))
        blocks.append([_on_diagonal(q, start, n) for q in (moments.spread, moments.shift, moments.power)])
        start = stop
    label = np.repeat(np.arange(len(channel.maps)), [affine.outputs for affine in channel.maps])
    apart = (label[:, None] != label[None, :])[:, :, None, None]
    xp = library(mean, reach)
    far, size = xp.concatenate(reach), xp.abs(mean)
    # Off-diagonal blocks: bounds of |D_i Y Y' D_j'| by the product of reaches.
    cross = symmetric_product(far, far)
    power_cross = _of_signal(symmetric_product(size, far) + symmetric_product(far, size) + cross)
    centers = (0.0, 0.0, _of_signal(symmetric_product(mean, mean)))
    radii = (cross, cross, power_cross)
    return [
        QuadraticMap(sum(q.center for q in maps) + apart * center, sum(q.radius for q in maps) + apart * radius)
        for maps, center, radius in zip(zip(*blocks, strict=True), centers, radii, strict=True)
    ]


def _on_diagonal(block: QuadraticMap, start: int, outputs: int) -> QuadraticMap:
    """The map of outputs start, start + 1, ... among all of them, zero elsewhere."""
    margin = (start, outputs - start - block.center.shape[0])
    widths = [margin, margin, (0, 0), (0, 0)]
    return QuadraticMap(*(library(a).pad(a, widths) for a in (block.center, block.radius)))


def _from_intervals(channel: AbstractRandomAffine, nominal: Moments, mean: Matrix) -> list[QuadraticMap]:
    """Bound spread, shift and power from the interval of each moment: raw - H0 m' - m H0' + H0 H0'."""
    low, high = moment_interval(channel, 2)
    xp = library(low, high, mean)
    # Middle and half width of each moment.
    middle = Moments((low + high) / 2, nominal.outputs, nominal.inputs, 2)
    half = Moments((high - low) / 2, nominal.outputs, nominal.inputs, 2)
    raw_radius = xp.abs(second_moment_tensor(half.matrix, half.outputs, half.inputs))
    mean_radius = half.mean[:-1]
    spread, _, power = _tensors(middle, mean)
    reach = xp.abs(middle.mean[:-1] - mean) + mean_radius
    # Radii add up by the triangle inequality.
    spread_radius = (
        raw_radius + symmetric_product(xp.abs(mean), mean_radius) + symmetric_product(mean_radius, xp.abs(mean))
    )
    return [
        QuadraticMap(spread, spread_radius),
        QuadraticMap(np.zeros(spread.shape), symmetric_product(reach, reach)),
        QuadraticMap(power, _of_signal(raw_radius)),
    ]
