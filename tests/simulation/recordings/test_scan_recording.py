"""Rows of a network in blocks, each after the record of the one before: the records of one run."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg

ROWS = 60
RNG = np.random.default_rng(5)
WALK = hg.LinearPlant([[1.0, 0.1], [0.0, 1.0]], np.diag([1e-3, 0.1]), np.zeros(2), np.eye(2))
PLACE = hg.LinearSensor([[1.0, 0.0]], [[0.5]])
ANGLE = hg.Sensor(lambda x: jnp.sin(x[:1] / 20), [[0.01]], ["angle"])
LOSSY = hg.hop(hg.Discrete([0.5, 1.2], [0.4, 0.6]), 0.1)
STATES = np.cumsum(RNG.normal(size=ROWS))


def network(*more):
    nodes = {
        "near": hg.Node(PLACE, hg.perfect(), {"Kalman": hg.kalman_filter(WALK, PLACE)}),
        "far": hg.Node(PLACE, LOSSY, {"Kalman": hg.linear_filter(WALK, PLACE, LOSSY)}, limits=(-50, 50), stuck=4),
        "camera": hg.Node(ANGLE, hg.perfect(), {"Kalman": hg.extended_filter(WALK, ANGLE)}),
    }
    return hg.Network(WALK, nodes, fused={"joined": hg.Fusion("Kalman", hg.CovarianceIntersection()), **dict(more)})


def measured():
    """Of each node a column; in one an outlier, and equal readings across the end of a block."""
    noise = RNG.normal(size=(3, ROWS))
    z = {"near": STATES + noise[0], "far": STATES + noise[1], "camera": np.sin(STATES / 20) + 0.1 * noise[2]}
    z["near"][[4, 31]], z["near"][44], z["far"][18:23] = np.nan, 1e6, 3.0
    return z


def rows_of(z, begin, end):
    return {name: values[begin:end] for name, values in z.items()}


def check_blocks(item, z):
    """Blocks of 20 rows and one run: the same to the last bit but for a rounding or two, as the programs differ."""
    whole, records = hg.run(item, z), []
    for begin in range(0, ROWS, 20):
        block = rows_of(z, begin, begin + 20)
        records.append(hg.run(item, block, after=records[-1] if records else None))
    assert np.array_equal(np.concatenate([record.time for record in records]), whole.time)
    assert records[-1].origin.step == whole.origin.step == ROWS and records[-1].origin.time == ROWS - 1
    for node, filters in whole.estimates.items():
        for name, estimate in filters.items():
            parts = [record.estimates[node][name] for record in records]
            for field in ("mean", "covariance"):
                joined = np.concatenate([getattr(part, field) for part in parts])
                np.testing.assert_allclose(joined, getattr(estimate, field), rtol=1e-12, atol=1e-12)
    for node, values in whole.refused.items():
        none = np.zeros((20, 1), int)
        joined = np.concatenate([record.refused.get(node, none) for record in records])
        np.testing.assert_array_equal(joined, values)
    return whole


@pytest.mark.filterwarnings("ignore:node")
def test_blocks_are_one_run():
    """Of equal readings some came in the block before."""
    node = hg.Node(PLACE, hg.perfect(), {"Kalman": hg.kalman_filter(WALK, PLACE)}, stuck=4)
    whole = check_blocks(hg.Network(WALK, {"far": node}), {"far": measured()["far"]})
    assert whole.refused["far"].sum()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:node")
def test_blocks_of_several_nodes_are_one_run():
    """One reading is implausible, for which its block is filtered twice."""
    assert set(check_blocks(network(), measured()).refused) == {"near", "far"}


def test_long_blocks_go_in_chunks_from_where_the_one_before_ended():
    """To 1e-10 of a deviation, of which a speed has 0.2 here."""
    z = np.cumsum(RNG.normal(size=70_000))
    node = hg.Node(PLACE, hg.perfect(), {"Kalman": hg.kalman_filter(WALK, PLACE)})
    item = hg.Network(WALK, {"near": node})
    whole, first = hg.run(item, {"near": z}), hg.run(item, {"near": z[:35_000]})
    second = hg.run(item, {"near": z[35_000:]}, after=first)
    means = np.concatenate([record.estimates["near"]["Kalman"].mean for record in (first, second)])
    np.testing.assert_allclose(means, whole.estimates["near"]["Kalman"].mean, rtol=1e-11, atol=1e-11)
    assert second.time[0] == 35_000


def test_what_cannot_go_on_is_refused():
    node = hg.Node(PLACE, hg.perfect(), {"Kalman": hg.kalman_filter(WALK, PLACE)})
    item, two = hg.Network(WALK, {"near": node}), hg.Network(WALK, {"near": node, "far": node})
    z = measured()["far"]
    first, rest = hg.run(item, {"near": z[:30]}), z[30:]
    with pytest.raises(ValueError, match=r"after: expected what hg.run of this network.*another network"):
        hg.run(two, {"near": rest, "far": rest}, after=first)
    with pytest.raises(ValueError, match=r"after: expected what hg\.run of this network"):
        hg.run(item, {"near": rest}, after=rest)
    with pytest.raises(ValueError, match="after: expected no smoothing"):
        hg.run(item, {"near": rest}, after=first, smooth=hg.smoothing.FixedInterval())
    with pytest.raises(ValueError, match=r"time: expected rows behind 29\.0.*got 5\.0"):
        hg.run(item, {"near": rest}, time=np.arange(5.0, 35.0), after=first)
    reports = hg.Network(
        WALK, two.nodes, fused={"reported": hg.Fusion("Kalman", hg.fusion.AllReports(), uplink=hg.fusion.ReportLink())}
    )
    record = hg.run(reports, {"near": z[:30], "far": z[:30]})
    with pytest.raises(ValueError, match=r"after: expected no fusion by reports.*reported"):
        hg.run(reports, {"near": rest, "far": rest}, after=record)


def test_a_gap_between_two_blocks_is_an_unequal_step():
    """Whose rows are a second apart: each block by itself has equal steps."""
    item = hg.Network(WALK, {"near": hg.Node(PLACE, hg.perfect(), {"Kalman": hg.kalman_filter(WALK, PLACE)})})
    day = np.datetime64("2026-03-29", "s")
    first = hg.run(item, {"near": np.zeros(5)}, time=day + np.arange(5))
    hg.run(item, {"near": np.zeros(5)}, time=day + np.arange(5, 10), after=first)
    with pytest.warns(UserWarning, match="time: steps of 1 and 96 seconds"):
        hg.run(item, {"near": np.zeros(5)}, time=day + np.arange(100, 105), after=first)


class Compiled(hg.filters.AbstractFilter):
    """A filter around another, which notes each time that its start is traced: once for each program."""

    base: hg.filters.AbstractFilter
    noted: list = eqx.field(static=True)
    claim: str = eqx.field(static=True, default="exact")
    states: tuple = eqx.field(static=True, default=WALK.states)
    inputs: tuple = eqx.field(static=True, default=())
    received: int = eqx.field(static=True, default=1)

    def init(self):
        self.noted.append("init")
        return self.base.init()

    @hg.filters.predicts
    def predict(self, state, u=(), k=0):
        return self.base.predict(state, u, k)

    @hg.filters.corrects
    def correct(self, state, z, k=0):
        return self.base.correct(state, z, k)

    def estimate(self, state):
        return self.base.estimate(state)


class Notes(list):
    """Notes that a filter may hold as a part that is no array: known by what they are, not by what stands in them."""

    __hash__, __eq__ = object.__hash__, object.__eq__


@pytest.mark.filterwarnings("ignore:.*left out")
@pytest.mark.parametrize("outlier", [0.0, 1e6])
def test_recordings_of_any_length_share_one_program(outlier, monkeypatch):
    """Also where a value is implausible, so that all rows are filtered again with judgements."""
    monkeypatch.setenv("HELIOGRAPH_ENGINE", "native")
    item = Compiled(hg.linear_filter(WALK, PLACE, LOSSY), Notes())
    net = hg.Network(WALK, {"far": hg.Node(PLACE, LOSSY, {"f": item})})
    z = np.where(np.arange(ROWS) == 0, outlier, measured()["far"])
    whole, compiled = hg.run(net, {"far": z}), len(item.noted)
    for rows in (1, 2, 33):
        part = hg.run(net, {"far": z[:rows]})
        np.testing.assert_array_equal(part.estimates["far"]["f"].mean, whole.estimates["far"]["f"].mean[:rows])
    assert len(item.noted) == compiled
