"""When two states of a linear filter are the same: Gaussians, and derivatives of them."""

import numpy as np
import pytest

from heliograph.factors.factored_gaussian import Gaussian
from heliograph.filters.rows import gaussians_in_states

DEVIATION = 2.0
PRIOR = Gaussian(np.array([[1.0]]), np.zeros((1, 0)), np.array([[DEVIATION**2]]))


def sensitive(mean, covariance, unit):
    """A state and its derivatives in a number of which this is the unit."""
    return PRIOR, gaussians_in_states.MomentSlopes(unit * np.array([[mean]]), unit * np.array([[[covariance]]]))


@pytest.mark.parametrize("unit", [1e-9, 1.0, 1e9])
@pytest.mark.parametrize(("share", "same"), [(0.5, True), (2.0, False)])
def test_derivatives_are_the_same_to_a_share_of_the_largest_whatever_the_unit(unit, share, same):
    """The largest is 3 deviations, of the mean; TOLERANCE of them is what may be left of the start."""
    one, apart = sensitive(3 * DEVIATION, 0.0, unit), 3 * share * gaussians_in_states.TOLERANCE
    for other in (
        sensitive((3 + apart) * DEVIATION, 0.0, unit),
        sensitive(3 * DEVIATION, apart * DEVIATION**2, unit),
    ):
        assert gaussians_in_states.find_equal_states(other, one).tolist() == [same]


def test_derivatives_that_are_nothing_beside_those_of_the_start_are_the_same():
    """In a number of the start alone: what is left of it differs from nothing by all of itself."""
    start, left, nothing = (sensitive(mean, 0.0, 1.0) for mean in (1.0, 1e-30, 0.0))
    assert not gaussians_in_states.find_equal_states(left, nothing)[0]
    assert gaussians_in_states.find_equal_states(left, nothing, among=start)[0]
