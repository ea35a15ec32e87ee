"""Contract test of a channel: its moments must be those of its samples."""

from itertools import product

import jax
import numpy as np
import scipy

from heliograph.numerics.types import PyTree
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.memories_of_channels import memories
from heliograph.random_affine.modes import JointModes, joint_modes
from heliograph.random_affine.moments.monomials import evaluate_monomials, list_exponents
from heliograph.simulation.runs.map_over_runs import over_runs

FALSE_ALARM = 1e-6  # probability that a correct object fails, shared by all numbers compared (Bonferroni)


def check_random_affine(channel: AbstractRandomAffine, seed: int = 0, samples: int = 20_000, highest: int = 4) -> float:
    """Compare a channel's samples with its joint moments, E[mono_k(z) | y] for k = 1 .. highest, at two points y.

    A channel maps a vector y to z = G y + n with random G and n. mono_k(z) are all products of k of the numbers of
    (z, 1). Wrong moments are found when they differ by more than
    about 6 standard errors, so more samples make the test stricter. Of a map with modes two draws are taken one after
    the other: their moments are compared under the laws of the modes, and jointly E[H_1 x H_2] and
    E[mono_i(z_1) mono_j(z_2)] for i, j = 1 .. highest / 2, which a wrong transition changes. A map with another kind of
    memory has no such moments; only `init` and `draw` are tested: a state that keeps its structure and shapes.

    Args:
        channel: the channel to test.
        seed: seed of the samples (default 0).
        samples: number of samples (default 20,000).
        highest: highest order of the moments (default 4).

    Returns:
        The largest difference between a moment and its mean over the samples, in standard errors of the mean.

    Raises:
        AssertionError: a moment that differs from the samples by more than chance, shapes that disagree.
    """
    generator = np.random.default_rng(seed)
    # Two successive draws of H = [[G, n], [0, 1]] in each sample. All rows of H but the last are M = (G, n), which maps
    # (y, 1) to z = G y + n: (samples, outputs, inputs + 1).
    first_h, second_h = _draw_twice(channel, seed, samples)
    first_m, second_m = first_h[:, :-1], second_h[:, :-1]
    first_y, second_y = channel.example_input(generator), channel.example_input(generator)
    if not channel.remembers:
        differences = [_compare_moments(channel, y, first_m, highest) for y in (first_y, second_y)]
        return max(differences)
    has_modes = bool(memories(channel))
    if not has_modes:  # another kind of memory, of which no moments are declared
        return 0.0
    # With modes: two successive draws, each by itself and jointly, where each has half of the order, rounded up.
    modes = joint_modes(channel, order=-(-highest // 2))
    first_z, second_z = first_m @ np.append(first_y, 1.0), second_m @ np.append(second_y, 1.0)
    worst = _compare_draw_pairs(modes, first_m, second_m)
    return max(worst, _compare_modes(modes, [first_y, second_y], first_z, second_z, highest))


def _compare_moments(channel: AbstractRandomAffine, y: np.ndarray, m: np.ndarray, highest: int) -> float:
    """Compare a channel's E[mono_k(z) | y], k = 1 .. highest, with means over samples of a channel without memory.

    Args:
        channel: the channel, which declares the moments.
        y: its input (inputs,).
        m: draws of M = (G, n), with z = G y + n (samples, outputs, inputs + 1).
        highest: the highest order k; mono_k(z) are all products of k of the numbers of (z, 1).

    Returns:
        The largest difference between samples and moments, in standard errors.
    """
    z, worst = m @ np.append(y, 1.0), 0.0
    for order in range(1, highest + 1):
        expected = channel.moments(order).expect(evaluate_monomials(y, order))
        worst = max(worst, _compare_means(f"order {order}", expected, _evaluate_monomials(z, order)))
    return worst


def _compare_draw_pairs(modes: JointModes, now: np.ndarray, later: np.ndarray) -> float:
    """Compare the mean of the products of two successive draws' entries with the moments.

    A draw is M = (G, n) of z = G y + n. For the modes i and j, E[M_1 x M_2] = sum_ij p_i T_ij E[M | i] x E[M | j] with
    initial probabilities p and transition matrix T, where x is the outer product.

    Args:
        modes: the channel's modes.
        now: first draws (samples, outputs, inputs + 1).
        later: second draws (samples, outputs, inputs + 1).

    Returns:
        The largest difference between samples and moments, in standard errors.
    """
    # Drop the last row of each mean, which belongs to the constant 1.
    means = np.array([mode_map.moments(1).mean[:-1] for mode_map in modes.maps])
    expected = np.einsum("i,ij,iab,jcd->abcd", modes.initial, modes.transition, means, means)
    products = np.einsum("sab,scd->sabcd", now, later)
    return _compare_means("two draws in a row", expected.reshape(-1), products.reshape(len(now), -1))


def _compare_modes(
    modes: JointModes, points: list[np.ndarray], now: np.ndarray, later: np.ndarray, highest: int
) -> float:
    """Compare moments of two successive draws, each and jointly; return the largest difference in standard errors.

    The test of a channel with memory: the moments that it declares, against means over samples that it draws. Monomials
    of order i are all products of i of the numbers (z, 1), and mono(z) is their vector.

    Args:
        modes: the channel as a Markov chain of modes, with the moments of its map in each mode.
        points: the input y of the first draw, and of the second.
        now: what arrives of the first (sample, outputs).
        later: what arrives of the second (sample, outputs).
        highest: order of the moments of one draw; of two together, half of it each.
    """
    initial, transition, worst = np.asarray(modes.initial), np.asarray(modes.transition), 0.0
    # By order, E[mono(z) | mode] of the first and of the second draw, (mode, monomials).
    by_mode = {
        order: [modes.moments(order) @ evaluate_monomials(y, order) for y in points] for order in range(1, highest + 1)
    }
    # Each draw by itself: E[mono(z)] = sum_a P(mode a) E[mono(z) | a], one transition later for the second draw.
    for order, (at_first, at_second) in by_mode.items():
        first, second = initial @ at_first, initial @ transition @ at_second
        worst = max(worst, _compare_means(f"order {order}, first draw", first, _evaluate_monomials(now, order)))
        worst = max(worst, _compare_means(f"order {order}, second draw", second, _evaluate_monomials(later, order)))
    # Both together: E[mono_i(z1) mono_j(z2)'] = sum_ab P(a) P(b | a) E[mono_i(z1) | a] E[mono_j(z2) | b]'.
    for i, j in product(range(1, highest // 2 + 1), repeat=2):
        expected = np.einsum("a,ab,am,bl->ml", initial, transition, by_mode[i][0], by_mode[j][1]).reshape(-1)
        seen = np.einsum("sm,sl->sml", _evaluate_monomials(now, i), _evaluate_monomials(later, j)).reshape(len(now), -1)
        worst = max(worst, _compare_means(f"orders {i} and {j} of two draws in a row", expected, seen))
    return worst


def _draw_twice(channel: AbstractRandomAffine, seed: int, samples: int) -> tuple[np.ndarray, np.ndarray]:
    """Return first and second draws of H = [[G, n], [0, 1]] (samples, outputs + 1, inputs + 1), for z = G y + n.

    On the way it tests the contract of a channel: `init` gives the state of its memory, `draw` the next state and H,
    and `sample` H alone if there is no memory.

    Raises:
        AssertionError: naming what is broken.
    """

    def draw_two(words: jax.Array) -> PyTree:
        """Return (start state, state and draw after a first draw, state and draw after a second, `sample`'s draw).

        `channel.sample` draws with the key of the first draw. A channel that remembers has no `sample`, and the entry
        is (). `words` is the data of a random key.
        """
        # A draw may split its key, so the keys come from one split: none of them can come again from another.
        at_start, at_first, at_second = jax.random.split(jax.random.wrap_key_data(words), 3)
        start = channel.init(at_start)
        after_first, h_1 = channel.draw(start, at_first)
        sampled = () if channel.remembers else channel.sample(at_first)
        return start, after_first, h_1, *channel.draw(after_first, at_second), sampled

    # A state of constant structure, and `draw` equal to `sample` without memory.
    with jax.enable_x64(True):
        words = np.asarray(jax.random.key_data(jax.random.split(jax.random.key(seed), samples)))
        start, after_first, h_1, after_second, h_2, sampled = over_runs(draw_two, words)
        assert channel.remembers or start == (), f"init: expected () of a map that forgets, got {start}"
        states = start, after_first, after_second
        shapes = [jax.tree.map(lambda leaf: (leaf.shape, str(leaf.dtype)), state) for state in states]
        assert shapes[0] == shapes[1] == shapes[2], f"draw: expected a state like init's {shapes[0]}, got {shapes[1]}"
        is_same = channel.remembers or np.array_equal(h_1, sampled, equal_nan=True)
        assert is_same, "draw: expected what sample draws from the same key"
    # Draws of the right shape, whose last row is [0, 1].
    drawn = np.asarray(h_1)
    expected_shape = (samples, channel.outputs + 1, channel.inputs + 1)
    assert drawn.shape == expected_shape, f"draw: expected shape {expected_shape[1:]}, got {drawn.shape[1:]}"
    bottom = np.eye(1, channel.inputs + 1, channel.inputs)
    assert np.array_equal(drawn[:, -1:], np.broadcast_to(bottom, drawn[:, -1:].shape)), "last row: expected [0, 1]"
    return drawn, np.asarray(h_2)


def _evaluate_monomials(z: np.ndarray, order: int) -> np.ndarray:
    """Return all products of `order` of the numbers (z, 1), for each sample of z (samples, outputs).

    They are columns (samples, monomials), in the order of `list_exponents`: the exponents of z's entries and of the 1.
    """
    values = np.column_stack([z, np.ones(len(z))])
    columns = np.arange(values.shape[1])
    powers = list_exponents(len(columns), order)
    return np.column_stack([values[:, np.repeat(columns, exponent)].prod(axis=1) for exponent in powers])


def _compare_means(what: str, expected: np.ndarray | jax.Array, seen: np.ndarray) -> float:
    """Compare means over samples (samples, numbers) with expected ones (numbers,); return the largest difference.

    The difference is in standard errors of the mean. A number that does not vary must agree up to rounding.

    Raises:
        AssertionError: a difference is larger than chance allows.
    """
    standard_error = seen.std(axis=0) / np.sqrt(len(seen))
    difference = np.abs(seen.mean(axis=0) - expected)
    scale = np.abs(seen).max(axis=0) + np.abs(expected)
    is_constant = standard_error <= 1e-12 * scale  # the number does not vary: moments must agree to rounding
    assert np.all(difference[is_constant] <= 1e-9 * scale[is_constant]), f"{what}: a known moment differs"
    ratios = difference[~is_constant] / standard_error[~is_constant]
    # The test is two-sided, and all numbers share the probability of a false alarm.
    limit = float(scipy.stats.norm.isf(FALSE_ALARM / 2 / max(len(ratios), 1)))
    largest = float(ratios.max(initial=0.0))
    assert largest <= limit, f"{what}: a moment differs from the samples by {largest:.1f} standard errors"
    return largest
