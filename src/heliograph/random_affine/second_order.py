"""What a filter needs of a channel: mean gain, and quadratic maps above spread and shift for every possible law."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.small_matrix import add, contract, diagonal
from heliograph.random_affine.base import AbstractRandomAffine, Moments, check_forgets
from heliograph.random_affine.combine import Stack
from heliograph.random_affine.interval import CORNERS, moment_interval
from heliograph.random_affine.monomials import exponents

PROPORTIONAL_TOLERANCE = 1e-12  # relative: two tensors computed by different sums are one multiple of the other


class QuadraticMap(eqx.Module):
    """A map from second moments W of (y, 1) to a matrix that dominates T_v(W) for every possible law v.

    Value: C:W + diag_i(sum_j R_ij:|W|). The second term is zero where one law dominates all others; otherwise
    T_v(W) - C:W has entries within R:|W|, and a matrix with these row sums on the diagonal dominates it (Gershgorin).

    Shapes: center, radius (m, m, p + 1, p + 1).
    """

    center: np.ndarray
    radius: np.ndarray

    def __call__(self, second_moment: jax.Array, present: jax.Array) -> jax.Array:
        """Evaluate at W of shape (p + 1, p + 1); rows and columns of components that are not present are zero."""
        mask = present[:, None] & present[None, :]
        center = jnp.where(mask, contract(self.center, second_moment), 0.0)
        entries = jnp.where(mask, contract(self.radius, jnp.abs(second_moment)), 0.0)
        return center + diagonal(add([entries[:, j] for j in range(entries.shape[1])]))


class SecondOrder(eqx.Module):
    """Mean and second moments of z = G y + n, nominal where the law is known, dominating where it is not.

    gain, offset: M = E[G] and b = E[n] under the nominal law; spread: E_v[((G - M) y + n - b)(...)'];
    shift: ((M_v - M) y + b_v - b)(...)'; power: E_v[G y y' G'] (the last row and column of W are ignored).

    Shapes: gain (m, p), offset (m,).
    """

    gain: np.ndarray
    offset: np.ndarray
    spread: QuadraticMap
    shift: QuadraticMap
    power: QuadraticMap
    uncertain: bool = eqx.field(static=True)

    @property
    def random_gain(self) -> bool:
        """Whether z depends on y through anything but a known gain."""
        block = np.abs(np.asarray(self.spread.center)[..., :-1, :]) + np.abs(
            np.asarray(self.spread.radius)[..., :-1, :]
        )
        return bool(np.any(block > 0)) or self.uncertain


def second_order(channel: AbstractRandomAffine) -> SecondOrder:
    """Worst cases over the polytope of probabilities: exact for a gain common to all components, else dominating.

    With one scalar gain g, the largest E_v (g - mu)^2, (mu_v - mu)^2 and E_v g^2 are taken at corner laws, where these
    multilinear (or convex) functions of the probabilities have their maxima.

    Raises:
        ValueError: more corner laws than can be listed in a channel that is no series or stack, or one that remembers.
    """
    check_forgets("channel of a filter", channel)
    nominal = channel.moments(2)
    mean = nominal.mean[:-1]
    if _is_known(channel):
        spread, shift, power = _tensors(nominal, mean)
        parts = [QuadraticMap(t, np.zeros_like(t)) for t in (spread, shift, power)]
    elif isinstance(channel, Stack):
        parts = _from_stack(channel)
    elif _few_corners(channel):
        stacks = zip(*(_tensors(extreme.moments(2), mean) for extreme in channel.extremes()), strict=True)
        parts = [_dominate(np.array(tensors), mean) for tensors in stacks]
    else:
        parts = _from_intervals(channel, nominal, mean)
    return SecondOrder(mean[:, :-1], mean[:, -1], parts[0], parts[1], parts[2], not _is_known(channel))


def _few_corners(channel: AbstractRandomAffine) -> bool:
    try:
        return channel.corner_count() <= CORNERS
    except ValueError:  # one law alone has too many corners to list
        return False


def _is_known(channel: AbstractRandomAffine) -> bool:
    try:
        return channel.corner_count() == 1
    except ValueError:
        return False


def second_moment_tensor(matrix: np.ndarray, outputs: int, inputs: int) -> np.ndarray:
    """E[z_i z_j | y] = sum_ab T[i, j, a, b] Y_a Y_b, symmetric in (i, j) and in (a, b), from E[Sym^2(H)]."""
    tensor = np.zeros((outputs, outputs, inputs + 1, inputs + 1))
    columns = [np.repeat(np.arange(inputs + 1), powers) for powers in exponents(inputs + 1, 2)]
    for row, powers in zip(matrix, exponents(outputs + 1, 2), strict=True):
        if powers[-1]:
            continue
        i, j = np.repeat(np.arange(outputs), powers[:-1])
        for value, (a, b) in zip(row, columns, strict=True):
            for first, second in {(a, b), (b, a)}:
                tensor[i, j, first, second] = tensor[j, i, first, second] = value / len({(a, b), (b, a)})
    return tensor


def symmetric_product(a: np.ndarray, b: np.ndarray) -> np.ndarray:
    """(A y)(B y)' as a tensor, made symmetric in the two factors y."""
    forward = np.einsum("ia,jb->ijab", a, b)
    result: np.ndarray = (forward + forward.swapaxes(2, 3)) / 2
    return result


def _tensors(moments: Moments, mean: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Spread about the nominal mean H0, shift of the mean, and power, all of one law."""
    raw = second_moment_tensor(moments.matrix, moments.outputs, moments.inputs)
    own = moments.mean[:-1]
    spread = raw - symmetric_product(mean, own) - symmetric_product(own, mean) + symmetric_product(mean, mean)
    power = raw.copy()
    power[..., -1, :] = power[..., :, -1] = 0.0
    return spread, symmetric_product(own - mean, own - mean), power


def _dominate(tensors: np.ndarray, mean: np.ndarray) -> QuadraticMap:
    """One map above all of the (law, m, m, p + 1, p + 1) tensors."""
    low, high = tensors.min(axis=0), tensors.max(axis=0)
    center, radius = (low + high) / 2, (high - low) / 2
    exact = _dominate_common_gain(tensors, mean)
    if exact is not None:
        return QuadraticMap(exact, np.zeros_like(exact))
    return QuadraticMap(center, radius)


def _dominate_common_gain(tensors: np.ndarray, mean: np.ndarray) -> np.ndarray | None:
    """The dominating tensor where y enters as s_v M y y' M' and the noise part has a largest matrix; None otherwise."""
    shape = symmetric_product(mean[:, :-1], mean[:, :-1])
    gains, noises, cross = tensors[..., :-1, :-1], tensors[..., -1, -1], tensors[..., :-1, -1]
    scale = np.max(np.abs(tensors), initial=0.0)
    size = float(np.sum(shape**2))
    multiples = np.einsum("vijab,ijab->v", gains, shape) / size if size else np.zeros(len(gains))
    residual = np.max(np.abs(gains - multiples[:, None, None, None, None] * shape), initial=0.0)
    if residual > PROPORTIONAL_TOLERANCE * scale or np.max(np.abs(cross), initial=0.0) > PROPORTIONAL_TOLERANCE * scale:
        return None
    largest = noises[np.argmax(np.trace(noises, axis1=1, axis2=2))]
    gaps = np.linalg.eigvalsh(largest - noises)
    if np.min(gaps, initial=0.0) < -PROPORTIONAL_TOLERANCE * scale:
        return None
    result: np.ndarray = np.zeros_like(tensors[0])
    result[..., :-1, :-1] = np.max(multiples) * shape
    result[..., -1, -1] = largest
    return result


def _from_stack(channel: Stack) -> list[QuadraticMap]:
    """Diagonal blocks from each part; off the diagonal, independent parts meet through their means only.

    E[(H_i - M_i) Y Y' (H_j - M_j)'] = D_i Y Y' D_j' with |D| at most the reach of each mean.
    """
    n, columns = channel.outputs, channel.inputs + 1
    center = [np.zeros((n, n, columns, columns)) for _ in range(3)]
    radius = [np.zeros((n, n, columns, columns)) for _ in range(3)]
    reach, mean, start = np.zeros((n, columns)), channel.moments(1).mean[:-1], 0
    for part in channel.maps:
        rows = slice(start, start + part.outputs)
        start += part.outputs
        own = second_order(part)
        low, high = moment_interval(part, 1)
        reach[rows] = np.maximum(np.abs(high[:-1] - mean[rows]), np.abs(low[:-1] - mean[rows]))
        for c, r, quadratic in zip(center, radius, (own.spread, own.shift, own.power), strict=True):
            c[rows, rows], r[rows, rows] = quadratic.center, quadratic.radius
    label = np.repeat(np.arange(len(channel.maps)), [part.outputs for part in channel.maps])
    apart = (label[:, None] != label[None, :])[:, :, None, None]
    size = np.abs(mean)
    gain = np.concatenate([mean[:, :-1], np.zeros((n, 1))], axis=1)
    cross = symmetric_product(reach, reach)
    power_cross = symmetric_product(size, reach) + symmetric_product(reach, size) + cross
    power_cross[..., -1, :] = power_cross[..., :, -1] = 0.0
    center[2] += apart * symmetric_product(gain, gain)
    for r, extra in zip(radius, (cross, cross, power_cross), strict=True):
        r += apart * extra
    return [QuadraticMap(c, r) for c, r in zip(center, radius, strict=True)]


def _from_intervals(channel: AbstractRandomAffine, nominal: Moments, mean: np.ndarray) -> list[QuadraticMap]:
    """Maps from the range of each moment: raw - H0 m' - m H0' + H0 H0' with intervals for raw and m."""
    low, high = moment_interval(channel, 2)
    middle = Moments((low + high) / 2, nominal.outputs, nominal.inputs, 2)
    half = Moments((high - low) / 2, nominal.outputs, nominal.inputs, 2)
    raw_radius = np.abs(second_moment_tensor(half.matrix, half.outputs, half.inputs))
    mean_radius = half.mean[:-1]
    spread, _, power = _tensors(middle, mean)
    reach = np.abs(middle.mean[:-1] - mean) + mean_radius
    power_radius = raw_radius.copy()
    power_radius[..., -1, :] = power_radius[..., :, -1] = 0.0
    spread_radius = (
        raw_radius + symmetric_product(np.abs(mean), mean_radius) + symmetric_product(mean_radius, np.abs(mean))
    )
    return [
        QuadraticMap(spread, spread_radius),
        QuadraticMap(np.zeros_like(spread), symmetric_product(reach, reach)),
        QuadraticMap(power, power_radius),
    ]
