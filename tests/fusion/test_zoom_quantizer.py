"""A quantizer that zooms, as published: what it is meant to do, and where it saturates."""

import numpy as np
import pytest

from heliograph.fusion import ZoomQuantizer
from heliograph.testing import check_quantizer
from tests.fusion.test_quantizer import check_no_number


@pytest.mark.slow
@pytest.mark.parametrize("amplitude", [3.0, [3.0, 2.0]])
def test_contract(amplitude):
    zoom = ZoomQuantizer(41, amplitude, 0.6, 0.15)
    check_quantizer(zoom)
    check_no_number(zoom)
    assert zoom.claim("exact") == "nominal" and zoom.claim("none") == "none"


def test_zoom_follows_the_square_of_what_it_is_given():
    zoom, d = ZoomQuantizer(40, 3.0, 0.6, 0.1), 3.0
    state = zoom.init(1)
    for x in (1.0, -1.5, 0.5):
        np.testing.assert_allclose(state, d, rtol=1e-14)
        state, sent = zoom.step(state, [x])
        np.testing.assert_allclose(sent.error, d / 40, rtol=1e-14)
        d = 0.6 * d + 0.1 * x**2


@pytest.mark.parametrize(("x", "saturates"), [(3.9, True), (4.1, False)])
def test_zoom_saturates_for_small_constants(x, saturates):
    """d tends to growth x^2 / (1 - decay), which is below |x| for |x| < (1 - decay) / growth = 4."""
    zoom = ZoomQuantizer(40, 10.0, 0.6, 0.1)
    state = zoom.init(1)
    for _ in range(60):
        state, sent = zoom.step(state, [x])
    assert sent.saturated[0] == saturates and np.isnan(sent.error[0]) == saturates


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: ZoomQuantizer(8, 1.0, 1.0, 0.1), "decay: expected a number between 0 and 1, got 1.0"),
        (lambda: ZoomQuantizer(8, 1.0, 0.5, -0.1), "growth: expected no negative number"),
    ],
)
def test_bad_quantizers(call, message):
    with pytest.raises(ValueError, match=message):
        call()
