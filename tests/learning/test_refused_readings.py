"""Readings that a node refuses count as not arrived where numbers are learned, as they do where filters run."""

import numpy as np
import pytest

import heliograph as hg

CODE, BEYOND = 50, 80  # rows
RULES = {"limits": (-20, 20), "invalid": [-999]}


def network(trigger=None, **rules):
    plant = hg.LinearPlant([[0.9]], hg.free(0.1, "q"), [0.0], 1.0)
    sensor = hg.LinearSensor([[1.0]], hg.free(0.2, "r"))
    return hg.Network(plant, {"gauge": hg.Node(sensor, hg.perfect(), {}, trigger=trigger, **rules)})


@pytest.fixture(scope="module")
def recordings():
    """200 rows with a code and a value beyond the limits, and the same with NaN in their places."""
    random, x, rows = np.random.default_rng(0), 0.0, []
    for _ in range(200):
        x = 0.9 * x + 0.1**0.5 * random.normal()
        rows.append(x + 0.2**0.5 * random.normal())
    given, left = np.array(rows)[:, None], np.array(rows)[:, None]
    given[[CODE, BEYOND], 0], left[[CODE, BEYOND]] = [-999, 50], np.nan
    return given, left


def test_codes_and_values_beyond_limits_are_not_learned_from(recordings):
    """They were: r = 4994 and q = 1.87, where .21 and .12 are right."""
    given, left = recordings
    with pytest.warns(UserWarning, match="1 of 200 values count as not arrived, by"):
        found = hg.fit(lambda: network(**RULES), given, starts=1)
    right = hg.fit(network, left, starts=1)
    assert found.observations == 198 and found.log_likelihood == right.log_likelihood
    assert [row.estimate for row in found.table] == [row.estimate for row in right.table]


def test_nor_behind_a_sender_that_decides(recordings):
    trigger, (given, left) = hg.SendOnDelta(0.3), (part.copy() for part in recordings)
    last = np.inf
    for row, value in enumerate(given[:, 0]):
        if row in (CODE, BEYOND):
            continue
        if abs(value - last) > 0.3:
            last = value
        else:
            given[row] = left[row] = np.nan
    with pytest.warns(UserWarning, match="count as not arrived"):
        found = hg.fit(lambda: network(trigger, **RULES), given, starts=1)
    assert found.log_likelihood == hg.fit(lambda: network(trigger), left, starts=1).log_likelihood
