import numpy as np
import pytest
from scipy import stats

from heliograph.filters.scheduled import ScheduledFilter
from heliograph.relays.design import relay_schedules
from heliograph.relays.own_error import own_error_design
from heliograph.relays.receiver import receiver_behind_relays
from heliograph.simulation.simulate_relays import initial_states, simulate_relays
from heliograph.simulation.statistics import BATCHES, Statistics
from tests.relays.relay_problems import example, unusual

FALSE_ALARM = 1e-4  # of each comparison over all its steps


def world(net, design):
    schedules = relay_schedules(net, design)
    receivers = {
        "own": ScheduledFilter(schedules.pop("receiver")),
        "best": ScheduledFilter(receiver_behind_relays(net, design.gains)),
    }
    return schedules, receivers


def worst(statistics):
    """Largest |z| over the steps of the squared error against the claimed trace, and what chance would give."""
    batches = np.trace(statistics.outer, axis1=2, axis2=3) / statistics.count[:, None]
    error = batches.std(axis=0, ddof=1) / np.sqrt(BATCHES)
    claimed = np.trace(statistics.claimed(), axis1=1, axis2=2)
    limit = stats.t.isf(FALSE_ALARM / 2 / len(claimed), BATCHES - 1)
    return np.max(np.abs(batches.mean(axis=0) - claimed) / error), limit


@pytest.mark.parametrize("kind", ["greedy", "another kind"])
def test_designed_and_simulated_errors_agree_at_every_step(kind):
    net, horizon = (unusual(), 7) if kind == "another kind" else (example(), 20)
    design = own_error_design(net, horizon)
    found = simulate_relays(net, *world(net, design), horizon, 3000, 1, Statistics())
    for node, filters in found.items():
        for name, statistics in filters.items():
            largest, limit = worst(statistics)
            assert largest < limit, (node, name)


def test_a_wrong_design_is_seen():
    """Claims for twice the gains that run: the comparison above can fail."""
    net = example()
    design = own_error_design(net, 20)
    schedules, receivers = world(net, design)
    gains = schedules["relay_2"].gains
    short = 0.5 * gains.gain
    moved = gains._replace(gain=short, direct=short, transition=gains.transition + 0.5 * gains.gain @ gains.expected,
                           output=gains.transition + 0.5 * gains.gain @ gains.expected)  # fmt: skip
    schedules["relay_2"] = type(schedules["relay_2"])(moved, schedules["relay_2"].start, "exact")
    found = simulate_relays(net, schedules, receivers, 20, 3000, 1, Statistics())
    largest, limit = worst(found["relay_2"]["own"])
    assert largest > 2 * limit


def test_runs_do_not_depend_on_chunks_or_on_other_receivers():
    net = example()
    schedules, receivers = world(net, own_error_design(net, 6))
    a = simulate_relays(net, schedules, {"own": receivers["own"]}, 6, 70, 3)
    b = simulate_relays(net, schedules, {}, 4, 70, 3, chunk=64)
    assert np.array_equal(a.truth[:, :4], b.truth)
    for name in net.filters:
        np.testing.assert_array_equal(a.measurements[name][:, :4], b.measurements[name])
    assert np.all(np.isnan(a.measurements["relay_1"][:, 0])) and not np.any(np.isnan(a.measurements["receiver"]))
    start = initial_states(net, 70, 3)
    assert start.shape == (70, 3) and np.array_equal(start[:3], initial_states(net, 3, 3))


def test_bad_input_is_refused():
    net = example()
    schedules, receivers = world(net, own_error_design(net, 6))
    with pytest.raises(ValueError, match="relay schedules: expected those of"):
        simulate_relays(net, {"relay_1": schedules["relay_1"]}, receivers, 6, 10, 0)
    with pytest.raises(ValueError, match="schedule of 'relay_1': expected 9 gains"):
        simulate_relays(net, schedules, receivers, 9, 10, 0)
    with pytest.raises(ValueError, match="runs: expected a positive whole number"):
        simulate_relays(net, schedules, receivers, 6, 0, 0)
