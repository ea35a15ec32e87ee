"""What a failing property test prints makes the network again."""

import numpy as np
import pytest

import heliograph as hg
from tests import test_properties
from tests.as_code import as_code, printing

HOP = hg.hop(hg.Discrete([0.5, 1.0], [0.3, 0.7], 0.05), 0.1, amplification=1.4)
CHAIN = hg.random_affine.MarkovChain([[0.9, 0.1], [0.3, 0.7]], name="door")  # one without a name is like no other
LINKS = {
    "several hops": hg.amplify_and_forward([HOP, hg.hop(hg.Rayleigh(0.8), hg.Gaussian([[0.2]], [0.1]))]),
    "losses": hg.erasure(hg.dropout(hg.perfect(), 0.7), 0.9),
    "drift": hg.random_affine.Faded(hg.random_affine.Autoregression(0.7, "wind"), 1.0, 0.5, [[1.0]], 0.1),
    "modes": hg.markov_fading([HOP, hg.model.silent(1, 1, 2.0)], CHAIN),
    "atoms": hg.hop(hg.random_affine.Nakagami(2.0), hg.random_affine.FiniteSupport([[-1.0], [1.0 / 3]], [0.25, 0.75])),
}


def made(code):
    scope = {}
    exec(code, scope)
    return scope


@pytest.mark.parametrize("name", LINKS)
def test_a_channel_comes_back(name):
    scope = made(as_code(channel=LINKS[name]))["channel"]
    assert scope == LINKS[name]


def test_a_network_comes_back_to_the_last_digit():
    plant = hg.LinearPlant(np.random.default_rng(0).normal(size=(2, 2)), 0.1, [1 / 3, 0.0], np.eye(2))
    sensor = hg.LinearSensor([[1.0, 0.1]], 0.1, outputs=["left"])
    network = hg.Network(plant, {"node": hg.Node(sensor, LINKS["several hops"], {})})
    z = np.array([[0.1 + 0.2], [np.nan]])
    scope = made(as_code(network=network, z=z, nothing=np.zeros((0, 2))))
    assert scope["network"] == network and np.array_equal(scope["z"], z, equal_nan=True)
    assert scope["nothing"].shape == (0, 2)


def test_a_property_that_fails_prints_it():
    cases = test_properties.networks(3, 2)
    off = np.zeros(len(cases))
    off[7] = np.nan
    with pytest.raises(AssertionError, match=f"1 of {len(cases)} networks are off, the first by nan") as caught:
        test_properties.hold(cases, off, 1e-9, scale=np.arange(float(len(cases))))
    scope = made(str(caught.value).partition("allowed:\n")[2])
    plant, sensor, chains, z = cases[7]
    assert (scope["plant"], scope["sensor"], scope["channel"]) == (plant, sensor, test_properties.channel(chains))
    assert np.array_equal(scope["z"], z) and scope["scale"] == 7.0


def test_a_test_that_draws_one_network_prints_it_when_it_fails():
    with pytest.raises(AssertionError) as caught, printing(channel=LINKS["modes"], seed=3):
        raise AssertionError
    scope = made(caught.value.__notes__[0].removeprefix("What was drawn:"))
    assert scope["channel"] == LINKS["modes"] and scope["seed"] == 3
