"""Late links as maps of the line of what was sent: their draws against their moments, in series and side by side."""

import jax
import numpy as np
import pytest

import heliograph as hg
from heliograph.testing import check_random_affine

LAW, LINK = hg.Discrete([0, 2], [0.7, 0.3]), hg.hop(hg.Rayleigh(0.8), 0.1)
CHAIN = hg.random_affine.MarkovChain([[0.8, 0.2], [0.4, 0.6]])
delayed = hg.model.delayed


@pytest.mark.parametrize(
    "channel",
    [
        hg.model.with_direct_link(hg.hop(0.5, 0.1, delay=LAW), LINK),
        delayed(LINK, CHAIN, timestamped=True),
    ],
    ids=["random", "chain"],
)
def test_samples_match_moments(channel):
    check_random_affine(channel, highest=2, samples=5_000)


@pytest.mark.slow
def test_what_is_late_stands_where_it_was_sent():
    """Components of y and times of the line, of two channels side by side."""
    both = hg.parallel([hg.hop(2.0, 0.0, delay=2), hg.hop(3.0, 0.0, dimension=2)])
    assert (both.past, both.inputs, both.outputs) == (2, 9, 3)
    h = np.asarray(both.sample(jax.random.key(0)))
    line = np.arange(9.0)  # y_k = (0, 1, 2), y_{k-1} = (3, 4, 5), y_{k-2} = (6, 7, 8)
    np.testing.assert_array_equal(h[:-1, :-1] @ line, [2 * 6.0, 3 * 1.0, 3 * 2.0])
    known = delayed(hg.hop(2.0, 0.0), 1, timestamped=True)
    np.testing.assert_array_equal(known.sample(jax.random.key(0))[:-1, :-1], [[0, 2], [0, 0]])
    np.testing.assert_array_equal(known.sample(jax.random.key(0))[:-1, -1], [0, 1])


@pytest.mark.slow
def test_a_relay_holds_what_it_drew():
    """Draws of relays that are late by chance: what was drawn a step before stands one place further on."""
    channel = hg.amplify_and_forward([LINK, hg.hop(1.0, 0.0, delay=hg.Discrete([0, 1], [0.5, 0.5]))])
    assert (channel.past, channel.inputs, channel.remembers) == (1, 2, True)
    assert check_random_affine(channel, samples=10) == 0
    held = channel.line.maps[0]
    (inner, before), now = held.draw(held.init(jax.random.key(0)), jax.random.key(1))
    _, later = held.draw((inner, before), jax.random.key(2))
    assert now.shape == later.shape == (3, 3)
    np.testing.assert_array_equal(now[1], np.zeros(3))
    np.testing.assert_array_equal(later[1], [0.0, now[0, 0], now[0, 2]])


def test_delays_in_series_add_up():
    hops = [hg.hop(0.5, 0.1, delay=LAW), hg.hop(hg.Rayleigh(0.8), 0.2, delay=1), LINK, hg.hop(2.0, 0.1, delay=2)]
    chain = hg.amplify_and_forward(hops)
    at_once = [hg.hop(0.5, 0.1), hg.hop(hg.Rayleigh(0.8), 0.2), LINK, hg.hop(2.0, 0.1)]
    same = delayed(hg.amplify_and_forward(at_once), hg.Discrete([3, 5], [0.7, 0.3]))
    np.testing.assert_allclose(chain.moments(2).matrix, same.moments(2).matrix, rtol=1e-13)
    assert hg.amplify_and_forward([LINK, hg.hop(1.0, 0.1, delay=2)]).past == 2
    assert hg.amplify_and_forward(at_once).past == 0


REFUSED = {
    "time stamps: expected those of one": lambda: hg.amplify_and_forward([LINK, delayed(LINK, LAW, timestamped=True)]),
    "series: expected links each delayed": lambda: hg.amplify_and_forward(
        [LINK, hg.model.with_direct_link(delayed(LINK, 1), LINK)]
    ),
    "time stamps: expected those of one link": lambda: hg.amplify_and_forward(
        [delayed(LINK, LAW, timestamped=True), delayed(LINK, 1)]
    ),
    "link before a delay: expected one that forgets": lambda: hg.amplify_and_forward(
        [hg.gilbert_elliott(LINK, LINK, 0.1, 0.2), delayed(LINK, 1)]
    ),
    "delayed link: expected one that is not late": lambda: delayed(delayed(LINK, 1), 1),
    "delay: expected a number of steps": lambda: delayed(LINK, 0.5),
    "delay: expected a whole number": lambda: delayed(LINK, hg.Discrete([0.5, 1.0], [0.5, 0.5])),
    "expected one that forgets, got DelayedLink": lambda: hg.amplify_and_forward(
        [delayed(LINK, CHAIN), delayed(LINK, 1)]
    ),
    "output, such as perfect.1., got one that takes 2": lambda: hg.linear_filter(
        hg.LinearPlant([[1.0]], 1.0, [0.0], 1.0), hg.LinearSensor([[1.0]], 1.0), delayed(hg.hop(1, 1, dimension=2), 1)
    ),
}


@pytest.mark.parametrize("expected", REFUSED)
def test_refusals(expected):
    with pytest.raises(ValueError, match=expected):
        REFUSED[expected]()
