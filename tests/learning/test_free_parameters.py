"""What is free knows what it is from where it stands; its numbers go to the line and back."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import heliograph as hg

LINE = (-np.inf, np.inf)
REAL, POSITIVE, PROBABILITY = ("interval", *LINE), ("interval", 0.0, np.inf), ("interval", 0.0, 1.0)
SIMPLEX, COVARIANCE = ("simplex", *LINE), ("covariance", *LINE)


def network(channel, plant_noise=0.1, sensor_noise=0.1):
    plant = hg.LinearPlant([[0.9]], plant_noise, [0.0], [[1.0]])
    return hg.Network(plant, {"node": hg.Node(hg.LinearSensor([[1.0]], sensor_noise), channel, {})})


def result(build):
    return {item.name: item.domain for item in hg.learning.describe(build).parameters.every}


def test_where_a_number_stands_says_what_it_is():
    def build():
        good = hg.hop(hg.random_affine.Nakagami(hg.free(1.0), hg.free(1.0)), hg.free(0.1), power=hg.free(2.0))
        bad = hg.dropout(hg.hop(hg.random_affine.Rician(hg.free(1.0), hg.free(0.5)), 0.1), hg.free(0.7))
        return network(hg.gilbert_elliott(good, bad, hg.free(0.1), 0.2), hg.free(0.1), hg.free(0.2))

    assert result(build) == {
        "Nakagami shape": ("interval", 0.5, np.inf),
        "Nakagami power": POSITIVE,
        "hop noise": POSITIVE,
        "hop power": POSITIVE,
        "Rician line of sight": POSITIVE,
        "Rician scale": ("interval", np.finfo(float).tiny, np.inf),
        "arrival probability": PROBABILITY,
        "fail": PROBABILITY,
        "process noise": POSITIVE,
        "sensor noise": POSITIVE,
    }


def test_matrices_vectors_and_numbers_of_ones_own():
    def build():
        law = hg.Discrete([hg.free(0.5, "low"), 1.0], hg.free([0.5, 0.5], "chances"))
        scaled = 2 * hg.free(0.3, "mine", "positive")
        plant = hg.LinearPlant([[0.9, hg.free(0.1)], [0.0, 0.8]], hg.free(np.eye(2), "Q"), [0.0, 0.0], np.eye(2))
        sensor = hg.LinearSensor([[1.0, 0.0]], [[scaled]])
        chain = [[hg.free(0.9, "stay"), 0.1], [0.2, 0.8]]
        return hg.Network(
            plant,
            {
                "a": hg.Node(sensor, hg.hop(law, [[hg.free(0.2, "n")]]), {}),
                "b": hg.Node(sensor, hg.markov_fading([0.5, 1.0], chain, 0.1), {}),
            },
        )

    assert result(build) == {
        "low": REAL,
        "chances": SIMPLEX,
        "mine": POSITIVE,
        "plant matrix": REAL,
        "Q": COVARIANCE,
        "stay": PROBABILITY,
        "n": POSITIVE,
    }


def test_one_name_is_one_number_and_places_without_names_are_counted():
    def build():
        shared = [hg.hop(hg.free(0.8, "gain"), hg.free(0.1)) for _ in range(2)]
        return network(hg.amplify_and_forward(shared))

    described = hg.learning.describe(build)
    assert [item.name for item in described.parameters.every] == ["gain", "hop noise", "hop noise 2"]
    built = described.at({"gain": 0.5, "hop noise": 0.3, "hop noise 2": 0.4})
    hops = built.nodes["node"].channel.maps
    assert [float(h.matrix[0, 0] * h.law.value) for h in hops] == [0.5, 0.5]
    assert [float(h.noise.covariance[0, 0]) for h in hops] == [0.3, 0.4]


def test_outside_of_a_fit_a_free_number_is_its_start():
    assert hg.free(0.3) == 0.3 and isinstance(hg.free(0.3), float)
    np.testing.assert_array_equal(hg.free([0.2, 0.8], kind="simplex"), [0.2, 0.8])


def marked(start, kind):
    """The one free number of a network, which is used nowhere or is the shape of a law, at least 1/2."""

    def build():
        law = hg.random_affine.Nakagami(hg.free(start) if kind == "shape" else 1.0, 1.0)
        if kind != "shape":
            hg.free(start, "it", kind)
        return network(hg.hop(law, 0.1))

    return hg.learning.describe(build).parameters


@pytest.mark.parametrize("kind", ["real", "positive", "probability", "shape"])
@settings(max_examples=20, deadline=None)
@given(x=st.floats(-5.0, 5.0))
def test_the_line_and_back(kind, x):
    number, at, step = marked(0.7, kind), np.array([x]), 1e-6
    (value,) = number.entries_at(at)
    assert marked(value, kind).start == pytest.approx(x, abs=1e-10)
    turned = (number.entries_at(at + step) - number.entries_at(at - step)) / (2 * step)
    assert turned / number.jacobian(at)[0] == pytest.approx(1.0, rel=1e-7)  # rounding over the step


@pytest.mark.parametrize(
    ("kind", "value", "size"),
    [
        ("simplex", np.array([[0.1, 0.2, 0.7], [0.3, 0.3, 0.4]]), 4),
        ("covariance", np.array([[2.0, 0.3], [0.3, 0.1]]), 3),
        ("probability", np.array([0.2, 0.9]), 2),
    ],
)
def test_vectors_and_matrices_go_to_the_line_and_back(kind, value, size):
    number = marked(value, kind)
    assert number.size == len(number.start) == size
    np.testing.assert_allclose(number.known(number.start)["it"], value, rtol=1e-14)
    assert len(number.entries) == len(number.entries_at(number.start)) == (3 if kind == "covariance" else value.size)


def test_what_cannot_be_marked_is_refused_in_one_line():
    with pytest.raises(ValueError, match="kind of a free number: expected one of real"):
        hg.free(0.3, kind="variance")
    with pytest.raises(ValueError, match="name of a free number: expected a text, got ''"):
        hg.free(0.3, "")
    with pytest.raises(ValueError, match=r"start of hop noise: expected a start above 0, got 0\.0"):
        hg.learning.describe(lambda: network(hg.hop(1.0, hg.free(0.0))))
    with pytest.raises(ValueError, match=r"one start in all places, 0\.1, got 0\.2"):
        hg.learning.describe(lambda: network(hg.hop(1.0, hg.free(0.1, "n")), hg.free(0.2, "n")))
    with pytest.raises(ValueError, match=r"a function that returns it with hg\.free"):
        hg.learning.describe(network(hg.perfect()))
    with pytest.raises(ValueError, match=r"at least one number marked by hg\.free"):
        hg.learning.describe(lambda: network(hg.perfect()))
