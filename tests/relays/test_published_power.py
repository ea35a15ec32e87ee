"""What relays designed for the receiver save beside published ones, each of which makes its own error least."""

import numpy as np
import pytest

import heliograph as hg
from heliograph_studies.successive_relays.setting import QUIET_START, Setting


@pytest.mark.slow
def test_the_published_error_takes_half_the_power():
    network = Setting().network()
    published = hg.relays.periodic_local_error_design(network)
    power, error = published.total_power(), published.trace("receiver")[1:].sum()

    def error_with(share):
        gains = hg.relays.periodic_relays_for_best_receiver(network, QUIET_START, power_limit=share * power)
        return np.trace(hg.relays.periodic_behind_relays(network, gains), axis1=1, axis2=2).sum()

    assert 1 - error_with(1.0) / error == pytest.approx(0.0759628, abs=1e-5)  # where a descent stops
    assert error_with(1 - 0.5178839) == pytest.approx(error, rel=2e-4)  # the error over the power is steep there
