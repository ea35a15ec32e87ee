"""What every filter refuses: a state that is none of its own, as when what a step returns was not unpacked."""

import pytest

import heliograph as hg

PLANT, SENSOR = hg.state_space([[0.9]], [[1.0]], 1.0, 1.0, [0.0], 1.0)
FADING = hg.hop(hg.Discrete([0.5, 1.2], [0.4, 0.6]), 0.1)
FILTERS = [
    hg.kalman_filter(PLANT, SENSOR),
    hg.linear_filter(PLANT, SENSOR, FADING),
    hg.cubature_filter(PLANT, SENSOR, FADING),
    hg.filters.late_filter(hg.kalman_filter(PLANT, SENSOR), 2),
]


@pytest.mark.parametrize("item", FILTERS, ids=lambda item: type(item).__name__)
def test_what_is_no_state_is_named(item):
    both = item.step(item.init(), [1.0])
    assert item.estimate(both[0]).mean == pytest.approx(both[1].mean, abs=0)  # the same program's numbers
    for wrong in (None, 3.0, both):
        for call in (item.estimate, item.predict, lambda state: item.correct(state, [1.0])):
            with pytest.raises(ValueError, match=r"state: expected one of the filter's, as its init\(\) returns, got"):
                call(wrong)
