"""Estimates between neighbours that are sent where they moved: by hand, by Monte Carlo, and what is refused."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.fusion import EqualIntersection, MatrixWeights, TraceIntersection
from heliograph.simulation import mesh_errors
from tests.fusion.mesh.worlds import NODES, PLANT, RING, models, network, senders

ALPHAS = {"always": None, "any": 0.0, "some": 0.3, "few": 3.0}


def with_events(alphas, rule):
    """The ring of four nodes with a fusion for each of these alphas."""
    plain = network({})
    fused = {name: hg.Fusion("own", rule, neighbours=RING, alpha=alpha) for name, alpha in alphas.items()}
    return hg.Network(PLANT, plain.nodes, fused)


@pytest.fixture(scope="module")
def record():
    return hg.monte_carlo(with_events(ALPHAS, EqualIntersection()), horizon=40, runs=300, key=5)


def by_hand(z, alpha):
    """Means (time, node, n), covariances, and how often a node sent, of one run of measurements by node."""
    a, q, p, h, r = models()
    n, who = len(a), senders()
    mean, covariance = np.tile([1.0, -2.0], (4, 1)), np.tile(p, (4, 1, 1))
    sent, wider, count, results = mean.copy(), (1 + np.sqrt(alpha * n)) ** 2, 0, []
    for k in range(len(z["a"])):
        off = mean - sent
        moved = np.einsum("ia,ia->i", off, np.linalg.solve(covariance, off[..., None])[..., 0]) > alpha * n
        sent, count = np.where(moved[:, None], mean, sent), count + moved.sum()
        after = []
        for i, mine in enumerate(who):
            # Equal shares of what is received; the node's estimate as it is.
            inverse = [np.linalg.inv(covariance[j] * (1 if j == i else wider)) / len(mine) for j in mine]
            fused = np.linalg.inv(sum(inverse))
            x = fused @ sum(m @ (mean[j] if j == i else sent[j]) for m, j in zip(inverse, mine, strict=True))
            x, s = a @ x, np.linalg.inv(a @ fused @ a.T + q)
            information = s + sum(h[j].T @ np.linalg.solve(r[j], h[j]) for j in mine)
            pull = sum(h[j].T @ np.linalg.solve(r[j], z[NODES[j]][k] - h[j] @ x) for j in mine)
            after.append((x + np.linalg.solve(information, pull), np.linalg.inv(information)))
        mean, covariance = (np.array(part) for part in zip(*after, strict=True))
        sent = sent @ a.T
        results.append((mean, covariance))
    means, covariances = (np.array(part) for part in zip(*results, strict=True))
    return means, covariances, count / (4 * len(z["a"]))


def test_a_run_is_that_by_hand_and_sends_the_less_the_larger_alpha(record):
    z = {name: np.asarray(record.measurements[name][0]) for name in NODES}
    shares = []
    for name, alpha in [("any", 0.0), ("some", 0.3), ("few", 3.0)]:
        means, covariances, share = by_hand(z, alpha)
        for i, node in enumerate(NODES):
            estimate = record.estimates[node][name]
            np.testing.assert_allclose(estimate.mean[0], means[:, i], rtol=0, atol=1e-9)
            np.testing.assert_allclose(estimate.covariance[0], covariances[:, i], rtol=1e-9)
        shares.append(share)
    assert shares[0] > 0.9 > shares[1] > 1.5 * shares[2]


def test_where_any_move_is_sent_nothing_changes(record):
    for node in NODES:
        for part in ("mean", "covariance"):
            both = [getattr(record.estimates[node][name], part) for name in ("always", "any")]
            np.testing.assert_allclose(*both, rtol=1e-10, atol=1e-10)


@pytest.mark.parametrize("name", ALPHAS)
def test_no_error_is_above_its_claim(record, name):
    for node in NODES:
        estimate = record.estimates[node][name]
        assert estimate.claim == "upper"
        error = record.errors(node, name)
        # The mean over 300 runs of what has at most a chi-square's mean: 5 deviations of it are 1 + 5 sqrt(1 / 300).
        covariance = np.asarray(estimate.covariance)
        nees = np.einsum("rta,rta->rt", error, np.linalg.solve(covariance, error[..., None])[..., 0]) / 2
        assert nees.mean(axis=0).max() < 1 + 5 / np.sqrt(300) and nees.mean() < 1.03


def test_larger_bounds_claim_more(record):
    traces = [np.trace(record.estimates["b"][name].covariance[0, -1]) for name in ("any", "some", "few")]
    assert traces[0] < traces[1] < traces[2]


@pytest.mark.parametrize(
    ("rule", "more", "line"),
    [
        (MatrixWeights(), {}, "a rule that intersects"),
        (TraceIntersection(), {"rounds": 2}, "one round without losses"),
        (TraceIntersection(), {"link": hg.erasure(hg.perfect(), 0.9)}, "a lost message looks like one that was not"),
        (TraceIntersection(), {"alpha": -0.1}, "alpha of a fusion"),
        (TraceIntersection(), {"neighbours": None}, "rounds or events"),
    ],
)
def test_what_would_break_the_bound_is_refused_in_a_line(rule, more, line):
    with pytest.raises(ValueError, match=line) as caught:
        hg.Network(PLANT, network({}).nodes, {"m": hg.Fusion("own", rule, **{"neighbours": RING, "alpha": 0.3} | more)})
    assert "\n" not in str(caught.value)


def test_errors_before_data_do_not_exist_where_data_decide_what_is_sent():
    with pytest.raises(ValueError, match="sent at every step"):
        mesh_errors(with_events({"m": 0.3}, TraceIntersection()), "m", 5)
