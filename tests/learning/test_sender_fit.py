"""Delta, heartbeat and loss of a sender that decides, from a recording with its silences."""

import numpy as np
import pytest

import heliograph as hg

PLANT, SENSOR = hg.LinearPlant([[0.98]], 0.04, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.01)


def recording(trigger, channel, steps, seed=7):
    network = hg.Network(PLANT, {"a": hg.Node(SENSOR, channel, {}, trigger=trigger)})
    return hg.monte_carlo(network, horizon=steps, runs=1, key=seed).measurements["a"][0]


@pytest.mark.slow
def test_delta_and_loss_are_recovered_within_their_intervals():
    """From one recording of 400 steps, some 30 of which came; seed 7: delta .609 (.592 to .609), arrival .72."""

    def build():
        channel = hg.erasure(hg.perfect(), hg.free(0.7, "arrival"))
        trigger = hg.SendOnDelta(hg.free(0.45, "delta"))
        return hg.Network(PLANT, {"a": hg.Node(SENSOR, channel, {}, trigger=trigger)})

    z = recording(hg.SendOnDelta(0.6), hg.erasure(hg.perfect(), 0.8), 400)
    said = list[str]()
    fitted = hg.fit(build, {"a": z}, starts=1, progress=said.append)
    assert said[0].startswith("1 of 1 starts done, -") and said[1:] == ["interval of arrival", "interval of delta"]
    rows = {row.name: row for row in fitted.table}
    assert fitted.converged and isinstance(fitted, hg.learning.SenderFit)
    assert rows["delta"].low <= 0.6 <= rows["delta"].high and rows["delta"].high - rows["delta"].low < 0.1
    assert rows["arrival"].low <= 0.8 <= rows["arrival"].high
    assert fitted.network.nodes["a"].trigger.delta == rows["delta"].estimate


@pytest.mark.slow
def test_the_likelihood_of_heartbeats_is_largest_at_the_true_one():
    channel = hg.erasure(hg.perfect(), 0.8)
    z = recording(hg.SendOnDelta(1.0, heartbeat=5), channel, 300)
    total = {
        h: hg.log_likelihood(hg.event_filter(PLANT, SENSOR, channel, hg.SendOnDelta(1.0, heartbeat=h)), z)
        for h in (4, 5, 6)
    }
    assert total[5] > total[4] + 5 and total[5] > total[6] + 5


def test_without_loss_delta_is_at_most_the_smallest_jump():
    """A larger one forbids that jump: a floor of 1e-6 instead of a density, 13 nats."""
    z = recording(hg.SendOnDelta(0.6), hg.perfect(), 200)
    came = z[~np.isnan(z)]
    smallest = np.abs(np.diff(came)).min()
    below, above = (
        hg.log_likelihood(hg.event_filter(PLANT, SENSOR, hg.perfect(), hg.SendOnDelta(d)), z)
        for d in (smallest * 0.999, smallest * 1.001)
    )
    assert smallest > 0.6 and below > above + 8


@pytest.mark.parametrize("last", [1, 4, 60, 10_000])
def test_who_interrupts_keeps_the_best_so_far(monkeypatch, last):
    """While the maximum is searched, or an interval; before the first point there is nothing to keep."""
    totals = []

    def stopping(filter, z, u):
        if len(totals) == last:
            raise KeyboardInterrupt
        # A parabola in delta, in place of the filter: its maximum is at .5.
        totals.append(-((float(filter.trigger.delta) - 0.5) ** 2) * 1e3)
        return totals[-1]

    def build():
        return hg.Network(
            PLANT, {"a": hg.Node(SENSOR, hg.perfect(), {}, trigger=hg.SendOnDelta(hg.free(0.45, "delta")))}
        )

    monkeypatch.setattr("heliograph.learning.sender_fit.log_likelihood", stopping)
    fitted = hg.fit(build, {"a": np.arange(40.0)[:, None]}, starts=2)
    (row,) = fitted.rows()
    assert fitted.stopped == (last < 10_000) and np.isfinite(row.estimate) and "delta" in str(fitted)
    if fitted.stopped:
        assert fitted.sentences == ("Stopped before the end: this is the best so far.",) and np.isnan(row.low)
        assert fitted.total == max(totals) and fitted.network.nodes["a"].trigger.delta == row.estimate
    else:
        assert row.estimate == pytest.approx(0.5, abs=1e-3) and row.low < 0.5 < row.high  # digits of the search


def test_who_interrupts_before_the_first_point_has_nothing(monkeypatch):
    def stopping(filter, z, u):
        raise KeyboardInterrupt

    monkeypatch.setattr("heliograph.learning.sender_fit.log_likelihood", stopping)

    def build():
        node = hg.Node(SENSOR, hg.perfect(), {}, trigger=hg.SendOnDelta(hg.free(0.45, "delta")))
        return hg.Network(PLANT, {"a": node})

    with pytest.raises(KeyboardInterrupt):
        hg.fit(build, {"a": np.arange(40.0)[:, None]}, starts=1)


def test_a_network_of_several_nodes_is_refused_in_one_line():
    def build():
        node = hg.Node(SENSOR, hg.perfect(), {}, trigger=hg.SendOnDelta(hg.free(0.6)))
        return hg.Network(PLANT, {"a": node, "b": node})

    with pytest.raises(ValueError, match="network whose sender decides: expected one node, to be learned, got"):
        hg.fit(build, {"a": np.zeros((50, 1)), "b": np.zeros((50, 1))})
