"""From a network with a sum of links to the arrays of its design, and what the formulas do not cover."""

import numpy as np
import scipy

from heliograph.factors.square_root_update import observe_information, roots_of
from heliograph.model.sensor import LinearSensor
from heliograph.numerics.check import fail
from heliograph.numerics.types import Float
from heliograph.planning.sum_of_links import RELATIVE_ROUNDING, SummedLinks
from heliograph.planning.transmitters import (
    amplify_transmitter,
    compute_sent_powers,
    transmitter_names,
)
from heliograph.random_affine.moments.second_moments import second_order
from heliograph.random_affine.sum_of_maps import Superposed
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node


def is_sum_of_links(network: object) -> bool:
    """Return whether a network is a single node that receives a sum of links.

    `network.common` is set if nodes share a channel, and `network.relays` if relays filter.
    """
    if not isinstance(network, Network) or network.relays is not None or network.common is not None:
        return False
    nodes = list(network.nodes.values())
    return len(nodes) == 1 and isinstance(nodes[0], Node) and isinstance(nodes[0].channel, Superposed)


def find_links_of_sum(node: Node, second: Float[np.ndarray, "m1 m1"]) -> tuple[SummedLinks, Superposed]:
    """Return the links of a node's sum, as arrays of the design, and the sum in which all amplitudes are 1.

    Each link sends one output y_i of the sensor with a random gain g_i, and the receiver gets the sum of all links. An
    amplitude, which the design chooses, multiplies y_i before it is sent; 1 sends y_i as it is.

    Args:
        node: a node with a linear sensor behind a sum of links.
        second: E (y, 1)(y, 1)' of the sensor's outputs.

    Raises:
        ValueError: a sensor or a sum that the formulas do not cover.
    """
    sensor, channel = _require_plain_sum(node)
    # The sum in which each transmitter sends what it measures (an amplification of None).
    unit = channel
    for hop in transmitter_names(channel):
        amplified = amplify_transmitter(unit, hop, factor=None)
        assert isinstance(amplified, Superposed)
        unit = amplified
    # Of each link E g, Var g, and the variance of its own noise n; the noises add up with that of the receiver.
    # spread[i, j, a, b] is the covariance of entries (i, a) and (j, b) of the matrix (g, n) of a link, of one row: the
    # entry 0 of a row is g, and the last one n.
    moments = [second_order(link) for link in unit.maps]
    spreads = [link.nominal.center for link in moments]
    mean = np.array([float(link.mean_gain[0, 0]) for link in moments])
    variance = np.array([float(spread[0, 0, 0, 0]) for spread in spreads])
    floor = sum(float(spread[0, 0, -1, -1]) for spread in spreads) + float(channel.noise.covariance[0, 0])
    # The links' noise: D_ij = E[g_i] E[g_j] R_ij + (i = j) Var(g_i) t_i, with R the noise of the outputs that are sent
    # (`sensor_noise`) and t_i = E y_i^2 (`power`).
    outputs = [of_link[0] for of_link in channel.places]
    power = np.array(list(compute_sent_powers(unit, second).values()))
    sensor_noise = np.asarray(sensor.noise.covariance)[np.ix_(outputs, outputs)]
    # Present amplitudes: sizes and signs from powers and mean gains, each compared with that of an amplitude of 1.
    sizes = np.sqrt(np.array(list(compute_sent_powers(channel, second).values())) / power)
    present_gains = np.array([float(second_order(link).mean_gain[0, 0]) for link in channel.maps])
    signs = np.sign(present_gains) * np.sign(mean)
    links = SummedLinks(
        rows=mean[:, None] * np.asarray(sensor.matrix)[outputs],
        noise=np.outer(mean, mean) * sensor_noise + np.diag(variance * power),
        unit=power,
        floor=floor,
        present=np.where(signs == 0, 1.0, signs) * sizes,
    )
    return links, unit


def _require_plain_sum(node: Node) -> tuple[LinearSensor, Superposed]:
    """Return the sensor and the sum of links of a node; raise ValueError if the formulas of a design do not hold.

    They hold for a linear sensor, and links of one hop each that carry one number, without memory, delays or uncertain
    probabilities, to one sum.
    """
    sensor, channel = node.sensor, node.channel
    if not isinstance(sensor, LinearSensor) or sensor.circular:
        raise _make_no_formula_error("a sensor that varies, is not linear or has angles")
    assert isinstance(channel, Superposed)
    if channel.outputs > 1 or channel.past or channel.remembers or channel.corner_count() > 1:
        raise _make_no_formula_error("several outputs, delays, memory or uncertain probabilities")
    counts = [len(transmitter_names(link)) for link in channel.maps]
    if any(count != 1 for count in counts) or any(link.inputs > 1 for link in channel.maps):
        raise _make_no_formula_error(f"{counts} hops and {[link.inputs for link in channel.maps]} numbers")
    return sensor, channel


def _make_no_formula_error(got: str) -> ValueError:
    """Return the error that names a sum for which there are no formulas."""
    expected = "links of one known hop each, for one number (else give a function of free numbers)"
    return fail("design of a sum of links", expected, got)


def steady_covariance_with_information(
    matrix: Float[np.ndarray, "n n"], process: Float[np.ndarray, "n n"], information: Float[np.ndarray, "n n"]
) -> Float[np.ndarray, "n n"]:
    """Return the steady error covariance of a filter of x+ = A x + w that receives information J in each step.

    Args:
        matrix: A.
        process: Cov w.
        information: J = H' H, as of a measurement H x with noise of covariance I; zero if nothing is received.
    """
    eigenvalues, vectors = np.linalg.eigh(information)
    # An eigenvalue up to the share RELATIVE_ROUNDING of the largest counts as rounding.
    is_above_rounding = eigenvalues > RELATIVE_ROUNDING * max(eigenvalues[-1], 0.0)
    if not is_above_rounding.any():
        return np.asarray(scipy.linalg.solve_discrete_lyapunov(matrix, process))
    H = (vectors[:, is_above_rounding] * np.sqrt(eigenvalues[is_above_rounding])).T
    predicted = scipy.linalg.solve_discrete_are(matrix.T, H.T, process, np.eye(len(H)))
    return observe_information(roots_of(predicted), information).covariance
