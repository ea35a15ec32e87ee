"""Messages between neighbours that come late or quantized: by hand, by Monte Carlo, and from a recording."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.fusion import EqualIntersection, UniformQuantizer
from tests.fusion.mesh.worlds import NODES, PLANT, RING, models, network, senders

LEVELS, AMPLITUDE, STEPS, RUNS = 401, 60.0, 20, 300
LATE = hg.erasure(hg.model.delayed(hg.perfect(), hg.Discrete([0, 1, 2], [0.5, 0.3, 0.2]), timestamped=True), 0.8)
ROUNDED = UniformQuantizer(LEVELS, AMPLITUDE)


def late_and_quantized():
    """The ring of four nodes with links that lose and delay, quantizers, and both."""
    parts = {"late": {"link": LATE}, "quantized": {"quantizer": ROUNDED}, "both": {"link": LATE, "quantizer": ROUNDED}}
    rule = EqualIntersection()
    fused = {name: hg.Fusion("own", rule, neighbours=RING, **part) for name, part in parts.items()}  # type: ignore[arg-type]
    return hg.Network(PLANT, network({}).nodes, fused)


@pytest.fixture(scope="module")
def record():
    return hg.monte_carlo(late_and_quantized(), horizon=STEPS, runs=RUNS, key=5)


def by_hand(z, ages, quantized):
    """Means (time, node, n) and covariances of one run; `ages(k, i, j)` of what j sent to i, None: nothing."""
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
                if quantized:
                    width = 2 * AMPLITUDE / LEVELS
                    x, t = (np.floor((x + AMPLITUDE) / width) + 0.5) * width - AMPLITUDE, width / np.sqrt(np.trace(c))
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
    return np.array(means[1:]), np.array(covariances[1:])


@pytest.mark.slow
@pytest.mark.parametrize("name", ["late", "quantized", "both"])
def test_a_run_is_that_by_hand_and_no_error_is_above_its_claim(record, name):
    reports, z = record.reports[name], {node: np.asarray(record.measurements[node][0]) for node in NODES}

    def ages(k, i, j):
        value = reports[NODES[i]].values[0, k, RING[NODES[i]].index(NODES[j])]
        return None if np.isnan(value) else int(value) * (name != "quantized")

    means, covariances = by_hand(z, ages, name != "late")
    for i, node in enumerate(NODES):
        estimate = record.estimates[node][name]
        assert estimate.claim == "upper"
        np.testing.assert_allclose(estimate.mean[0], means[:, i], rtol=0, atol=1e-9)
        np.testing.assert_allclose(estimate.covariance[0], covariances[:, i], rtol=1e-9)
        # The mean over 300 runs of what has at most a chi-square's mean: 5 deviations of it are 1 + 5 sqrt(1 / 300).
        error, covariance = record.errors(node, name), np.asarray(estimate.covariance)
        nees = np.einsum("rta,rta->rt", error, np.linalg.solve(covariance, error[..., None])[..., 0]) / 2
        assert nees.mean(axis=0).max() < 1 + 5 / np.sqrt(RUNS) and nees.mean() < 1.03


@pytest.mark.slow
def test_a_recording_gives_what_the_run_gave(record):
    reports = {name: {n: item.values[2] for n, item in mine.items()} for name, mine in record.reports.items()}
    z = {node: item[2] for node, item in record.measurements.items()}
    again = hg.run(late_and_quantized(), z, reports=reports)
    for name in reports:
        np.testing.assert_allclose(again.estimates["b"][name].mean, record.estimates["b"][name].mean[2], atol=1e-9)
    reports["late"]["b"][3] = 3.0
    with pytest.raises(ValueError, match="reports of node 'b': expected ages of what arrives, from 0 to 2 steps"):
        hg.run(late_and_quantized(), z, reports=reports)


@pytest.mark.parametrize(("name", "line"), [("late", "got late ones"), ("quantized", "got a quantizer")])
def test_bad_input_no_errors_before_data(name, line):
    with pytest.raises(ValueError, match=line):
        hg.simulation.mesh_errors(late_and_quantized(), name, 5)
