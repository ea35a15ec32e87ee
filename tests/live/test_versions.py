"""Streams and timelines that an older version saved are named, and read where the user says so.

`tests/version_0_2` has what version 0.2.0 saved after steps 0 to 3 (`pushed`) of filters of its `network.py` and of a
`Timeline(network, 2.0)`, and in `snapshots.json` the estimates with which that version itself went on (14 digits):
streams those after steps 4 and 5, the timeline that after 5. States held covariances there.
"""

import json
import runpy
from pathlib import Path

import numpy as np
import pytest

import heliograph as hg

WRITTEN = Path(__file__).parents[1] / "version_0_2"
KNOWN = json.loads((WRITTEN / "snapshots.json").read_text())
REMEDY = "heliograph: 0.2.0.*; accept_changes=True goes on with what fits$"


@pytest.fixture(scope="module")
def network() -> hg.Network:
    return runpy.run_path(str(WRITTEN / "network.py"))["network"]


def measured(k: int) -> list[float]:
    return [round(float(np.sin(k)), 3)]


def pushed(timeline: hg.Timeline, begin: int, end: int) -> hg.Timeline:
    for k in range(begin, end):
        timeline.push("inputs", k, k, [0.1])
        for node in "ab":
            timeline.push(node, k, k, measured(k))
    return timeline


def check_known(estimate: hg.model.Estimate, known: list) -> None:
    """As version 0.2.0 knew it, to 1e-9: factors carry the same numbers to a few units of rounding."""
    np.testing.assert_allclose(estimate.mean, known[0], rtol=1e-9)
    np.testing.assert_allclose(estimate.covariance, known[1], rtol=1e-9)


@pytest.mark.parametrize("place", ["a-linear", "a-cubature", "b-linear", "b-imm"])
def test_a_stream_of_the_version_before_goes_on(network, place):
    node, name = place.split("-")
    item, data = network.nodes[node].filters[name], (WRITTEN / f"stream-{place}.npz").read_bytes()
    with pytest.raises(ValueError, match=REMEDY) as refused:
        hg.Stream.restore(item, data)
    assert "\n" not in str(refused.value)
    stream = hg.Stream.restore(item, data, accept_changes=True)
    assert stream.steps == 4
    for k in (4, 5):
        check_known(stream.push(measured(k), [0.1]), KNOWN[place][k - 4])
    again = hg.Stream.restore(item, stream.save())  # of this version now
    np.testing.assert_array_equal(again.push([1.0], [0.1]).mean, stream.push([1.0], [0.1]).mean)


def test_a_stream_goes_on_with_other_numbers_where_its_state_has_the_same_parts(network):
    node, plant = network.nodes["a"], network.plant
    matrix, start = np.asarray(plant.matrix), (plant.initial_mean, plant.initial_covariance)
    more = 2 * np.asarray(plant.noise.covariance)
    noisier = hg.LinearPlant(matrix, more, *start, plant.input_matrix, inputs=plant.inputs, states=plant.states)
    other, stream = hg.linear_filter(noisier, node.sensor, node.channel), hg.Stream(node.filters["linear"])
    before, data = stream.push(measured(0), [0.1]).covariance, stream.save()
    with pytest.raises(ValueError, match=r"numbers: .*accept_changes=True"):
        hg.Stream.restore(other, data)
    after = hg.Stream.restore(other, data, accept_changes=True).push([np.nan], [0.1]).covariance
    np.testing.assert_allclose(after, matrix @ before @ matrix.T + more, rtol=1e-12)
    with pytest.raises(ValueError, match=r"^snapshot: expected the state of what is here .*filter: ") as refused:
        hg.Stream.restore(node.filters["cubature"], data, accept_changes=True)
    assert "accept_changes" not in str(refused.value)  # which would not do


def test_a_timeline_of_the_version_before_goes_on(network):
    data = (WRITTEN / "timeline.npz").read_bytes()
    with pytest.raises(ValueError, match=REMEDY) as refused:
        hg.Timeline.restore(network, data)
    assert "\n" not in str(refused.value)
    with pytest.warns(UserWarning) as said:
        timeline = hg.Timeline.restore(network, data, accept_changes=True)
    lines = [str(line.message) for line in said if "jax: " not in str(line.message)]
    assert lines == [f"timeline, snapshot: heliograph: 0.2.0 -> {hg.__version__}"]
    estimates = pushed(timeline, 4, 6).estimates()
    for node, filters in KNOWN["timeline"].items():
        for name, known in filters.items():
            check_known(estimates[node][name], known)
    hg.Timeline.restore(network, timeline.save())  # of this version now
    final = timeline.final()
    assert list(final.time) == [1.0, 2.0] and np.isfinite(final.estimates["b"]["linear"].mean).all()


@pytest.mark.slow
def test_a_timeline_goes_on_with_other_nodes_where_the_user_says_so(network):
    """The nodes stand in another order, and a third begins: their columns are others, and what they know is not."""
    timeline = pushed(hg.Timeline(network, 2.0), 0, 4)
    nodes = {"c": network.nodes["a"], "b": network.nodes["b"], "a": network.nodes["a"]}
    other = hg.Network(network.plant, nodes, network.fused)
    with pytest.warns(UserWarning) as said:
        again = hg.Timeline.restore(other, timeline.save(), accept_changes=True)
    begun = {str(line.message) for line in said if "begins with the initial law" in str(line.message)}
    assert begun == {f"timeline, snapshot: c/{name} begins with the initial law" for name in ("linear", "cubature")}
    assert any("final rows are estimates of other filters" in str(line.message) for line in said)
    known, new = pushed(timeline, 4, 6).estimates(), pushed(again, 4, 6).estimates()
    hg.Timeline.restore(other, again.save())
    for node in "ab":
        for name, estimate in known[node].items():
            check_known(new[node][name], [estimate.mean, estimate.covariance])


def test_an_older_timeline_of_other_nodes_is_refused(network):
    """It does not say where its states stand, which is known for the same nodes and filters alone."""
    other = hg.Network(network.plant, {"a": network.nodes["a"]})
    with pytest.raises(ValueError, match=r"^snapshot: expected the state of what is here \(.*nodes: a \(1 received\);"):
        hg.Timeline.restore(other, (WRITTEN / "timeline.npz").read_bytes(), accept_changes=True)
