"""Estimates between neighbours that are sent where they moved: by hand, by Monte Carlo, and what is refused."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.fusion import EqualIntersection, MatrixWeights, TraceIntersection
from heliograph.simulation import mesh_errors
from tests.fusion.mesh.worlds import NODES, PLANT, RING, models, network, senders

ALPHAS = {"always": None, "any": 0.0, "some": 0.3, "few": 3.0}


def with_events(alphas, rule, link=None):
    """The ring of four nodes with a fusion for each of these alphas."""
    plain = network({})
    fused = {name: hg.Fusion("own", rule, neighbours=RING, link=link, alpha=alpha) for name, alpha in alphas.items()}
    return hg.Network(PLANT, plain.nodes, fused)


def daily(name):
    return pytest.param(name, marks=[] if name == "independent" else pytest.mark.slow)


@pytest.fixture(scope="module", params=map(daily, ["nothing", "independent", "bursts"]))
def record(request):
    bursts = hg.gilbert_elliott(hg.perfect(), hg.erasure(hg.perfect(), 0.2), 0.1, 0.4)
    link = {"nothing": None, "independent": hg.erasure(hg.perfect(), 0.7), "bursts": bursts}[request.param]
    # One program: alpha is a number of it.
    moving = {name: alpha for name, alpha in ALPHAS.items() if alpha is not None}
    return {name: hg.monte_carlo(with_events({"always": None, "m": alpha}, EqualIntersection(), link), 40, 300, 5)
            for name, alpha in moving.items()}  # fmt: skip


def estimate_of(record, node, name):
    """Estimate of a node by the fusion of this alpha."""
    return record["any"].estimates[node]["always"] if name == "always" else record[name].estimates[node]["m"]


def by_hand(z, alpha, lost):
    """Means (time, node, n), covariances, and how often a node sent, of one run of measurements by node.

    `lost(k, i, j)`: whether the message of node j to node i at step k is.
    """
    a, q, p, h, r = models()
    n, who = len(a), senders()
    mean, covariance = np.tile([1.0, -2.0], (4, 1)), np.tile(p, (4, 1, 1))
    held = {(i, j): mean[j] for i, mine in enumerate(who) for j in mine if j != i}
    wider, count, results = (1 + np.sqrt(alpha * n)) ** 2, 0, []
    for k in range(len(z["a"])):
        # A node sends as soon as one of those who receive it has an estimate that is far from its own.
        far = {j for (i, j), x in held.items()
               if (mean[j] - x) @ np.linalg.solve(covariance[j], mean[j] - x) > alpha * n}  # fmt: skip
        count += len(far)
        held = {(i, j): mean[j] if j in far and not lost(k, i, j) else x for (i, j), x in held.items()}
        after = []
        for i, everybody in enumerate(who):
            # Equal shares of what is received; the node's estimate as it is.
            mine = [j for j in everybody if j == i or not lost(k, i, j)]
            inverse = [np.linalg.inv(covariance[j] * (1 if j == i else wider)) / len(mine) for j in mine]
            fused = np.linalg.inv(sum(inverse))
            x = fused @ sum(m @ held.get((i, j), mean[j]) for m, j in zip(inverse, mine, strict=True))
            x, s = a @ x, np.linalg.inv(a @ fused @ a.T + q)
            information = s + sum(h[j].T @ np.linalg.solve(r[j], h[j]) for j in mine)
            pull = sum(h[j].T @ np.linalg.solve(r[j], z[NODES[j]][k] - h[j] @ x) for j in mine)
            after.append((x + np.linalg.solve(information, pull), np.linalg.inv(information)))
        mean, covariance = (np.array(part) for part in zip(*after, strict=True))
        held = {edge: a @ x for edge, x in held.items()}
        results.append((mean, covariance))
    means, covariances = (np.array(part) for part in zip(*results, strict=True))
    return means, covariances, count / (4 * len(z["a"]))


@pytest.mark.slow
def test_a_run_is_that_by_hand_and_sends_the_less_the_larger_alpha(record):
    shares = []
    for name, alpha in [("any", 0.0), ("some", 0.3), ("few", 3.0)]:
        z = {node: np.asarray(record[name].measurements[node][0]) for node in NODES}
        reports = record[name].reports["m"]

        def lost(k, i, j, reports=reports):
            return np.isnan(reports[NODES[i]].values[0, k, RING[NODES[i]].index(NODES[j])])

        means, covariances, share = by_hand(z, alpha, lost)
        for i, node in enumerate(NODES):
            estimate = estimate_of(record, node, name)
            np.testing.assert_allclose(estimate.mean[0], means[:, i], rtol=0, atol=1e-9)
            np.testing.assert_allclose(estimate.covariance[0], covariances[:, i], rtol=1e-9)
        shares.append(share)
    assert shares[0] > 0.9 > shares[1] > 1.5 * shares[2]


@pytest.mark.slow
def test_where_any_move_is_sent_nothing_changes(record):
    for node in NODES:
        for part in ("mean", "covariance"):
            both = [getattr(estimate_of(record, node, name), part) for name in ("always", "any")]
            np.testing.assert_allclose(*both, rtol=1e-10, atol=1e-10)


@pytest.mark.slow
@pytest.mark.parametrize("name", ALPHAS)
def test_no_error_is_above_its_claim(record, name):
    for node in NODES:
        estimate = estimate_of(record, node, name)
        assert estimate.claim == "upper"
        error = record["any"].truth - estimate.mean if name == "always" else record[name].errors(node, "m")
        # The mean over 300 runs of what has at most a chi-square's mean: 5 deviations of it are 1 + 5 sqrt(1 / 300).
        covariance = np.asarray(estimate.covariance)
        nees = np.einsum("rta,rta->rt", error, np.linalg.solve(covariance, error[..., None])[..., 0]) / 2
        assert nees.mean(axis=0).max() < 1 + 5 / np.sqrt(300) and nees.mean() < 1.03


def test_larger_bounds_claim_more(record):
    traces = [np.trace(estimate_of(record, "b", name).covariance[0, -1]) for name in ("any", "some", "few")]
    assert traces[0] < traces[1] < traces[2]


@pytest.mark.parametrize(
    ("rule", "more", "line"),
    [
        (MatrixWeights(), {}, "a rule that intersects"),
        (TraceIntersection(), {"rounds": 2}, "one round, where there are events"),
        (TraceIntersection(), {"link": hg.dropout(hg.perfect(), 0.9)}, "the receiver knows"),
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
