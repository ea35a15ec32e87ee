"""Allocation of bits to senders' words under a total rate, for the least steady error of the filter of all."""

from collections.abc import Mapping, Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy.linalg import solve_discrete_are, solve_discrete_lyapunov

from heliograph.filters.linear.linear import linear_filter
from heliograph.model.plant import LinearPlant
from heliograph.model.sensor import LinearSensor
from heliograph.model.words.encoder import Words
from heliograph.numerics.check import InputError, check_count, fail, instance
from heliograph.numerics.lapack import spectral_radius
from heliograph.numerics.module import readable
from heliograph.numerics.types import Float
from heliograph.random_affine.hop import GainAndNoise
from heliograph.random_affine.laws.law import Constant
from heliograph.random_affine.noises.noise import AbstractNoise
from heliograph.random_affine.words.bit_flips import Flips
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node

MOST_BITS = 24  # bits of a word
RELAXATION_STEPS = 300  # of the relaxation
ROUNDING = 1e-13  # relative decrease of the error that is rounding's


@readable
class BitsDesign(NamedTuple):
    """Bits of each sender, the steady trace of the error with them, and a bound below that of any bits.

    Args:
        bits: by node; 0 of one that sends nothing.
        error: trace of the steady covariance of the best linear filter of all words, with subtracted dither.
        bound: that no bits of this total rate have less, in words of at most 24 bits, as all encoders have.
        encoders: of the nodes that send, with these bits and a dither that is taken off.
    """

    bits: dict[str, int]
    error: float
    bound: float
    encoders: dict[str, Words]


def _refuse_overload(network: Network, encoders: Mapping[str, Words]) -> None:
    """Raise ValueError if words of these senders overload in more than 1 of 1000 steps of the steady state.

    Their error is not that of rounding then. The linear filter of the words judges it, from the steady law on.

    Args:
        network: the network, with its plant, sensors and channels.
        encoders: encoder of each node that sends, by the name of the node.
    """
    plant = network.plant
    assert isinstance(plant, LinearPlant) and isinstance(plant.noise, AbstractNoise)
    A = np.asarray(plant.matrix)
    steady_mean = np.linalg.solve(np.eye(len(A)) - A, np.asarray(plant.noise.mean))
    steady_covariance = solve_discrete_lyapunov(A, np.asarray(plant.noise.covariance))
    steady = LinearPlant(A, plant.noise, steady_mean, (steady_covariance + steady_covariance.T) / 2)
    for name, encoder in encoders.items():
        node = network.nodes[name]
        assert isinstance(node, Node)
        try:
            linear_filter(steady, node.sensor, node.channel, encoder=encoder)
        except ValueError as error:
            raise InputError(f"node {name!r} of a design of bits: {error}") from None


class _PlantAndSenders(NamedTuple):
    """Linear plant and its senders, each of which sends one output c_i x + v_i as a word of some bits.

    Args:
        transition: A of the plant (n, n).
        process: covariance Q of its noise (n, n).
        rows: c_i of each sender's sensor (senders, n).
        information: [i, B] = j_i(B), what a word of B bits says of c_i x, as the inverse of a noise variance, for B
            from 0 to MOST_BITS (senders, MOST_BITS + 1).
    """

    transition: Float[np.ndarray, "n n"]
    process: Float[np.ndarray, "n n"]
    rows: Float[np.ndarray, "senders n"]
    information: Float[np.ndarray, "senders bits"]


def design_bits(network: Network, total: int) -> BitsDesign:
    """Return the bits of each sender's words, of `total` bits a step, for a small error of the filter of all nodes.

    A word of B bits rounds y, whose noise has the variance R, to steps of D = 2a / (2^B - 1) in a range of 2a; each bit
    is flipped with the probability p, g = 1 - 2p, and U = D^2 (4^B - 1)/12. The word says as much of y as one
    measurement of the information j(B) = 1 / (R + D^2/12 + U (1/g^2 - 1)). j is convex in B while D^2/12 > R and
    concave for more bits: one more bit may say little where three say much. So bits are added greedily, several at
    once, by the decrease of the error per bit. The steady trace of the covariance is convex in all j. With each j
    replaced by its concave envelope, the best real numbers of bits give the bound, by Frank and Wolfe's steps, whose
    linear part is exact. It is close if steps are no coarser than the noises, and loose for a precise sensor with few
    bits.

    Args:
        network: nodes with encoders, whose ranges and links are kept, of one output each.
        total: bits that all nodes together send at a step.

    Raises:
        ValueError: nodes that do not all send words of one output over links of constant error rates, a sender that
            decides when to transmit, a plant that is not linear or not stable, a range that the steady state leaves in
            more than 1 of 1000 steps, no bit.

    Source: Frank and Wolfe (1956), for the bound; the concave envelope of an S-shaped utility.
    """
    instance("network", network, Network, "a Network").check_sends_each_step("design of bits")
    senders = _collect_plant_and_senders(network)
    budget, names = check_count("total bits", total), list(network.names)
    # Bits (nodes,), and the steady trace of the filter's covariance with them.
    bits = _add_bits_greedily(senders, budget)
    error = _compute_steady_error(senders, _information_of_bits(senders, bits))
    # Encoders with these bits and the ranges of before; nodes without bits send nothing.
    nodes = [node for node in network.nodes.values() if isinstance(node, Node)]
    encoders = {
        name: Words(int(count), node.encoder.low, node.encoder.high, "subtracted")
        for name, node, count in zip(names, nodes, bits, strict=True)
        if count and node.encoder is not None
    }
    _refuse_overload(network, encoders)
    return BitsDesign(
        bits={name: int(count) for name, count in zip(names, bits, strict=True)},
        error=error,
        bound=min(_bound_by_relaxation(senders, budget), error),
        encoders=encoders,
    )


def _collect_plant_and_senders(network: Network) -> _PlantAndSenders:
    """Return plant, sensors and the information of their words of 0 to MOST_BITS bits, as arrays.

    `network`: nodes whose senders send words.

    Raises:
        ValueError: a plant that is not linear and stable; a node without an encoder, or with several outputs.
    """
    plant = network.plant
    expected = "a stable LinearPlant without inputs, as words overload in the end of any other"
    if not isinstance(plant, LinearPlant) or not isinstance(plant.noise, AbstractNoise) or plant.inputs:
        raise fail("plant of a design of bits", expected, type(plant).__name__)
    a, q = np.asarray(plant.matrix), np.asarray(plant.noise.covariance)
    if spectral_radius(a) >= 1:
        raise fail("plant of a design of bits", expected, f"one of spectral radius {spectral_radius(a):.3g}")
    rows = list[np.ndarray]()
    information = list[np.ndarray]()
    for name, node in network.nodes.items():
        if not isinstance(node, Node) or node.encoder is None or len(node.outputs) != 1:
            raise fail(f"node {name!r} of a design of bits", "one with an encoder and one output", "another")
        if not isinstance(node.sensor, LinearSensor):
            raise fail(f"sensor of node {name!r} of a design of bits", "a LinearSensor", type(node.sensor).__name__)
        rows.append(np.asarray(node.sensor.matrix)[0])
        encoder_range = float(np.max(node.encoder.high) - np.min(node.encoder.low))
        variance = float(np.asarray(node.sensor.noise.covariance)[0, 0])
        information.append(_compute_word_information(variance, encoder_range, _find_bit_gain(name, node)))
    return _PlantAndSenders(transition=a, process=q, rows=np.array(rows), information=np.array(information))


def _compute_word_information(variance: float, encoder_range: float, gain: float) -> Float[np.ndarray, " bits"]:
    """Return the information j(B) of words of B = 0 to MOST_BITS bits about the measured value; it is 0 for no bits.

    j(B) = 1 / (R + D^2/12 + U (1/g^2 - 1)), with the step D = range / (2^B - 1), and U = D^2 (4^B - 1)/12 the variance
    of uniform words.

    Args:
        variance: R, the variance of the sensor's noise.
        encoder_range: width of the range of values that the words cover.
        gain: g = 1 - 2p of each bit, where p is the probability that it is flipped.
    """
    counts = np.arange(1, MOST_BITS + 1)
    step = encoder_range / (2.0**counts - 1)
    # Of gain 0, bits that are flipped half of the time, a word says nothing.
    noise = gain**2 * (variance + step**2 / 12) + step**2 / 12 * (4.0**counts - 1) * (1 - gain**2)
    return np.concatenate([[0.0], gain**2 / noise])


def _find_bit_gain(name: str, node: Node) -> float:
    """Return g = 1 - 2p for a node's link, which flips each bit of a word with the constant probability p.

    A word of value q, counted from the middle of its range, arrives with the mean g q: so g is the factor of the signal
    in what arrives, by which `_compute_word_information` finds how much a word says.

    Args:
        name: name of the node, for messages.
        node: the node; its channel carries words of bits.

    Raises:
        ValueError: an error rate that is not constant, or another channel.
    """
    link = node.channel
    if isinstance(link, Flips) and isinstance(link.error, Constant):
        return float(link.gain.moment(1))  # E[1 - 2p], with p a constant
    # Of this class a node with an encoder has only maps that hand on words as they are, such as `perfect()`.
    if isinstance(link, GainAndNoise):
        return 1.0
    raise fail(f"channel of node {name!r} of a design of bits", "decode_and_forward with constant rates, or perfect()",
               type(link).__name__)  # fmt: skip


def _information_of_bits(senders: _PlantAndSenders, bits: Sequence[int] | np.ndarray) -> Float[np.ndarray, " senders"]:
    """Return the information j_i (senders,) of each sender's word of so many bits."""
    found: np.ndarray = senders.information[np.arange(len(senders.rows)), np.asarray(bits)]
    return found


def _compute_steady_covariance(senders: _PlantAndSenders, j: Float[np.ndarray, " senders"]) -> Float[np.ndarray, "n n"]:
    """Return the steady covariance P = (X^-1 + sum_i j_i c_i c_i')^-1 after words of information j.

    X is the covariance before the words, and c_i the row of sender i.

    Args:
        senders: the plant, and the rows c_i of the senders.
        j: information of each sender's word, 1 over its noise's variance; 0 if it sends nothing (senders,).
    """
    # Leave out senders of no bits, whose noise 1 / j is infinite.
    sends = j > 0
    A, Q, C = senders.transition, senders.process, senders.rows[sends]
    if not sends.any():
        open_loop: np.ndarray = solve_discrete_lyapunov(A, Q)
        return open_loop
    R = np.diag(1 / j[sends])
    X = solve_discrete_are(A.T, C.T, Q, R)
    gain = np.linalg.solve(C @ X @ C.T + R, C @ X).T
    P: np.ndarray = X - gain @ C @ X
    symmetric: np.ndarray = (P + P.T) / 2
    return symmetric


def _compute_steady_error(senders: _PlantAndSenders, j: Float[np.ndarray, " senders"]) -> float:
    """Return the trace of the steady covariance after words of this information j."""
    return float(np.trace(_compute_steady_covariance(senders, j)))


def _compute_error_slopes(senders: _PlantAndSenders, j: Float[np.ndarray, " senders"]) -> Float[np.ndarray, " senders"]:
    """Return the derivatives of the steady trace by each j_i: -c_i' P Y P c_i, with Y = I + M' Y M.

    P is the covariance after the words, X before them, and M = (I - K C) A = P X^-1 A maps the error from step to step.

    Args:
        senders: the plant, and the rows c_i of the senders.
        j: information of each sender's word (senders,).
    """
    A, Q = senders.transition, senders.process
    P = _compute_steady_covariance(senders, j)
    X = A @ P @ A.T + Q
    M = P @ np.linalg.pinv(X) @ A
    Y = solve_discrete_lyapunov(M.T, np.eye(len(M)))
    rows_of_P = senders.rows @ P  # row i is c_i' P
    slopes: np.ndarray = -np.einsum("in,nk,ik->i", rows_of_P, Y, rows_of_P)
    return slopes


def _add_bits_greedily(senders: _PlantAndSenders, total: int) -> Float[np.ndarray, " senders"]:
    """Return the bits of each sender, added where the error falls most for a bit, until `total` of them are spent.

    Several may be added at once to one sender; fewer are spent where none lowers the error.

    Args:
        senders: plant, sensors, and the information of a word by its bits.
        total: bits of all words of a step together.
    """
    bits = np.zeros(len(senders.rows), dtype=int)
    error = _compute_steady_error(senders, _information_of_bits(senders, bits))
    while (left := total - bits.sum()) > 0:
        # The largest decrease of the error for each bit, with (sender, bits added, error then) to compare equal ones
        # by.
        best = (0.0, 0, 0, error)
        for i in range(len(bits)):
            for more in range(1, min(left, MOST_BITS - bits[i]) + 1):
                tried = bits.copy()
                tried[i] += more
                error_then = _compute_steady_error(senders, _information_of_bits(senders, tried))
                best = max(best, ((error - error_then) / more, i, more, error_then))
        decrease_per_bit, sender, more, error_then = best
        if decrease_per_bit * more <= ROUNDING * error:
            return bits
        bits[sender] += more
        error = error_then
    return bits


def _bound_by_relaxation(senders: _PlantAndSenders, total: int) -> float:
    """Return a lower bound of the error for any split of this total of bits, with real bits and concave information.

    The error is convex in j, so its tangent at any j is nowhere above it, and the tangent's least value over all splits
    is a bound. The points j come from Frank and Wolfe's steps j + 2 / (k + 2) (best - j). Bits may be real numbers on
    the concave envelope of each sender's information over its bits (`hulls`).

    Args:
        senders: plant, sensors, and the information of a word by its bits.
        total: bits of all words of a step together.
    """
    hulls = [_find_envelope(values) for values in senders.information]
    j, bound = np.zeros(len(hulls)), -np.inf
    for k in range(RELAXATION_STEPS):
        slopes = _compute_error_slopes(senders, j)
        error = _compute_steady_error(senders, j)
        best_on_tangent = _spend_bits(hulls, -slopes, total)
        least_on_tangent = error - float(slopes @ (j - best_on_tangent))
        bound = max(bound, least_on_tangent)
        j = j + 2 / (k + 2) * (best_on_tangent - j)
    return bound


def _find_envelope(values: Float[np.ndarray, " bits"]) -> list[tuple[int, float]]:
    """Return the corners (B, j) of the concave envelope of j(B) = values[B], from B = 0 on, as long as it rises.

    The envelope is the least concave function above j: lines between these corners.
    """
    corners = [(0, float(values[0]))]
    while corners[-1][0] < len(values) - 1:
        # The next corner is the point to which the line from here rises most steeply.
        start, low = corners[-1]
        further = np.arange(start + 1, len(values))
        rises = (values[further] - low) / (further - start)
        if rises.max() <= 0:
            break
        bits = int(further[np.argmax(rises)])
        corners.append((bits, float(values[bits])))
    return corners


def _spend_bits(hulls: list[list[tuple[int, float]]], worth: np.ndarray, total: int) -> Float[np.ndarray, " senders"]:
    """Return the information j_i (senders,) of real bits, `total` in sum, that maximises sum_i worth_i j_i.

    The steepest edges of the envelopes come first, weighted by worth: so each bit goes where it counts most.

    Args:
        hulls: corners (bits, j) of each sender's concave envelope of j over bits, between which j is linear.
        worth: what a unit of each sender's information is worth (senders,).
        total: sum of the bits.
    """
    # Edges between the corners (a bits, information low) and (b bits, information high) of each envelope, as (worth of
    # a bit, sender, bits, information).
    edges = [
        (worth[i] * (high - low) / (b - a), i, b - a, high - low)
        for i, hull in enumerate(hulls)
        for (a, low), (b, high) in pairwise(hull)
    ]
    j = np.zeros(len(hulls))
    left = float(total)
    for _, sender, bits, information in sorted(edges, reverse=True):
        share = min(1.0, left / bits)
        j[sender] += share * information
        left -= share * bits
        if left <= 0:
            break
    return j
