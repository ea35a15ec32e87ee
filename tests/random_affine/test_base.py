"""One fold over the tree of maps of a channel: each kind by its case, others refused in one line."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.random_affine.base import AbstractRandomAffine, fold, inner_maps, replace_inner_maps
from heliograph.random_affine.combine import Series, Stack, maps_in_series
from heliograph.random_affine.hop import GainAndNoise

HOP = hg.hop(hg.Rayleigh(0.8), 0.1)
RELAYED = hg.amplify_and_forward([HOP, hg.erasure(hg.hop(1.0, 0.2), 0.9)])


def hops(channel, **named):
    count = {GainAndNoise: lambda hop, parts: 1, AbstractRandomAffine: lambda channel, parts: sum(parts)}
    return fold(channel, count, **named)


def test_a_map_has_the_value_of_its_case_from_those_inside():
    assert hops(HOP) == 1 and hops(RELAYED) == 2 and hops(hg.model.with_direct_link(RELAYED, HOP)) == 3
    order = fold(RELAYED, {Series | Stack: lambda _, parts: parts, AbstractRandomAffine: lambda m, _: type(m).__name__})
    assert order == ["GainAndNoise", "Erasure"]


def test_a_map_of_another_kind_is_refused_in_one_line():
    with pytest.raises(ValueError, match=r"^link: expected hops, got Erasure$"):
        fold(RELAYED, {GainAndNoise: lambda *_: 1, Series: lambda _, parts: sum(parts)}, "link", "hops")


def test_a_map_holds_others_in_place_of_its_own():
    first, second = inner_maps(RELAYED)
    assert replace_inner_maps(RELAYED, [first, second]) is RELAYED
    louder = hg.hop(1.0, 0.5)
    changed = replace_inner_maps(RELAYED, [louder, second])
    assert type(changed) is Series and inner_maps(changed) == [louder, second]
    np.testing.assert_array_equal(replace_inner_maps(second, [louder]).arrival, second.arrival)


def test_series_are_opened_at_any_depth():
    nested = Series([HOP, Series([HOP, Series([RELAYED.maps[1]])])])
    assert maps_in_series(nested) == [HOP, HOP, RELAYED.maps[1]] and maps_in_series(HOP) == [HOP]
