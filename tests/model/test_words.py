"""Words: rounding, dithers, bits, and what a node with an encoder sends."""

import jax
import numpy as np
import pytest

import heliograph as hg
from straightline import compile

PLANT, SENSOR = hg.LinearPlant([[0.9]], [[0.1]], [0.0], [[0.5]]), hg.LinearSensor([[1.0]], [[0.05]])


def test_words_are_numbered_from_low_to_high():
    encoder = hg.Words(bits=3, low=-1.0, high=2.5)
    assert float(encoder.step) == 0.5
    with jax.enable_x64(True):
        index = encoder.index(np.array([-9.0, -1.24, -0.76, 2.2, 9.0]))
        word, signs = encoder.word(index), encoder.signs(np.array([6.0]))
    assert np.array_equal(index, [0, 0, 0, 6, 7])
    assert np.array_equal(word, [-1, -1, -1, 2, 2.5])
    assert np.array_equal(signs, [[1, -1, -1]])  # 110, the lowest first


def test_a_resolution_gives_the_fewest_bits_that_reach_high():
    encoder = hg.Words(low=-10.0, high=10.0, resolution=0.5)
    assert encoder.bits == 6  # 41 words are more than 32
    assert float(encoder.step) == 0.5
    assert hg.Words(low=0.0, high=3.5, resolution=0.5).bits == 3


@pytest.mark.parametrize("dither", ["triangular", "stochastic", "subtracted"])
def test_rounding_has_the_moments_of_its_dither(dither):
    """Mean 0 whatever y is; 200,000 draws, five standard errors."""
    encoder = hg.Words(bits=6, low=0.0, high=63.0, dither=dither)
    with jax.enable_x64(True):
        keys = np.asarray(jax.random.key_data(jax.random.split(jax.random.key(0), 200_000)))
        send = compile(lambda y, key: encoder.send(y, jax.random.wrap_key_data(key)), np.zeros(1), keys[0], shared=[0])
    for f in (0.0, 0.3, 0.5):
        with jax.enable_x64(True):
            words, numbers = send(np.array([20 + f]), keys)
        error = words[:, 0] - 20 - f
        error = error - numbers[:, 6] if dither == "subtracted" else error
        variance = {"triangular": 1 / 4, "stochastic": f * (1 - f), "subtracted": 1 / 12}[dither]
        assert abs(error.mean()) < 5 * np.sqrt(max(variance, 1e-12) / 200_000)
        assert error.var() == pytest.approx(variance, abs=0.004)


def test_dithers_of_sequence_numbers_are_uniform_and_shared_by_nobody():
    encoder = hg.Words(bits=4, low=-1.0, high=1.0, dither="subtracted")
    d = encoder.dithers("a", np.arange(20_000), 2) / encoder.step
    assert np.abs(d).max() <= 0.5
    assert d.var() == pytest.approx(1 / 12, rel=0.03)
    others = encoder.dithers("b", np.arange(20_000), 2) / encoder.step
    together = np.corrcoef(np.concatenate([d, others, [*d[1:].tolist(), [0, 0]]], axis=1).T)
    assert np.abs(together - np.eye(6)).max() < 0.04  # 5.6 standard errors
    lost = encoder.dithers("a", [5, 9], 2)
    assert np.array_equal(lost, encoder.dithers("a", np.arange(20), 2)[[5, 9]])  # a lost message shifts none
    assert float(encoder.dithers("a", [0])[0, 0]) == pytest.approx(0.0, abs=float(encoder.step) / 2)


def network(encoder, channel, **more):
    return hg.Network(PLANT, {"a": hg.Node(SENSOR, channel, {}, encoder=encoder, **more)})


def test_a_simulated_node_sends_words_whose_bits_flip():
    encoder = hg.Words(bits=4, low=-3.0, high=3.0, dither="subtracted")
    z = hg.simulate(network(encoder, hg.decode_and_forward([0.5])), 4000, 1).measurements["a"]
    index = (z[:, 0] + 3) / encoder.step
    assert np.allclose(index, np.round(index), atol=1e-9)
    assert np.var(index) == pytest.approx((16**2 - 1) / 12, rel=0.05)  # each word is equally likely
    assert np.abs(z[:, 1]).max() <= encoder.step / 2
    assert network(encoder, hg.decode_and_forward([0.5])).nodes["a"].received_names == ("y0", "dither_y0")


def test_words_are_lost_late_and_selected_on_their_way():
    encoder = hg.Words(bits=4, low=-3.0, high=3.0)
    link = hg.model.delayed(hg.erasure(hg.decode_and_forward([0.0]), 0.7), 2)
    net = hg.Network(PLANT, {"a": hg.Node(SENSOR, link, {}, encoder=encoder)})
    z = hg.simulate(net, 2000, 1).measurements["a"][:, 0]
    assert np.isnan(z).mean() == pytest.approx(0.3, abs=0.05)
    assert z[1] == 0.0 or np.isnan(z[1])  # before the first word: the centre
    both = hg.random_affine.Stack([hg.decode_and_forward([0.0]), hg.decode_and_forward([0.3])])
    z = hg.simulate(network(encoder, both), 500, 1).measurements["a"]
    assert z.shape[1] == 2
    assert 0.1 < np.mean(z[:, 0] == z[:, 1]) < 0.4  # (1 - .3)^4 = .24


def test_triggers_compare_words_and_share_them():
    encoder = hg.Words(bits=5, low=-3.0, high=3.0)
    z = hg.simulate(network(encoder, hg.perfect(), trigger=hg.SendOnDelta(0.5)), 300, 1).measurements["a"][:, 0]
    sent = z[~np.isnan(z)]
    assert np.all(np.abs(np.diff(sent)) > 0.5)
    index = (sent + 3) / encoder.step
    assert np.allclose(index, np.round(index), atol=1e-9)
    with pytest.raises(ValueError, match="without flipped bits"):
        network(encoder, hg.decode_and_forward([0.01]), trigger=hg.SendOnDelta(0.5))
    with pytest.raises(ValueError, match="not taken off"):
        network(hg.Words(bits=5, dither="subtracted"), hg.perfect(), trigger=hg.SendOnDelta(0.5))


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: hg.Words(bits=0), "bits of a word"),
        (lambda: hg.Words(bits=30), "at most 24"),
        (lambda: hg.Words(), "bits or resolution"),
        (lambda: hg.Words(bits=4, resolution=0.1), "bits or resolution"),
        (lambda: hg.Words(bits=4, low=1.0, high=0.0), "low below high"),
        (lambda: hg.Words(bits=4, dither="gaussian"), "dither"),
        (lambda: hg.Words(bits=4).dithers("a", [0]), "dithers"),
        (lambda: hg.Words(bits=4, dither="subtracted").dithers("a", [0.5]), "sequence numbers"),
        (lambda: hg.decode_and_forward([]), "at least one"),
        (lambda: hg.decode_and_forward([0.7]), "error rate"),
        (lambda: hg.decode_and_forward([[0.1, 0.2]]), "one number from 0 to 0.5 for all bits"),
        (lambda: hg.decode_and_forward([hg.Rayleigh(1.0)]), "Rayleigh"),
        (lambda: network(hg.Words(bits=4), hg.hop(1.0, 0.1)), "words pass, which are not amplified"),
        (lambda: network(hg.Words(bits=4, low=[0.0, 0.0], high=[1.0, 1.0]), hg.perfect()), "low of the words"),
        (
            lambda: hg.simulate(hg.Network(PLANT, {"a": hg.Node(SENSOR, hg.decode_and_forward([0.1]), {})}), 3, 1),
            "encoder",
        ),
        (lambda: hg.LinearSensor([[1.0]], [[0.1]], resolution=0.0), "resolution of a sensor"),
    ],
)
def test_bad_input_is_one_line(make, message):
    with pytest.raises(ValueError, match=message) as error:
        make()
    assert "\n" not in str(error.value)
