import numpy as np
import pytest

import heliograph as hg
from tests.draws import draw

DRAWS = 2000
LIMIT = 4.5 / np.sqrt(DRAWS)  # of a share's deviation, at most .5 standard deviations each: 9 sigma of the widest


def received(channel, y, seed=0):
    h = draw(channel.sample, DRAWS, seed)
    z = h[:, :-1, :-1] @ np.array(y) + h[:, :-1, -1]
    bottom = np.eye(1, channel.inputs + 1, channel.inputs)
    assert np.array_equal(h[:, -1:], np.broadcast_to(bottom, (DRAWS, 1, channel.inputs + 1)))
    return z


def test_all_components_are_lost_together_and_the_rest_is_the_channel():
    z = received(hg.erasure(hg.random_affine.known([[2.0, 0.0], [0.0, 3.0]]), 0.7), [1.0, 1.0])
    lost = np.isnan(z).all(axis=1)
    assert np.array_equal(np.isnan(z).any(axis=1), lost) and abs(lost.mean() - 0.3) < LIMIT
    assert np.all(z[~lost] == [2.0, 3.0])


@pytest.mark.parametrize(("arrival", "lost"), [(0.0, 1.0), (1.0, 0.0)])
def test_certain_loss_and_certain_arrival(arrival, lost):
    assert np.isnan(received(hg.erasure(hg.perfect(), arrival), [1.0])).mean() == lost


def test_a_relay_forwards_what_was_lost_as_lost():
    chain = hg.amplify_and_forward([hg.hop(1.0, 0.0), hg.erasure(hg.hop(2.0, 0.0), 0.8), hg.hop(3.0, 0.0)])
    z = received(chain, [1.0])
    assert abs(np.isnan(z).mean() - 0.2) < LIMIT and np.all(z[~np.isnan(z)] == 6.0)
    twice = hg.random_affine.Series([hg.erasure(hg.perfect(), 0.8), hg.erasure(hg.perfect(), 0.5)])
    assert abs(np.isnan(received(twice, [1.0])).mean() - 0.6) < LIMIT


def test_components_are_lost_one_by_one():
    """A matrix behind them loses what it makes of lost components, and nothing else."""
    pair = hg.model.with_direct_link(hg.erasure(hg.perfect(), 0.5), hg.perfect())
    z = received(hg.random_affine.Series([pair, hg.random_affine.known([[1.0, 0.0], [0.0, 2.0], [1.0, 1.0]])]), [1.0])
    lost = np.isnan(z)
    assert np.array_equal(lost[:, 0], lost[:, 2]) and not lost[:, 1].any() and np.all(z[:, 1] == 2.0)
    assert abs(lost[:, 0].mean() - 0.5) < LIMIT


def test_a_loss_behind_an_erasure_that_nobody_is_said_of_reads_zero():
    z = received(hg.dropout(hg.erasure(hg.perfect(), 0.5), 0.5), [1.0])
    shares = [np.isnan(z).mean(), np.mean(z == 1.0), np.mean(z == 0.0)]
    np.testing.assert_allclose(shares, [0.25, 0.25, 0.5], rtol=0, atol=LIMIT)


def test_moments_say_what_to_do():
    for channel in (
        hg.erasure(hg.perfect(), 0.5),
        hg.random_affine.Series([hg.erasure(hg.perfect(), 0.5), hg.hop(1.0, 0.1)]),
    ):
        with pytest.raises(ValueError, match=r"without erasures \(give the filter what is inside\), got an erasure"):
            channel.moments(2)
    with pytest.raises(ValueError, match="lift: expected a channel without erasures"):
        hg.random_affine.square(hg.erasure(hg.perfect(), 0.5))
    with pytest.raises(ValueError, match=r"arrival probability: expected a number from 0 to 1, got 1.5"):
        hg.erasure(hg.perfect(), 1.5)


def test_the_parts_of_an_erasure():
    fading = hg.hop(hg.Discrete([0.5, 1.5], [0.5, 0.5], 0.1), 0.2)
    channel = hg.erasure(fading, 0.7)
    assert channel.corner_count() == len(channel.extremes()) == fading.corner_count() > 1
    assert all(part.erases for part in channel.extremes()) and not fading.erases
    mean = hg.model.mean_gain(channel)
    assert mean.erases and mean.base.law.moment(1) == 1.0 and mean.arrival == 0.7


def test_a_filter_of_the_channel_inside_is_exact_behind_known_losses():
    plant = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0)
    sensor, inside = hg.LinearSensor([[1.0]], 0.05), hg.hop(1.2, 0.1)
    with pytest.raises(ValueError, match="without erasures"):
        hg.linear_filter(plant, sensor, hg.erasure(inside, 0.6))
    node = hg.Node(sensor, hg.erasure(inside, 0.6), {"kalman": hg.cubature_filter(plant, sensor, inside)})
    result = hg.monte_carlo(hg.Network(plant, {"n": node}), 10, 2000, 0, hg.Statistics())["n"]["kalman"]
    _, low, high = result.nees_per_dimension(0.9999)
    assert result.claim == "exact" and low < 1 < high and high - low < 0.2
