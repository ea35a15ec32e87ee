"""How far ahead, as it is typed."""

import numpy as np
import pytest

from heliograph.numerics import horizons_in


def test_steps_spans_and_dates_are_read():
    assert horizons_in("12") == 12
    assert horizons_in("5s,1min, 2 h") == [np.timedelta64(n, "s") for n in (5, 60, 7200)]
    assert horizons_in("250ms,2026-12-01") == [np.timedelta64(250, "ms"), np.datetime64("2026-12-01")]
    assert horizons_in("1,5") == [1, 5]
    assert horizons_in("0.5") == [0.5]


@pytest.mark.parametrize("text", ["soon", "5 parsecs", "", "1,,2"])
def test_what_is_no_horizon_is_refused(text):
    with pytest.raises(ValueError, match="horizon: expected a number of steps, or spans and dates"):
        horizons_in(text)
