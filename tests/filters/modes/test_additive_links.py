"""Filters behind sums of links with memory: equal to those of all joint modes, of far fewer functions."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.filters.modes.jump_linear_filter import modal_filter
from tests.follow import follow

PLANT = hg.LinearPlant([[0.9, 0.2], [0.0, 0.7]], [[0.1, 0.02], [0.02, 0.2]], [0.5, -1.0], [[1.0, 0.1], [0.1, 0.4]])


def chain(*gains, stay=0.8, name=None):
    """A link that stays in its mode with probability `stay`, of one gain in each."""
    count = len(gains)
    rows = stay * np.eye(count) + (1 - stay) * np.roll(np.eye(count), 1, axis=1)
    start = np.arange(1.0, count + 1) / np.arange(1, count + 1).sum()
    memory = (
        hg.random_affine.MarkovChain(rows, start) if name is None else hg.random_affine.MarkovChain(rows, start, name)
    )
    return hg.random_affine.Modes(memory, [hg.hop(g, 0.05 + 0.1 * i) for i, g in enumerate(gains)])


def sensor(count):
    return hg.LinearSensor(np.random.default_rng(7).normal(size=(count, 2)), 0.1 * np.eye(count) + 0.02)


def run(made, steps, missing=()):
    """All that the filter says over time, of measurements that are the same for all filters."""
    z = np.random.default_rng(3).normal(size=(steps, 1))
    z[list(missing)] = np.nan
    said = follow(made, z)
    return said.mean, said.covariance, said.innovation.covariance, said.innovation.log_likelihood


def memoryless():
    return hg.hop(hg.Rayleigh(0.6), 0.02)


def check_equal(channel, count, parts, steps=6, missing=(2,)):
    """To rounding: both are the best linear estimate."""
    made = hg.linear_filter(PLANT, sensor(count), channel)
    joint = modal_filter(PLANT, sensor(count), channel)
    assert made.claim == joint.claim == "exact"
    assert len(made.init().gaussian.mean) == 3 * parts
    for mine, other in zip(run(made, steps, missing), run(joint, steps, missing), strict=True):
        np.testing.assert_allclose(mine, other, rtol=1e-10, atol=1e-12)


@pytest.mark.slow
def test_chains_of_their_own_need_a_function_for_each_mode_but_the_first():
    """Two and three modes: 1 + 1 + 2 functions, where the joint modes are 6; a link without memory needs none."""
    check_equal(hg.superposed([chain(1.0, 0.2), memoryless(), chain(0.5, -0.3, 1.2)], 0.1), 3, 4)


def test_relays_of_one_signal_share_its_noise():
    sum_of_relays = hg.superposed([chain(1.0, 0.2), chain(0.8, 0.1, stay=0.6), memoryless()], 0.1, same=True)
    check_equal(sum_of_relays, 1, 3)


def test_links_of_one_chain_share_its_functions():
    links = [chain(1.0, 0.2, name="shade"), chain(0.4, 0.9, stay=0.7), chain(-0.5, 0.6, name="shade")]
    check_equal(hg.superposed(links, 0.1), 3, 3)


def test_a_gain_that_drifts_needs_one_function():
    links = [hg.model.autoregressive_fading(1.0, 0.4, 0.8, 0.1), hg.model.autoregressive_fading(0.5, 0.3, 0.6, 0.1)]
    check_equal(hg.superposed(links, 0.1), 2, 3)


@pytest.mark.slow
def test_six_links_need_seven_functions_of_their_64_modes():
    plant = hg.LinearPlant([[0.9]], [[0.1]], [0.5], [[1.0]])
    channel = hg.superposed([chain(1.0 - 0.1 * i, 0.2, stay=0.6 + 0.05 * i) for i in range(6)], 0.1, same=True)
    one = hg.LinearSensor([[1.0]], [[0.05]])
    made, joint = hg.linear_filter(plant, one, channel), modal_filter(plant, one, channel)
    assert len(made.init().gaussian.mean) == 7 * 2
    assert len(joint.init().gaussian.mean) == 64 * 2
    for mine, other in zip(run(made, 3), run(joint, 3), strict=True):
        np.testing.assert_allclose(mine, other, rtol=1e-10)


def test_as_many_links_as_no_joint_modes_could_describe_have_a_filter():
    """2 to the power of 40 joint modes; alike links, so that 40 at once hear 40 times one of them."""
    channel = hg.superposed([chain(1.0, 0.2) for _ in range(40)], 0.1, same=True)
    made = hg.linear_filter(PLANT, sensor(1), channel)
    assert made.claim == "exact"
    assert len(made.init().gaussian.mean) == 41 * 3
