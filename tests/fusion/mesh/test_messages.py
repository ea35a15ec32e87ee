"""Messages between neighbours that come late or quantized: by hand, by Monte Carlo, and from a recording."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.fusion import EqualIntersection, UniformQuantizer
from tests.fusion.mesh.worlds import NODES, PLANT, RING, models, network, senders

LEVELS, AMPLITUDE, STEPS, RUNS = 401, 60.0, 20, 300
LATE = hg.erasure(hg.model.delayed(hg.perfect(), hg.Discrete([0, 1, 2], [0.5, 0.3, 0.2]), timestamped=True), 0.8)
QUANTIZERS = {"wide": UniformQuantizer(LEVELS, AMPLITUDE), "tight": UniformQuantizer(21, 3.0)}
CASES = [("late", "wide"), ("quantized", "wide"), ("both", "wide"), ("quantized", "tight"), ("both", "tight")]


def late_and_quantized(kind="wide"):
    """The ring of four nodes with links that lose and delay, a quantizer, of which one saturates often, and both."""
    quantizer = QUANTIZERS[kind]
    fusions = {"late": (None, LATE), "quantized": (quantizer, None), "both": (quantizer, LATE)}
    fused = {name: hg.Fusion("own", EqualIntersection(), mine, neighbours=RING, link=link)
             for name, (mine, link) in fusions.items()}  # fmt: skip
    return hg.Network(PLANT, network({}).nodes, fused)


@pytest.fixture(scope="module")
def records():
    """Of each quantizer, by one program: its numbers are arguments."""
    return {kind: hg.monte_carlo(late_and_quantized(kind), horizon=STEPS, runs=RUNS, key=5) for kind in QUANTIZERS}


def by_hand(z, ages, quantizer):
    """Means (time, node, n) and covariances of one run; `ages(k, i, j)` of what j sent to i, None: nothing.

    And how many of the means that would arrive were beyond the quantizer's amplitude.
    """
    beyond = 0
    a, q, p, h, r = models()
    means, covariances = [np.tile([1.0, -2.0], (4, 1))], [np.tile(p, (4, 1, 1))]
    for k in range(STEPS):
        after = []
        for i, everybody in enumerate(senders()):
            what = [(means[k][i], covariances[k][i])]
            fresh = [i]
            for j in everybody[1:]:
                if (age := ages(k, i, j)) is None:
                    continue
                fresh += [j] if age == 0 else []
                # What j sent `age` steps ago, corrected by the measurement sent with it and predicted to now.
                x, c = means[k - age][j], covariances[k - age][j]
                if quantizer is not None:
                    amplitude, width = quantizer.amplitude, 2 * quantizer.amplitude / quantizer.levels
                    if np.abs(x).max() > amplitude:
                        beyond += 1
                        continue
                    x, t = (np.floor((x + amplitude) / width) + 0.5) * width - amplitude, width / np.sqrt(np.trace(c))
                    c = (1 + t) * c + (1 + 1 / t) * width * np.eye(2) * width / 2
                for late in range(age):
                    x, c = a @ x, a @ c @ a.T + q
                    if late == 0:
                        gain = c @ h[j].T @ np.linalg.inv(h[j] @ c @ h[j].T + r[j])
                        x, c = x + gain @ (z[NODES[j]][k - age] - h[j] @ x), c - gain @ h[j] @ c
                what.append((x, c))
            inverse = [np.linalg.inv(c) / len(what) for _, c in what]
            c = np.linalg.inv(sum(inverse))
            x, c = a @ (c @ sum(m @ x for m, (x, _) in zip(inverse, what, strict=True))), a @ c @ a.T + q
            for j in fresh:
                gain = c @ h[j].T @ np.linalg.inv(h[j] @ c @ h[j].T + r[j])
                x, c = x + gain @ (z[NODES[j]][k] - h[j] @ x), c - gain @ h[j] @ c
            after.append((x, c))
        x, c = (np.array(part) for part in zip(*after, strict=True))
        means.append(x)
        covariances.append(c)
    return np.array(means[1:]), np.array(covariances[1:]), beyond


@pytest.mark.slow
@pytest.mark.parametrize(("name", "kind"), CASES, ids=["late", "quantized", "both", "tight", "tight and late"])
def test_a_run_is_that_by_hand_and_no_error_is_above_what_nothing_saturated_claims(records, name, kind):
    record, quantizer = records[kind], None if name == "late" else QUANTIZERS[kind]
    reports, z = record.reports[name], {node: np.asarray(record.measurements[node][0]) for node in NODES}

    def ages(k, i, j):
        value = reports[NODES[i]].values[0, k, RING[NODES[i]].index(NODES[j])]
        return None if np.isnan(value) else int(value) * (name != "quantized")

    means, covariances, beyond = by_hand(z, ages, quantizer)
    assert (beyond > 20) == (kind == "tight")
    for i, node in enumerate(NODES):
        estimate = record.estimates[node][name]
        assert estimate.claim == ("upper" if quantizer is None else "nominal")
        np.testing.assert_allclose(estimate.mean[0], means[:, i], rtol=0, atol=1e-9)
        np.testing.assert_allclose(estimate.covariance[0], covariances[:, i], rtol=1e-9)
        assert np.isfinite(estimate.covariance).all()
        if kind == "tight":
            continue
        # The mean over 300 runs of what has at most a chi-square's mean: 5 deviations of it are 1 + 5 sqrt(1 / 300).
        error, covariance = record.errors(node, name), np.asarray(estimate.covariance)
        nees = np.einsum("rta,rta->rt", error, np.linalg.solve(covariance, error[..., None])[..., 0]) / 2
        assert nees.mean(axis=0).max() < 1 + 5 / np.sqrt(RUNS) and nees.mean() < 1.03


def test_where_a_quantizer_saturates_the_error_is_above_the_claim_which_is_nominal():
    """x stays what it is, a measures it, b has it from a, and c from b alone, unless |x| > 1: E[x^2 | |x| > 1] = 2.525.

    What c claims without b's estimates, E[x^2] = 1, is true in the mean over all runs and too little where c needs it.
    """
    plant, runs = hg.LinearPlant([[1.0]], [[1e-6]], [0.0], [[1.0]]), 4000
    sensor = hg.LinearSensor([[1.0]], 1e-3)
    nodes = {"a": hg.Node(sensor, hg.perfect(), {"own": hg.kalman_filter(plant, sensor)}), "b": None, "c": None}
    near = {"b": ["a"], "c": ["b"]}
    item = hg.Fusion("own", EqualIntersection(), UniformQuantizer(1001, 1.0), neighbours=near)
    record = hg.monte_carlo(hg.Network(plant, nodes, {"m": item}), horizon=6, runs=runs, key=1)
    error, variance = record.errors("c", "m")[:, -1, 0], np.asarray(record.estimates["c"]["m"].covariance)[:, -1, 0, 0]
    alone = variance > 0.9
    assert record.estimates["c"]["m"].claim == "nominal"
    # Of a normal x, |x| > 1 has the probability .3173; four deviations of a share and of a mean over so many runs.
    assert alone.mean() == pytest.approx(0.3173, abs=4 * np.sqrt(0.22 / runs))
    assert np.mean(error[alone] ** 2) == pytest.approx(2.525, abs=4 * 1.6 / np.sqrt(0.3 * runs))
    assert np.mean(error**2) > 2 * np.mean(variance)


@pytest.mark.slow
def test_a_recording_gives_what_the_run_gave(records):
    for kind, record in records.items():
        reports = {name: {n: item.values[2] for n, item in mine.items()} for name, mine in record.reports.items()}
        z = {node: item[2] for node, item in record.measurements.items()}
        again = hg.run(late_and_quantized(kind), z, reports=reports)
        for name in reports:
            np.testing.assert_allclose(again.estimates["b"][name].mean, record.estimates["b"][name].mean[2], atol=1e-9)
    reports["late"]["b"][3] = 3.0
    with pytest.raises(ValueError, match="reports of node 'b': expected ages of what arrives, from 0 to 2 steps"):
        hg.run(late_and_quantized(), z, reports=reports)


@pytest.mark.parametrize(("name", "line"), [("late", "got late ones"), ("quantized", "got a quantizer")])
def test_bad_input_no_errors_before_data(name, line):
    with pytest.raises(ValueError, match=line):
        hg.simulation.mesh_errors(late_and_quantized(), name, 5)
