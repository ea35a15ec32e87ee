"""Filters that are told numbers with each message, as C."""

import numpy as np
import pytest

import heliograph as hg
from tests.export.device import Device, needs_compiler
from tests.export.test_c_files import LINE, RANGE
from tests.follow import apart

LINKS = {
    "noise": lambda: hg.model.told(lambda a: hg.hop(hg.Rayleigh(0.8), a[0]), ["variance"], typical=[0.1]),
    "gain": lambda: hg.hop(hg.Rayleigh(0.8), 0.1, known=True),
    "pilot": lambda: hg.hop(hg.Rayleigh(0.8), 0.1, known=hg.model.Pilot(0.05)),
}


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("name", LINKS)
@pytest.mark.parametrize(("precision", "most"), [("double", 1e-12), ("float", 1e-5)])
def test_what_a_message_tells_is_used_as_by_run(name, precision, most, tmp_path):
    """To rounding, in deviations, over 300 steps: a seventh of the values and some numbers did not come."""
    filter, rng = hg.linear_filter(LINE, RANGE, LINKS[name]()), np.random.default_rng(0)
    z, u = np.column_stack([rng.normal(size=300), rng.uniform(0.1, 1.5, 300)]), rng.normal(size=(300, 1))
    z[::7, 0] = z[3::11, 1] = np.nan
    filtered = filter.run(z, u)
    device = Device(filter, tmp_path, precision=precision)
    assert max(apart(device.follow(z, u), (filtered.means, filtered.covariances))) < most


@needs_compiler
def test_a_variance_that_is_none_is_refused_and_leaves_the_state(tmp_path):
    device = Device(hg.linear_filter(LINE, RANGE, LINKS["noise"]()), tmp_path)
    assert device.step([1.0, 0.2], [0.0]) == 0
    before = device.state.copy()
    assert device.step([1.0, -0.2], [0.0]) != 0
    np.testing.assert_array_equal(device.state, before)
    assert device.step([1.0, 0.2], [0.0]) == 0
