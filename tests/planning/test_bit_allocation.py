"""Bits of the senders' words under a total rate."""

from itertools import product

import numpy as np
import pytest

import heliograph as hg

A = np.array([[0.95, 0.1], [0.0, 0.8]])


def senders(ranges, noises, rates, rows):
    plant = hg.LinearPlant(A, np.diag([0.05, 0.2]), [0.0, 0.0], np.eye(2))
    nodes = {}
    for i, (reach, noise, p, row) in enumerate(zip(ranges, noises, rates, rows, strict=True)):
        encoder = hg.Words(bits=4, low=-reach, high=reach, dither="subtracted")
        sensor = hg.LinearSensor([row], [[noise]])
        nodes[f"n{i}"] = hg.Node(sensor, hg.decode_and_forward([p]), {}, encoder=encoder)
    return hg.Network(plant, nodes)


NETWORK = senders([5.0, 5.0, 8.0], [1e-4, 0.05, 0.01], [0.0, 0.001, 0.0], [[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])


def error_of(network, bits):
    """Steady trace by a recursion of the covariance, of the words that are sent."""
    p, rows, noise = np.eye(2), [], []
    for (node, count), rate in zip(zip(network.nodes.values(), bits, strict=True), (0.0, 0.001, 0.0), strict=True):
        if count:
            step = float(node.encoder.high - node.encoder.low) / (2**count - 1)
            power, g = step**2 * (4**count - 1) / 12, 1 - 2 * rate
            rows.append(np.asarray(node.sensor.matrix)[0])
            noise.append(float(node.sensor.noise.covariance[0, 0]) + step**2 / 12 + power * (1 / g**2 - 1))
    c, r = np.array(rows), np.diag(noise)
    for _ in range(400):
        p = A @ p @ A.T + np.diag([0.05, 0.2])
        p = p - p @ c.T @ np.linalg.solve(c @ p @ c.T + r, c @ p)
    return np.trace(p)


def test_bits_are_the_best_of_all_and_the_bound_is_below():
    """Of 10 bits for three senders, all 66 ways enumerated."""
    found = hg.planning.design_bits(NETWORK, 10)
    ways = {bits: error_of(NETWORK, bits) for bits in product(range(11), repeat=3) if sum(bits) == 10}
    assert sum(found.bits.values()) == 10
    assert found.error == pytest.approx(ways[tuple(found.bits.values())], rel=1e-9)
    assert found.error <= 1.002 * min(ways.values())
    assert found.bound <= min(ways.values())
    assert {name: words.bits for name, words in found.encoders.items()} == {n: b for n, b in found.bits.items() if b}


def test_the_bound_is_close_where_noises_are_no_finer_than_words():
    network = senders([5.0, 5.0, 8.0], [0.05, 0.1, 0.1], [0.0, 0.001, 0.0], [[1.0, 0.0], [0.0, 1.0], [1.0, 1.0]])
    found = hg.planning.design_bits(network, 15)
    assert (1 - 1e-6) * found.error < found.bound <= found.error


def test_a_sender_of_a_precise_sensor_gets_several_bits_or_none():
    """j is convex in B while D^2/12 is above R: of two bits none is wasted on half of a word."""
    few = hg.planning.design_bits(NETWORK, 2)
    assert max(few.bits.values()) == 2
    assert few.bound <= few.error


@pytest.mark.slow
def test_more_bits_are_never_worse():
    errors = [hg.planning.design_bits(NETWORK, total).error for total in (1, 3, 6, 9, 14)]
    assert np.all(np.diff(errors) < 0)


def lone(encoder, plant=None, rate=0.0, **options):
    """One sender of words over +-8 of a plant that is seldom beyond +-4."""
    moving = hg.LinearPlant([[0.95]], 0.1, [0.0], 1.0) if plant is None else plant
    node = hg.Node(hg.LinearSensor([[1.0]], 0.05), hg.decode_and_forward([rate]), {}, encoder=encoder, **options)
    return hg.Network(moving, {"a": node})


WIDE = hg.Words(bits=1, low=-8.0, high=8.0)


def test_bits_that_are_flipped_half_of_the_time_are_worth_nothing():
    found = hg.planning.design_bits(lone(WIDE, rate=0.5), 4)
    assert found.bits == {"a": 0} and found.encoders == {}
    assert found.error == pytest.approx(0.1 / (1 - 0.95**2), rel=1e-12)


def test_no_bits_are_spent_on_rounding():
    """The second state dies out, so that a word of it says nothing of the steady state, to the last digit."""
    plant = hg.LinearPlant([[0.95, 0.0], [0.0, 0.5]], np.diag([0.1, 0.0]), [0.0, 0.0], np.eye(2))
    node = hg.Node(hg.LinearSensor([[0.0, 1.0]], 0.1), hg.perfect(), {}, encoder=WIDE)
    assert hg.planning.design_bits(hg.Network(plant, {"a": node}), 4).bits == {"a": 0}


@pytest.mark.parametrize(
    "network",
    [
        lambda: lone(hg.Words(bits=1, low=-0.5, high=0.5)),  # half of the steady law is beyond
        lambda: lone(hg.Words(bits=1, low=20.0, high=22.0)),
        lambda: lone(WIDE, hg.LinearPlant([[0.95]], hg.Gaussian([[0.1]], [5.0]), [0.0], 1.0)),  # of mean 100
    ],
)
def test_a_range_that_the_steady_state_leaves_is_refused(network):
    """Its words overload, and their error is not that of rounding: 0.036 was said where the filter is refused."""
    with pytest.raises(hg.InputError, match="node 'a' of a design of bits: range of the words: expected an overload"):
        hg.planning.design_bits(network(), 6)


def test_a_sender_that_decides_is_refused():
    with pytest.raises(hg.InputError, match="expected senders that transmit at each step, got triggers of"):
        hg.planning.design_bits(lone(WIDE, trigger=hg.Periodic(3)), 6)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda: hg.planning.design_bits(NETWORK, 0), "total bits"),
        (lambda: hg.planning.design_bits("network", 3), "a Network"),
        (
            lambda: hg.planning.design_bits(
                hg.Network(
                    hg.LinearPlant([[1.1]], 0.1, [0.0], 1.0),
                    {"a": hg.Node(hg.LinearSensor([[1.0]], 0.1), hg.perfect(), {}, encoder=hg.Words(bits=3))},
                ),
                3,
            ),
            "stable",
        ),
        (
            lambda: hg.planning.design_bits(
                hg.Network(
                    hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0),
                    {"a": hg.Node(hg.LinearSensor([[1.0]], 0.1), hg.perfect(), {})},
                ),
                3,
            ),
            "one with an encoder and one output",
        ),
    ],
)
def test_bad_input_is_one_line(change, message):
    with pytest.raises(ValueError, match=message) as error:
        change()
    assert "\n" not in str(error.value)
