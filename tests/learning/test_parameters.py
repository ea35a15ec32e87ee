"""What is free knows what it is from where it stands; its numbers go to the line and back."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import heliograph as hg
from heliograph.learning.likelihood.transforms import link, map_from_line, map_to_line, slope, unlink
from heliograph.learning.parameters import Parameter, Parameters
from heliograph.numerics.check import COVARIANCE, POSITIVE, PROBABILITY, REAL, SIMPLEX, Domain


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
        "Nakagami shape": Domain(low=0.5),
        "Nakagami power": POSITIVE,
        "hop noise": POSITIVE,
        "hop power": POSITIVE,
        "Rician line of sight": POSITIVE,
        "Rician scale": Domain(low=np.finfo(float).tiny),
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


@pytest.mark.parametrize("domain", [REAL, POSITIVE, PROBABILITY, Domain(low=0.5), Domain(high=2.0)])
@settings(max_examples=20, deadline=None)
@given(x=st.floats(-5.0, 5.0))
def test_the_line_and_back(domain, x):
    value = unlink(domain, x)
    assert link(domain, value) == pytest.approx(x, abs=1e-10)
    step = 1e-6
    turned = (unlink(domain, x + step) - unlink(domain, x - step)) / (2 * step)
    assert slope(domain, value) * turned == pytest.approx(1.0, rel=1e-7)  # rounding over the step


@pytest.mark.parametrize(
    ("domain", "value"),
    [
        (SIMPLEX, np.array([[0.1, 0.2, 0.7], [0.3, 0.3, 0.4]])),
        (COVARIANCE, np.array([[2.0, 0.3], [0.3, 0.1]])),
        (PROBABILITY, np.array([0.2, 0.9])),
    ],
)
def test_vectors_and_matrices_go_to_the_line_and_back(domain, value):
    item = Parameter("it", value, domain)
    x = map_to_line("it", domain, value)
    assert len(x) == item.size
    with jax.enable_x64(True):
        np.testing.assert_allclose(map_from_line(domain, value.shape, jnp.asarray(x)), value, rtol=1e-14)
    known = Parameters((item,)).known(x)
    np.testing.assert_allclose(known["it"], value, rtol=1e-14)
    assert len(Parameters((item,)).entries) == len(item.entries)


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
