"""What may be asked of any map, and the maps inside a map."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.random_affine.base import AbstractRandomAffine, inner_maps, replace_inner_maps
from heliograph.random_affine.moments import ChannelPosition, SignalMoment
from heliograph.random_affine.series_and_stack import Series

HOP = hg.hop(hg.Rayleigh(0.8), 0.1)
RELAYED = hg.amplify_and_forward([HOP, hg.erasure(hg.hop(1.0, 0.2), 0.9)])


class Halved(AbstractRandomAffine):
    """z = y / 2, a map that says no more than it must."""

    @property
    def outputs(self):
        return 1

    @property
    def inputs(self):
        return 1

    def sample(self, key):
        return np.diag([0.5, 1.0])

    def moments(self, order):
        return np.diag(0.5 ** np.arange(order, -1, -1))


def test_a_map_that_says_no_more_has_an_answer_or_refuses_in_one_line():
    halved = Halved()
    assert halved.condition_on_arrival() is halved and halved.list_outcomes()[0].map is halved
    assert halved.carry_angles(()) == () and halved.degree_in("a") == 0 and halved.in_words() == "Halved"
    assert not halved.has_known_gain and not halved.is_silent and halved.detach_outliers() == (halved, None)
    low, high = halved.moment_interval(2)
    np.testing.assert_array_equal(low, high)
    behind = halved.carry_signal(SignalMoment(np.array([[5.0, 2.0], [2.0, 1.0]]), 0.5))
    np.testing.assert_array_equal(behind.second, [[1.25, 1.0], [1.0, 1.0]])
    for ask in (
        lambda: halved.carry_angles((0,)),
        lambda: halved.list_atoms(),
        lambda: halved.disturb_gain(),
        lambda: halved.visit_hops(lambda name, hop, signal: hop, ChannelPosition("", 0, None)),
    ):
        with pytest.raises(ValueError, match=r"^[a-z ]+: expected .*, got Halved$"):
            ask()


def test_a_map_in_others_is_asked_for_what_they_are_asked():
    chain = Series([Halved(), hg.erasure(Halved(), 0.5)])
    assert chain.in_words() == "Halved → Halved, 50% lost" and len(chain.list_outcomes()) == 2
    assert chain.carry_signal(SignalMoment(np.eye(2), 1.0)).arrives == 0.5
    assert isinstance(chain.condition_on_arrival(), Series) and not chain.condition_on_arrival().erases


def test_a_map_holds_others_in_place_of_its_own():
    first, second = inner_maps(RELAYED)
    assert replace_inner_maps(RELAYED, [first, second]) is RELAYED
    louder = hg.hop(1.0, 0.5)
    changed = replace_inner_maps(RELAYED, [louder, second])
    assert type(changed) is Series and inner_maps(changed) == [louder, second]
    np.testing.assert_array_equal(replace_inner_maps(second, [louder]).arrival, second.arrival)


def test_series_are_opened_at_any_depth():
    nested = Series([HOP, Series([HOP, Series([RELAYED.maps[1]])])])
    assert nested.in_series == [HOP, HOP, RELAYED.maps[1]] and HOP.in_series == [HOP]
