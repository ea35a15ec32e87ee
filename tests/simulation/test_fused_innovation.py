"""The innovation of a fused estimate against the formula written out, and where there is none."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.live.network_step_program import NetworkProgram

F, Q = np.array([[1.0, 1.0], [0.0, 0.9]]), np.diag([0.01, 0.1])
ROWS, NOISES = ([1.0, 0.0], [0.5, 1.0]), (0.5, 2.0)
PLANT = hg.LinearPlant(F, Q, [1.0, 0.0], np.eye(2), states=["position", "speed"])
GAIN, SPREAD, NOISE = 0.9, 0.09, 0.05  # of the gain of 0.6 or 1.2, and of the channel


def network(channel, rules):
    """Two nodes behind this channel, with the best linear filter."""
    sensors = [hg.LinearSensor([row], r) for row, r in zip(ROWS, NOISES, strict=True)]
    nodes = {
        name: hg.Node(s, channel, {"f": hg.linear_filter(PLANT, s, channel)})
        for name, s in zip("ab", sensors, strict=True)
    }
    return hg.Network(PLANT, nodes, {name: hg.Fusion("f", rule) for name, rule in rules.items()})


def test_it_is_that_of_all_that_arrives_by_the_prediction_from_the_fused_estimate():
    """e' S^-1 e, S = M (H P- H' + R) M' + the spread of the gain on E[y y'] + noise; to rounding."""
    link = hg.hop(hg.Discrete([0.6, 1.2], [0.5, 0.5]), NOISE)
    rules = {"bound": hg.fusion.EqualIntersection(), "weights": hg.fusion.MatrixWeights()}
    lanes = NetworkProgram(network(link, rules))
    step, places = lanes.step_rows, {p.filter: p for p in lanes.filter_columns if p.node == "fused"}
    z = np.random.default_rng(0).normal(0.0, 2.0, (8, 2))
    z[3, 0], z[5] = np.nan, np.nan
    state, h, r = step.start, np.array(ROWS), np.diag(NOISES)
    before = dict.fromkeys(places, (np.array([1.0, 0.0]), np.eye(2)))
    mean, spread = np.array([1.0, 0.0]), np.eye(2)  # of the plant before any data
    for k, z_k in enumerate(z):
        row = step(np.concatenate([state, z_k, [k]])[None])[0]
        state, outputs = row[: step.state.size], row[step.state.size :]
        mean, spread = F @ mean, F @ spread @ F.T + Q
        signal = np.diag(h @ (spread + np.outer(mean, mean)) @ h.T + r)
        there = ~np.isnan(z_k)
        for name, place in places.items():
            m, p = before[name]
            e = (z_k - GAIN * h @ F @ m)[there]
            s = GAIN**2 * (h @ (F @ p @ F.T + Q) @ h.T + r) + np.diag(SPREAD * signal + NOISE)
            expected = e @ np.linalg.solve(s[np.ix_(there, there)], e) if there.any() else np.nan
            assert outputs[place.tested.distance] == pytest.approx(expected, rel=1e-11, nan_ok=True)
            assert outputs[place.tested.arrived] == there.sum()
            cut = slice(place.covariance, place.covariance + 4)
            before[name] = outputs[place.mean : place.mean + 2], outputs[cut].reshape(2, 2)


@pytest.mark.slow
@pytest.mark.parametrize("case", ["several modes", "past signals", "a shared channel"])
def test_there_is_none_where_a_state_is_more_than_a_mean_and_a_covariance_or_noises_depend_on_each_other(case):
    rule = hg.fusion.EqualIntersection()
    if case == "several modes":
        item = network(hg.gilbert_elliott(hg.hop(1.0, 0.0), hg.hop(0.2, 0.0), 0.2, 0.3), {"bound": rule})
    elif case == "past signals":
        item = network(hg.hop(1.0, 0.1, delay=hg.Discrete([0, 1], [0.5, 0.5])), {"bound": rule})
    else:
        both = hg.LinearSensor(np.array(ROWS), np.diag(NOISES))
        parts = {
            name: {"f": hg.kalman_filter(PLANT, hg.LinearSensor([row], r))}
            for name, row, r in zip("ab", ROWS, NOISES, strict=True)
        }
        item = hg.Network.sharing(PLANT, both, hg.perfect(2), parts, {"bound": hg.Fusion("f", rule)})
    assert [place.tested for place in NetworkProgram(item).filter_columns] == [None] * 3
