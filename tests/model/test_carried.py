"""Which channels leave an angle one."""

import pytest

import heliograph as hg

CHAIN = hg.random_affine.MarkovChain([[0.9, 0.1], [0.3, 0.7]])
CLEAN, NOISY, HALF = hg.hop(1.0, 0.1), hg.hop(1.0, 2.0), hg.hop(0.5, 0.1)
MODES = hg.random_affine.Modes


@pytest.mark.parametrize(
    ("channel", "sent", "result"),
    [
        (hg.perfect(3), (0, 2), (0, 2)),
        (hg.hop(0.5, 0.1), (), ()),
        (hg.parallel([HALF, CLEAN]), (1,), (1,)),
        (hg.parallel([hg.erasure(CLEAN, 0.5), CLEAN]), (0, 1), (0, 1)),
        (hg.amplify_and_forward([CLEAN, hg.erasure(NOISY, 0.3)]), (0,), (0,)),
        (hg.hop(1.0, 0.1, power=4.0, amplification=0.5), (0,), (0,)),
        (hg.model.with_direct_link(NOISY, hg.perfect()), (0,), (0, 1)),
        (hg.random_affine.Mixture([CLEAN, NOISY], [0.5, 0.5]), (0,), (0,)),
        (MODES(CHAIN, [CLEAN, hg.erasure(NOISY, 0.2)]), (0,), (0,)),
        (hg.random_affine.known([[0.0, 1.0], [2.0, 0.0]]), (1,), (0,)),
        (hg.model.silent(1), (0,), ()),
        (hg.model.delayed(CLEAN, 2, timestamped=True), (0,), (0,)),
    ],
)
def test_gain_one_noise_and_losses_that_are_informed(channel, sent, result):
    assert channel.carry_angles(sent) == result


@pytest.mark.parametrize(
    "channel",
    [
        HALF,
        hg.hop(hg.Rayleigh(0.8), 0.1),
        hg.hop(hg.Discrete([0.9, 1.1], [0.5, 0.5]), 0.1),
        hg.hop(-1.0, 0.1),
        hg.dropout(CLEAN, 0.9),
        hg.amplify_and_forward([hg.hop(0.5, 0.1), hg.hop(2.0 + 1e-6, 0.1)]),
        hg.model.autoregressive_fading(1.0, 0.1, 0.9, 0.1),
        MODES(CHAIN, [CLEAN, HALF]),
    ],
)
def test_any_other_gain_is_refused_with_the_remedy(channel):
    with pytest.raises(ValueError, match=r"expected gain 1 on circular outputs .*send sine and cosine"):
        channel.carry_angles((0,))
    sensor = hg.LinearSensor([[1.0]], 0.1, circular=["y0"])
    with pytest.raises(ValueError, match="sine and cosine"):
        hg.cubature_filter(hg.LinearPlant([[1.0]], 0.1, [0.0], 1.0, circular=["x0"]), sensor, channel)


def test_a_sum_of_angle_and_something_else_is_none():
    for rows in ([[1.0, 1.0]], [[1.0, 0.5]]):
        with pytest.raises(ValueError, match="gain 1"):
            hg.random_affine.known(rows).carry_angles((0,))
