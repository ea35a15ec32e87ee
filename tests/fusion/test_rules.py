import jax.numpy as jnp
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import brentq

import heliograph as hg
from heliograph.model.estimate import weakest
from heliograph.testing import check_fusion
from tests.bounds import covariances, estimates
from tests.oracles import covariance_intersection as oracle

RULES = {
    "optimal": hg.CovarianceIntersection(),
    "equal": hg.fusion.EqualIntersection(),
    "fixed": hg.fusion.FixedIntersection([0.2, 0.3, 0.5]),
    "weighted": hg.fusion.WeightedFusion([0.2, 0.3, 0.5]),
    "inverse": hg.fusion.InverseCovarianceIntersection(),
}


@pytest.mark.parametrize("name", RULES)
def test_contract(name):
    check_fusion(RULES[name])


class _Overconfident(hg.fusion.WeightedFusion):
    """Takes correlated errors for independent ones."""

    def combine(self, means, bounds):
        mean, bound = super().combine(means, bounds)
        return mean, bound / 2


def test_the_check_finds_a_bound_that_is_none():
    with pytest.raises(AssertionError, match="identical bounds"):
        check_fusion(_Overconfident([0.2, 0.3, 0.5]))


class _InverseByHalves(hg.fusion.InverseCovarianceIntersection):
    """Inverse intersection with weight 1/2, two at a time, as if its covariance were a bound for all correlations."""

    def claim(self, claims):
        return weakest([*claims, "upper"])

    def combine(self, means, covariances):
        mean, spread = means[0], covariances[0]
        for other, q in zip(means[1:], covariances[1:], strict=True):
            common = jnp.linalg.inv((spread + q) / 2)
            fused = jnp.linalg.inv(jnp.linalg.inv(spread) + jnp.linalg.inv(q) - common)
            gain = fused @ (jnp.linalg.inv(q) - common / 2)
            mean, spread = mean + gain @ (other - mean), fused
        return mean, spread


@pytest.mark.parametrize("seed", range(20))
def test_the_check_finds_inverse_intersection_no_bound_for_every_correlation(seed):
    with pytest.raises(AssertionError, match="bound: expected an upper one"):
        check_fusion(_InverseByHalves(), seed=seed)


def test_weighted_fusion_by_hand():
    pair = estimates(np.array([[[1.0]], [[3.0]]]), "exact")
    fused = hg.fusion.fuse(hg.fusion.WeightedFusion([0.25, 0.75]), pair)
    np.testing.assert_allclose(fused.mean, 0.25 * pair[0].mean + 0.75 * pair[1].mean, rtol=1e-15)
    assert fused.covariance[0, 0] == 2.5 and fused.claim == "upper"


def test_estimates_that_claim_no_covariance():
    """A weighted mean needs none; rules that weigh by covariances say so."""
    some = estimates(covariances(0, 2, 2), "exact")
    mixed = [some[0], hg.model.Estimate(some[1].mean, np.full((2, 2), np.nan), "none")]
    fused = hg.fusion.fuse(hg.fusion.WeightedFusion([0.5, 0.5]), mixed)
    assert fused.claim == "none" and np.all(np.isfinite(fused.mean)) and np.all(np.isnan(fused.covariance))
    rules = (hg.CovarianceIntersection(), hg.fusion.EqualIntersection(), hg.fusion.InverseCovarianceIntersection())
    for rule in (*rules, hg.fusion.FixedIntersection([0.5, 0.5])):
        with pytest.raises(ValueError, match="estimates that claim one, got the claim 'none'"):
            hg.fusion.fuse(rule, mixed)
    assert [weakest([a, "none"]) for a in ("none", "nominal", "upper", "exact")] == ["none"] * 4


@pytest.mark.parametrize(
    "rule", [hg.CovarianceIntersection(), hg.fusion.EqualIntersection(), hg.fusion.FixedIntersection([0.5, 0.5])]
)
def test_equal_inputs_are_returned(rule):
    item = estimates(covariances(0, 1, 3))[0]
    fused = hg.fusion.fuse(rule, [item, item])
    np.testing.assert_allclose(fused.mean, item.mean, rtol=1e-9)
    np.testing.assert_allclose(fused.covariance, item.covariance, rtol=1e-9)


def test_a_dominating_sensor_is_returned():
    good, bad = np.diag([1.0, 2.0]), np.diag([3.0, 5.0])
    fused = hg.fusion.fuse(hg.CovarianceIntersection(), estimates(np.stack([good, bad])))
    np.testing.assert_allclose(fused.covariance, good, rtol=1e-8)  # weight 1 is approached from inside: gap 1e-10


@given(seed=st.integers(0, 1000))
@settings(max_examples=20)
def test_optimal_is_best_and_no_worse_than_any_input(seed):
    bounds = covariances(seed, 3, 3)
    trace = {
        type(rule).__name__: np.trace(hg.fusion.fuse(rule, estimates(bounds)).covariance)
        for rule in (
            hg.CovarianceIntersection(),
            hg.fusion.EqualIntersection(),
            hg.fusion.InverseCovarianceIntersection(),
        )
    }
    best_input = min(np.trace(b) for b in bounds)
    assert trace["CovarianceIntersection"] <= min(trace["EqualIntersection"], best_input) * (1 + 1e-9)
    assert trace["InverseCovarianceIntersection"] <= best_input * (1 + 1e-9)


@pytest.mark.parametrize("seed", [5, 6])
def test_inverse_covariance_intersection_is_the_oracles(seed):
    bounds = covariances(seed, 2, 3, spread=0.3)
    pair = estimates(bounds)
    fused = hg.fusion.fuse(hg.fusion.InverseCovarianceIntersection(), pair)

    def slope(w):
        """Slope of the trace: -tr(V C (P - Q) C V)."""
        common = np.linalg.inv(w * bounds[0] + (1 - w) * bounds[1])
        _, covariance = oracle.inverse_intersection(pair[0].mean, bounds[0], pair[1].mean, bounds[1], w)
        return -np.trace(covariance @ common @ (bounds[0] - bounds[1]) @ common @ covariance)

    w = brentq(slope, 0, 1, xtol=1e-15)
    mean, bound = oracle.inverse_intersection(pair[0].mean, bounds[0], pair[1].mean, bounds[1], w)
    np.testing.assert_allclose(fused.covariance, bound, rtol=1e-12, atol=1e-13)  # rounding of inverses
    np.testing.assert_allclose(fused.mean, mean, rtol=1e-11)  # the weight to rounding over the trace's curvature


def test_inverse_covariance_intersection_of_one_covariance_is_the_mean():
    """Whatever the weight, the covariance is the same: rounding does not choose between the estimates."""
    bound = covariances(5, 1, 3)[0]
    rounding = 4 * 2.2e-16 * np.linalg.cond(bound)  # of inverses, one of another, 3e-12
    for other in (bound, bound * (1 + 4e-16), bound * (1 - 4e-16)):
        pair = estimates(np.stack([bound, other]))
        fused = hg.fusion.fuse(hg.fusion.InverseCovarianceIntersection(), pair)
        np.testing.assert_allclose(fused.mean, (pair[0].mean + pair[1].mean) / 2, rtol=1e-12)
        np.testing.assert_allclose(fused.covariance, bound, rtol=rounding)


def test_upper_bounds_stay_upper_for_any_correlation():
    """Covariance intersection of correct covariances dominates the error for every joint covariance."""
    rng = np.random.default_rng(0)
    for _ in range(200):
        joint = covariances(int(rng.integers(10**6)), 1, 6)[0]
        blocks = [joint[3 * i : 3 * i + 3, 3 * i : 3 * i + 3] for i in range(2)]
        bounds = np.stack(blocks)
        w = rng.uniform()
        fused = hg.fusion.fuse(hg.fusion.FixedIntersection([w, 1 - w]), estimates(bounds))
        gains = [share * fused.covariance @ np.linalg.inv(b) for share, b in zip((w, 1 - w), bounds, strict=True)]
        actual = np.hstack(gains) @ joint @ np.hstack(gains).T
        assert np.linalg.eigvalsh(fused.covariance - actual)[0] >= -1e-9 * np.trace(fused.covariance)


def test_a_fused_claim_is_never_stronger_than_its_weakest_input():
    bounds = covariances(0, 2, 2)
    mixed = [*estimates(bounds[:1], "nominal"), *estimates(bounds[1:], "exact")]
    assert hg.fusion.fuse(hg.CovarianceIntersection(), mixed).claim == "nominal"
    assert hg.fusion.fuse(hg.fusion.EqualIntersection(), estimates(bounds, "exact")).claim == "upper"
    assert hg.fusion.fuse(hg.fusion.InverseCovarianceIntersection(), estimates(bounds, "exact")).claim == "nominal"


def test_leading_axes_are_carried_along():
    bounds = np.stack([covariances(s, 3, 2) for s in range(4)])
    together = hg.fusion.fuse(hg.fusion.EqualIntersection(), estimates(bounds.swapaxes(0, 1)))
    alone = hg.fusion.fuse(hg.fusion.EqualIntersection(), estimates(bounds[2]))
    np.testing.assert_allclose(together.covariance[2], alone.covariance, rtol=1e-12)


PLANT = hg.LinearPlant([[0.9, 0.2], [0.0, 0.8]], 0.1, [0.0, 0.0], 1.0)
ROWS = {"a": [1.0, 0.0], "b": [0.3, 1.0], "c": [1.0, 1.0]}


def network(channel, fused):
    nodes = {}
    for name, row in ROWS.items():
        sensor = hg.LinearSensor([row], 0.1)
        filters = {"cubature": hg.cubature_filter(PLANT, sensor, channel)}
        if channel.inputs == 1:
            filters["linear"] = hg.linear_filter(PLANT, sensor, channel)
        nodes[name] = hg.Node(sensor, channel, filters)
    return hg.Network(PLANT, nodes, fused(nodes))


@pytest.mark.slow
def test_central_filters_and_weights_go_by_the_order_of_the_nodes():
    """Not of their names or groups. Behind known gains, using nodes in turn equals one update with all measurements."""
    gain = hg.hop(1.2, 0.05)
    rows = {"z": [[1.0, 0.0]], "a": [[0.3, 1.0], [1.0, 1.0]], "m": [[1.0, -1.0]]}
    nodes = {}
    for name, matrix in rows.items():
        sensor, channel = hg.LinearSensor(matrix, 0.1), hg.parallel([gain] * len(matrix))
        nodes[name] = hg.Node(sensor, channel, {"f": hg.cubature_filter(PLANT, sensor, channel)})
    weights = [0.7, 0.1, 0.2]
    fused = {
        "fixed": hg.Fusion("f", hg.fusion.FixedIntersection(weights)),
        "central": hg.filters.sequential_filter([node.filters["f"] for node in nodes.values()]),
    }
    record = hg.monte_carlo(hg.Network(PLANT, nodes, fused), 6, 3, 0)
    outside = hg.fusion.fuse(hg.fusion.FixedIntersection(weights), [record.estimates[name]["f"] for name in nodes])
    np.testing.assert_allclose(record.estimates["fused"]["fixed"].mean, outside.mean, atol=1e-12)
    central = record.estimates["fused"]["central"]
    assert central.claim == "exact"
    joint_sensor = hg.LinearSensor(np.concatenate(list(rows.values())), 0.1)
    z = np.concatenate([record.measurements[name] for name in nodes], axis=-1)
    for item in (hg.cubature_filter(PLANT, joint_sensor, hg.parallel([gain] * 4)), fused["central"]):
        for r in range(3):
            stream = hg.Stream(item)
            for k in range(6):
                estimate = stream.push(z[r, k])
                np.testing.assert_allclose(central.mean[r, k], estimate.mean, atol=1e-11)
                np.testing.assert_allclose(central.covariance[r, k], estimate.covariance, atol=1e-11)


@pytest.fixture(scope="module")
def faded():
    """Two rules behind Rayleigh fading."""
    rules = {
        "optimal": hg.Fusion("linear", hg.CovarianceIntersection()),
        "equal": hg.Fusion("cubature", hg.fusion.EqualIntersection()),
    }
    result = network(hg.hop(hg.Rayleigh(0.8), 0.05), lambda n: rules)
    return rules, hg.monte_carlo(result, 8, 2000, 1)


@pytest.mark.slow
def test_fusion_inside_the_scan_is_fusion_outside(faded):
    rules, record = faded
    for name, fusion in rules.items():
        local = [record.estimates[node][fusion.filter] for node in ROWS]
        some = [hg.model.Estimate(item.mean[:4], item.covariance[:4], item.claim) for item in local]
        outside, inside = hg.fusion.fuse(fusion.rule, some), record.estimates["fused"][name]
        np.testing.assert_allclose(inside.mean[:4], outside.mean, atol=1e-12)
        np.testing.assert_allclose(inside.covariance[:4], outside.covariance, atol=1e-12)
        assert inside.claim == outside.claim


def test_an_upper_claim_of_fusion_holds(faded):
    """In the direction and at the step where half of the runs are worst, the other half is at most 4 errors above."""
    _, record = faded
    bound = record.estimates["fused"]["optimal"]
    assert bound.claim == "upper"
    roots = np.linalg.cholesky(bound.covariance)  # of errors and bounds, in units of the bound
    errors = np.linalg.solve(roots, record.errors("fused", "optimal")[..., None])[..., 0]
    for chosen, judged in ((errors[::2], errors[1::2]), (errors[1::2], errors[::2])):
        values, directions = np.linalg.eigh(np.einsum("rki,rkj->kij", chosen, chosen))
        step = np.argmax(values[:, -1])
        squares = (judged[:, step] @ directions[step, :, -1]) ** 2
        assert squares.mean() - 1 < 4 * squares.std() / np.sqrt(len(squares))


QUANTIZER = hg.fusion.UniformQuantizer(8, 3.0)


def quantized(quantizer):
    fusion = hg.Fusion("linear", hg.fusion.EqualIntersection(), quantizer)
    return network(hg.perfect(), lambda n: {"x": fusion})


def test_a_claim_through_a_quantizer():
    assert quantized(None).claims()["fused"]["x"] == "upper"
    assert quantized(QUANTIZER).claims()["fused"]["x"] == "nominal"  # by what it leaves out
    following = hg.fusion.EscapeQuantizer(9, 1.0, 0.6, 0.6, 1e-3)
    assert quantized(following).claims()["fused"]["x"] == "nominal"
    assert quantized({name: following for name in ROWS}).claims()["fused"]["x"] == "nominal"
    varying = hg.model.over_time([QUANTIZER, hg.fusion.UniformQuantizer(16, 3.0)])
    assert quantized(varying).claims()["fused"]["x"] == "nominal"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda: hg.fusion.FixedIntersection([0.5, 0.6]), "sum to 1"),
        (lambda: hg.fusion.FixedIntersection([1.5, -0.5]), "no negative"),
        (
            lambda: hg.fusion.fuse(hg.fusion.FixedIntersection([0.5, 0.5]), estimates(covariances(0, 3, 2))),
            r"shape \(3\)",
        ),
        (
            lambda: hg.fusion.fuse(
                hg.fusion.EqualIntersection(), [*estimates(covariances(0, 1, 2)), *estimates(covariances(0, 1, 3))]
            ),
            "one state dimension",
        ),
        (lambda: hg.fusion.fuse(hg.fusion.EqualIntersection(), []), "one state dimension, got"),
        (
            lambda: network(hg.perfect(), lambda n: {"x": hg.Fusion("missing", hg.fusion.EqualIntersection())}),
            r"a filter that some node has \['cubature', 'linear'\], got 'missing'",
        ),
        (
            lambda: network(hg.perfect(), lambda n: {"x": hg.Fusion("linear", hg.fusion.FixedIntersection([1.0]))}),
            r"shape \(3\)",
        ),
        (lambda: hg.filters.sequential_filter([]), "filters of as many states and inputs each, got"),
        (lambda: hg.fusion.WeightedFusion([0.5, 0.6]), "sum to 1"),
        (lambda: hg.fusion.fuse(hg.fusion.WeightedFusion([0.5, 0.5]), estimates(covariances(0, 3, 2))), r"shape \(3\)"),
        (lambda: quantized({"a": QUANTIZER}), r"quantizers: expected one for each node of \['a', 'b', 'c'\]"),
        (lambda: quantized(3.0), "quantizer: expected an AbstractQuantizer, got float"),
        (lambda: quantized(hg.fusion.UniformQuantizer(8, [1.0, 2.0, 3.0])), r"numbers or shape \(2,\)"),
        (
            lambda: quantized({"a": QUANTIZER, "b": QUANTIZER, "c": hg.fusion.EscapeQuantizer(9, 1.0, 0.5, 0.1, 1e-3)}),
            "objects of one structure",
        ),
    ],
)
def test_bad_fusions(call, message):
    with pytest.raises(ValueError, match=message):
        call()
