"""Laws of what messages tell, learned: the noise as a function of what is declared."""

import jax
import numpy as np
import pytest

import heliograph as hg
from heliograph.model import told

PLANT = hg.LinearPlant([[0.95]], 0.1, [0.0], 1.0)
SENSOR = hg.LinearSensor([[1.0]], 0.05, outputs=["y"])
TRUE = 2.5, 0.3  # noise of a message that declares a: 2.5 a + 0.3


def noisy(scale, floor, law=None):
    return told(lambda a: hg.hop(1.0, scale * a[0] + floor), ["variance"], law=law, typical=[0.1])


def build():
    link = noisy(hg.free(1.0, "scale"), hg.free(0.1, "floor"))
    return hg.Network(PLANT, {"a": hg.Node(SENSOR, link, {"f": hg.linear_filter(PLANT, SENSOR, link)})})


def rows(count):
    law = hg.random_affine.FiniteSupport([[0.1], [1.0]], [0.5, 0.5])
    world = hg.Network(PLANT, {"a": hg.Node(SENSOR, noisy(*TRUE, law=law), {})})
    return hg.simulate(world, count, 3).measurements["a"]


def test_likelihood_of_numbers_that_give_no_law_is_none():
    z = rows(30)
    filter = hg.linear_filter(PLANT, SENSOR, noisy(*TRUE))
    assert np.isfinite(hg.log_likelihood(filter, z))
    z[10, 1] = -1.0
    assert np.isnan(hg.log_likelihood(filter, z))


@pytest.mark.slow
def test_noise_as_a_function_of_what_is_declared():
    z = rows(600)
    found = hg.fit(build, {"a": z})
    intervals = {row.name: (row.low, row.high) for row in found.table}
    for name, value in zip(("scale", "floor"), TRUE, strict=True):
        assert intervals[name][0] < value < intervals[name][1]
    # The search starts where numbers in a function may be any, also such as give negative variances: none of these is
    # taken for silence, whose likelihood of 0 would win.
    at_the_truth = hg.log_likelihood(hg.linear_filter(PLANT, SENSOR, noisy(*TRUE)), z)
    assert at_the_truth < found.best.total < at_the_truth + 5  # two numbers: 1 nat in the mean


@pytest.mark.slow
@pytest.mark.parametrize("limits", [{}, {"x0": (-9.0, None)}])
def test_before_data_it_is_known_that_messages_which_tell_their_gain_identify_the_noises(limits):
    """What is told is drawn by its law: no number of the link is NaN for want of a message."""

    def behind_a_gain():
        plant = hg.LinearPlant([[0.9]], hg.free(0.2, "plant noise"), [0.0], 1.0, limits=limits)
        link = hg.hop(hg.Rayleigh(0.8), hg.free(0.1, "link noise"), known=True)
        return hg.Network(plant, {"a": hg.Node(SENSOR, link, {"f": hg.linear_filter(plant, SENSOR, link)})})

    assert hg.learning.identifiable(behind_a_gain, horizon=100).identified == ("plant noise", "link noise")
    with pytest.raises(ValueError, match=r"expected a law of the numbers: told\(..., law=...\), got none"):
        hg.learning.identifiable(build, horizon=100)


def piloted(scale=0.8, noise=0.1):
    link = hg.hop(hg.Rayleigh(scale), 0.05, known=hg.model.Pilot(noise))
    return hg.Network(PLANT, {"a": hg.Node(SENSOR, link, {"f": hg.linear_filter(PLANT, SENSOR, link)})})


def test_likelihood_behind_a_pilot_has_its_derivatives():
    """To 1e-6, the error of central differences; by the pilot's noise it was NaN, from a root of a gain of 0."""
    z = hg.simulate(piloted(), 100, 3).measurements["a"]

    def likelihood(*numbers):
        return hg.log_likelihood(piloted(*numbers).nodes["a"].filters["f"], z)

    at, h = (0.7, 0.3), 1e-5
    for i in (0, 1):
        above, below = (likelihood(*(x + sign * h * (i == j) for j, x in enumerate(at))) for sign in (1, -1))
        with jax.enable_x64(True):
            slope = float(jax.grad(likelihood, argnums=i)(*at))
        assert abs(slope / ((above - below) / (2 * h)) - 1) < 1e-6


@pytest.mark.slow
def test_a_pilot_s_noise_is_learned():
    """Refused before as a number on which nothing depends."""
    z = hg.simulate(piloted(), 400, 3).measurements["a"]
    (row,) = hg.fit(lambda: piloted(noise=hg.free(0.3, "noise")), {"a": z}, starts=1).table
    assert row.low < 0.1 < row.high < 0.3


@pytest.mark.parametrize("law", [hg.Rayleigh, lambda gain: hg.Discrete([gain, 1.0], [0.5, 0.5])])
def test_a_told_gain_s_law_has_no_part_in_the_likelihood_of_what_it_tells(law):
    """The error blamed NumPy in the user's network, which had called none."""

    def build():
        link = hg.hop(law(hg.free(0.5, "gain")), 0.05, known=True)
        return hg.Network(PLANT, {"a": hg.Node(SENSOR, link, {"f": hg.linear_filter(PLANT, SENSOR, link)})})

    z = hg.simulate(build(), 50, 3).measurements["a"]
    with pytest.raises(
        ValueError, match="free number 'gain': expected one on which the likelihood depends, got one on"
    ):
        hg.fit(build, {"a": z}, starts=1)
