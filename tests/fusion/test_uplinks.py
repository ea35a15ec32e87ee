"""Reports that fade, get lost, are late or left out: against the stacked problem in NumPy, simulated, run, streamed."""

import numpy as np
import pytest

import heliograph as hg
from tests.fusion.fusion_problems import network, two_gains
from tests.oracles.shared_information import local_gains

STEPS, N = 6, 2
PLANT = hg.LinearPlant([[0.9, 0.2], [0.0, 0.8]], [[0.3, 0.1], [0.1, 0.2]], [1.0, -2.0], np.eye(2))
PARTS = [(np.array([[1.0, 0.0]]), 0.2, 0.8, 0.05, 0.1), (np.array([[0.5, 1.0]]), 0.3, 0.9, 0.1, 0.1)]
GAIN, NOISE = (0.9, 0.04), 0.05  # mean and variance of the uplinks' gain, and their noise
FADING = hg.hop(two_gains(*GAIN), noise=NOISE, dimension=N)
LATE = [0.5, 0.3, 0.2]


@pytest.fixture(scope="module")
def net():
    links = {
        "everything": hg.fusion.ReportLink(hg.erasure(FADING, 0.8), delay=LATE),
        "second": hg.fusion.ReportLink(every=2),
    }
    quantizer = hg.fusion.UniformQuantizer(60, 30.0)
    fused = {name: hg.Fusion("local", hg.fusion.AllReports(), uplink=link) for name, link in links.items()}
    fused["quantized"] = hg.Fusion("local", hg.fusion.AllReports(), quantizer=quantizer)
    return network(PLANT, PARTS, fused)


@pytest.fixture(scope="module")
def record(net):
    return hg.monte_carlo(net, STEPS, 2016, 5)


def stacked(arrives):
    """Cov(x - xhat) after the last step, of the best linear estimate from the reports (step, node) that arrived.

    x, and each estimate, is a linear map of x_0, w_1, ... and what the channels add, nu_i1, ...: all white.
    """
    a, q = np.asarray(PLANT.matrix), np.asarray(PLANT.noise.covariance)
    mean, p = np.asarray(PLANT.initial_mean), np.asarray(PLANT.initial_covariance)
    model = (a, q, mean, p)
    sources = N + N * STEPS + len(PARTS) * STEPS
    start = np.zeros((sources, sources))
    start[:N, :N] = p
    x = np.eye(N, sources)
    estimates, means = [np.zeros((N, sources)) for _ in PARTS], mean
    known, gains = [], []
    for c, r, gain, variance, noise in PARTS:
        h = gain * c
        spread = lambda s, c=c, r=r, g=gain, v=variance, n=noise: v * (c @ s @ c.T + r) + g**2 * r + n  # noqa: E731
        known.append((h, spread))
        gains.append(local_gains(model, h, spread, STEPS))
    state, rows, noises = p, [], []
    for k in range(STEPS):
        at = N + N * k
        start[at : at + N, at : at + N] = q
        x, means, state = a @ x + np.eye(N, sources, at), a @ means, a @ state @ a.T + q
        for i, (h, spread) in enumerate(known):
            place = N + N * STEPS + len(PARTS) * k + i
            start[place, place] = spread(state + np.outer(means, means))[0, 0]
            received = h @ x + np.eye(1, sources, place)
            before = a @ estimates[i]
            estimates[i] = before + gains[i][k] @ (received - h @ before)
            if arrives[k, i]:
                second = estimates[i] @ start @ estimates[i].T + np.outer(means, means)
                rows.append(GAIN[0] * estimates[i])
                noises.append(GAIN[1] * second + NOISE * np.eye(N))
    reports, white = np.concatenate(rows), np.zeros((N * len(rows),) * 2)
    for j, block in enumerate(noises):
        white[N * j : N * j + N, N * j : N * j + N] = block
    cross = x @ start @ reports.T
    return x @ start @ x.T - cross @ np.linalg.solve(reports @ start @ reports.T + white, cross.T)


@pytest.mark.slow
def test_late_lost_and_fading_reports_give_the_best_linear_estimate(net):
    """Every pattern of one recording of zeros: 1e-9 of the stacked problem; what is still on its way counts not."""
    draw = np.random.default_rng(0)
    delay, lost = draw.integers(0, 3, size=(STEPS, 2)), draw.random((STEPS, 2)) < 0.3
    silent = {name: np.zeros((STEPS, 1)) for name in net.nodes}
    values = {f"node {i}": np.where(lost[:, [i]], np.nan, np.zeros((STEPS, N))) for i in range(2)}
    sent = {name: hg.simulation.SentReports(v, delay[:, i]) for i, (name, v) in enumerate(values.items())}
    zeros = dict.fromkeys(net.nodes, hg.simulation.SentReports(np.zeros((STEPS, N)), np.zeros(STEPS, dtype=int)))
    reports = {name: sent if name == "everything" else zeros for name in net.fused}
    result = hg.run(net, silent, reports=reports).estimates["fused"]["everything"]
    arrives = ~lost & (np.arange(STEPS)[:, None] + delay < STEPS)
    np.testing.assert_allclose(result.covariance[-1], stacked(arrives), rtol=1e-9)


@pytest.mark.slow
def test_every_second_step_sends(record):
    for report in record.reports["second"].values():
        values = np.asarray(report.values)
        assert np.isnan(values[:, ::2]).all() and np.isfinite(values[:, 1::2]).all()


@pytest.mark.slow
def test_monte_carlo_agrees(record):
    """Mean squares within three standard errors of each run's own claim; the quantized one's is above."""
    for name, estimate in record.estimates["fused"].items():
        claimed = np.trace(np.asarray(estimate.covariance)[:, -1], axis1=1, axis2=2)
        excess = np.sum(record.errors("fused", name)[:, -1] ** 2, axis=-1) - claimed
        error = excess.std() / np.sqrt(len(excess))
        if name == "quantized":
            assert estimate.claim == "nominal" and excess.mean() < 0  # nothing saturates here
        else:
            assert estimate.claim == "exact" and abs(excess.mean()) < 3 * error


@pytest.mark.slow
def test_runs_and_streams_give_what_was_simulated(net, record):
    """One run again: from its recording with the reports that came, and the centre alone fed with these."""
    data = {node: z[0] for node, z in record.measurements.items()}
    known = {
        fusion: {node: hg.simulation.SentReports(r.values[0], r.delay[0]) for node, r in report.items()}
        for fusion, report in record.reports.items()
    }
    again = hg.run(net, data, reports=known)
    for name, estimate in record.estimates["fused"].items():
        ours = again.estimates["fused"][name]
        np.testing.assert_allclose(ours.mean, np.asarray(estimate.mean)[0], rtol=1e-8, atol=1e-10)
        np.testing.assert_allclose(ours.covariance[-1], np.asarray(estimate.covariance)[0, -1], rtol=1e-8)
    centre = hg.simulation.centre_filter(net, "everything")
    stream = hg.Stream(centre)
    for k in range(STEPS):
        received = [
            r.values[k - age] if k >= age and r.delay[k - age] == age else np.full(N, np.nan)
            for age in range(len(LATE))
            for r in known["everything"].values()
        ]
        live = stream.push(np.concatenate(received))
    np.testing.assert_allclose(live.mean, again.estimates["fused"]["everything"].mean[-1], rtol=1e-9)
    assert live.claim == "exact"


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda f, n: hg.Fusion("local", f.MatrixWeights(), uplink=f.ReportLink(every=2)), "a rule that uses reports"),
        (lambda f, n: hg.Fusion("local", f.AllReports(), uplink=f.ReportLink(hg.hop(1.0, 0.1))), "takes 2 numbers"),
        (lambda f, n: hg.Fusion("local", f.AllReports(), uplink={"node 0": f.ReportLink()}), "one for each node of"),
        (lambda f, n: hg.Fusion("local", f.AllReports(), quantizer=f.EscapeQuantizer(9, 1.0, 0.9, 0.1, 0.1)),
         "bounded before any data"),
    ],
)  # fmt: skip
def test_what_is_not_known_is_refused(make, message):
    with pytest.raises(ValueError, match=message):
        network(PLANT, PARTS, {"one": make(hg.fusion, N)})


def test_a_centre_that_cannot_know_what_a_node_lost_is_refused():
    perfect = network(PLANT, PARTS, {})
    nodes = {n: hg.Node(v.sensor, hg.erasure(v.channel, 0.5), v.filters) for n, v in perfect.nodes.items()}
    fused = {"one": hg.Fusion("local", hg.fusion.AllReports(), uplink=hg.fusion.ReportLink(delay=1))}
    with pytest.raises(ValueError, match="nodes that lose no measurements"):
        hg.Network(PLANT, nodes, fused)
