"""A recorded signal through a channel: the channel's own law, losses and memory."""

import numpy as np
import pandas as pd
import pytest

import heliograph as hg

STEPS = 4000
SIGNAL = np.stack([np.sin(np.arange(STEPS)), np.full(STEPS, 2.0)], axis=1)
HOP = hg.hop(hg.Discrete([0.8, 1.2], [0.5, 0.5]), 0.01)
LINK = hg.parallel([hg.amplify_and_forward([HOP, HOP]), hg.perfect()])


def test_moments_are_the_channels():
    z = hg.simulation.transmit(SIGNAL, LINK, seed=3)
    np.testing.assert_array_equal(z[:, 1], SIGNAL[:, 1])
    # z = g h y + noise with E[g h] = 1, Var = 1.04^2 - 1; noise 0.01 (1 + E h^2): five standard errors of the means
    rest = z[:, 0] - SIGNAL[:, 0]
    variance = (1.04**2 - 1) * np.mean(SIGNAL[:, 0] ** 2) + 0.01 * (1 + 1.04)
    assert abs(rest.mean()) < 5 * np.sqrt(variance / STEPS)
    assert abs(rest.var() - variance) < 5 * variance * np.sqrt(2 / STEPS)
    assert np.unique(np.round(z[:, 0], 12)).size > STEPS / 2


def test_the_seed_is_the_draw_and_tables_are_signals():
    item = hg.simulation.transmit(SIGNAL[:50], LINK, seed=1)
    np.testing.assert_array_equal(item, hg.simulation.transmit(pd.DataFrame(SIGNAL[:50]), LINK, seed=1))
    assert np.any(item != hg.simulation.transmit(SIGNAL[:50], LINK, seed=2))
    np.testing.assert_array_equal(
        hg.simulation.transmit(SIGNAL[:50, 0], HOP, 1), hg.simulation.transmit(SIGNAL[:50, :1], HOP, 1)
    )


def test_what_was_not_sent_does_not_arrive_and_nothing_else_is_touched():
    holes = SIGNAL[:50].copy()
    holes[::3, 0] = np.nan
    z, whole = hg.simulation.transmit(holes, LINK), hg.simulation.transmit(SIGNAL[:50], LINK)
    np.testing.assert_array_equal(np.isnan(z), np.isnan(holes))
    np.testing.assert_array_equal(z[~np.isnan(z)], whole[~np.isnan(z)])


def test_losses_come_in_bursts_where_the_link_remembers():
    lost = hg.erasure(hg.perfect(), 0.0)
    z = hg.simulation.transmit(np.ones(STEPS), hg.gilbert_elliott(hg.perfect(), lost, fail=0.02, recover=0.1))[:, 0]
    gone = np.isnan(z)
    assert abs(gone.mean() - 0.02 / 0.12) < 0.08  # 5 standard errors: variance inflated by (1 + .88) / (1 - .88)
    again = gone[1:][gone[:-1]].mean()
    assert abs(again - 0.9) < 5 * np.sqrt(0.09 / gone.sum())


def test_channels_that_vary_are_read_at_the_step():
    channel = hg.model.over_time([hg.hop(float(g), 0.0) for g in range(1, 4)])
    np.testing.assert_array_equal(hg.simulation.transmit([1.0, 1.0, 1.0], channel)[:, 0], [1, 2, 3])
    with pytest.raises(ValueError, match="at most 3 steps"):
        hg.simulation.transmit(np.ones(4), channel)


@pytest.mark.parametrize(
    ("signal", "channel", "words"),
    [
        (SIGNAL, HOP, "signal: expected shape"),
        ([np.inf], HOP, "finite numbers"),
        ([], HOP, "at least one step"),
        ([1.0], 3.0, "a channel"),
        (["a"], HOP, "array of numbers"),
    ],
)
def test_what_is_none(signal, channel, words):
    with pytest.raises(ValueError, match=words):
        hg.simulation.transmit(signal, channel)
