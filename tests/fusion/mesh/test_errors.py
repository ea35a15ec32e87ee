"""Covariances of all nodes' errors, against the same problem worked out from its sources, and limit cases."""

from itertools import product

import numpy as np
import pytest

import heliograph as hg
from tests.fusion.mesh.worlds import NODES, PLANT, RING, ROWS, Sources, best, by_trace, equal, models, network, senders

LINK = hg.erasure(hg.perfect(), 0.7)
EVERYBODY = {name: [other for other in NODES if other != name] for name in NODES}
RULES = {
    "best": hg.fusion.MatrixWeights(),
    "diagonal": hg.fusion.DiagonalWeights(),
    "equal": hg.fusion.EqualIntersection(),
    "trace": hg.fusion.TraceIntersection(),
    "diffusion": hg.fusion.DiffusionWeights(),
}


@pytest.fixture(scope="module")
def lossy():
    return network(RULES, link=LINK)


def arrivals(net, fusion, steps, seed):
    """First steps of a longer draw, which is one program whatever their number."""
    return hg.simulation.mesh_arrivals(net, fusion, 80, seed)[:steps]


def central(steps):
    """Covariance of the filter that receives every measurement, after so many steps."""
    a, q, p, h, r = models()
    total = sum(x.T @ np.linalg.solve(y, x) for x, y in zip(h, r, strict=True))
    for _ in range(steps):
        p = a @ p @ a.T + q
        p = np.linalg.inv(np.linalg.inv(p) + total)
    return p


@pytest.mark.slow
@pytest.mark.parametrize(("name", "weights"), [("best", best), ("equal", equal), ("trace", by_trace)])
def test_errors_given_a_pattern_are_those_of_the_stacked_problem(lossy, name, weights):
    arrived = arrivals(lossy, name, 8, 3)
    errors = hg.simulation.mesh_errors(lossy, name, arrived)
    oracle = Sources(weights)
    for k, flags in enumerate(arrived[:, :, 0]):
        oracle.step(flags)
        # best weights: the library takes a millionth part of a percent of independent error for granted
        assert errors.actual[k] == pytest.approx(oracle.covariances(), rel=1e-6 if name == "best" else 1e-10)
        if name != "best":
            assert errors.claimed[k] == pytest.approx(np.array(oracle.believed), rel=1e-10)
    assert errors.joint == pytest.approx(oracle.joint, rel=1e-6, abs=1e-8)
    assert errors.claim == "exact"


def test_an_intersection_claims_at_least_its_error_for_every_pattern(lossy):
    for seed, name in product(range(3), ("equal", "trace")):
        errors = hg.simulation.mesh_errors(lossy, name, arrivals(lossy, name, 30, seed))
        assert np.linalg.eigvalsh(errors.claimed - errors.actual).min() > -1e-12


def test_best_weights_are_no_worse_than_any_other_of_one_step(lossy):
    arrived = arrivals(lossy, "best", 30, 1)  # as many as in the test before, of which the first step counts
    result = {name: hg.simulation.mesh_errors(lossy, name, arrived).mean_trace() for name in RULES}
    assert all(result["best"][0] <= item[0] * (1 + 1e-7) for item in result.values())


@pytest.mark.slow
def test_where_everybody_receives_everybody_every_node_is_the_central_filter():
    whole = network(RULES, EVERYBODY)
    for name in ("best", "diagonal", "equal", "trace"):
        errors = hg.simulation.mesh_errors(whole, name, 6)
        # best weights of equal estimates are found to the root of what they are taken to differ by
        assert errors.actual[-1] == pytest.approx(np.tile(central(6), (4, 1, 1)), rel=1e-9)
        assert errors.claimed[-1] == pytest.approx(errors.actual[-1], rel=1e-9)


@pytest.mark.slow
def test_as_many_rounds_as_the_graph_is_long_make_every_node_the_central_filter():
    line = {"a": ["b"], "b": ["a", "c"], "c": ["b", "d"], "d": ["c"]}
    for rounds, same in ((3, True), (2, False)):
        errors = hg.simulation.mesh_errors(network({"m": hg.fusion.EqualIntersection()}, line, rounds=rounds), "m", 5)
        assert np.allclose(errors.actual[-1], central(5), rtol=1e-9) == same
        assert np.linalg.eigvalsh(errors.claimed - errors.actual).min() > -1e-12


@pytest.mark.slow
def test_rounds_with_losses_claim_at_least_the_error_and_beat_one_round():
    rules = {"m": hg.fusion.TraceIntersection()}
    result = {}
    for rounds in (1, 2):
        net = network(rules, link=LINK, rounds=rounds)
        errors = [hg.simulation.mesh_errors(net, "m", arrivals(net, "m", 25, seed)) for seed in range(4)]
        assert min(np.linalg.eigvalsh(e.claimed - e.actual).min() for e in errors) > -1e-12
        result[rounds] = np.mean([e.mean_trace()[5:] for e in errors])
    assert result[2] < result[1]


def available(arrived):
    """Which measurements (step, node) can be at each node after the last step: by one exchange a step."""
    known = [set() for _ in NODES]
    for k, flags in enumerate(arrived[:, :, 0]):
        before = [set(mine) for mine in known]
        for i, mine in enumerate(senders()):
            for j, arrives in zip(mine, flags[i], strict=False):
                if arrives:
                    known[i] |= before[j] | {(k, j)}
    return known


def test_the_bound_is_the_best_linear_estimate_from_all_that_can_be_there(lossy):
    steps = 5
    arrived = arrivals(lossy, "trace", steps, 2)
    a, q, p, h, r = models()
    n = len(a)
    # States of all steps as maps of x_0 and every w, white.
    maps = [np.pad(np.linalg.cholesky(p), ((0, 0), (0, n * steps)))]
    for k in range(steps):
        w = np.zeros((n, n * (steps + 1)))
        w[:, n * (k + 1) : n * (k + 2)] = np.linalg.cholesky(q)
        maps.append(a @ maps[-1] + w)
    bound = hg.simulation.best_possible(lossy, "trace", arrived)
    for i, mine in enumerate(available(arrived)):
        rows = [(h[j] @ maps[k + 1], r[j]) for k, j in sorted(mine) if len(h[j])]
        output = np.concatenate([part for part, _ in rows])
        noise = np.zeros((len(output), len(output)))
        row = 0
        for part, item in rows:
            noise[row : row + len(part), row : row + len(part)] = item
            row += len(part)
        cross = maps[-1] @ output.T
        least = maps[-1] @ maps[-1].T - cross @ np.linalg.solve(output @ output.T + noise, cross.T)
        assert bound[i] == pytest.approx(least, rel=1e-9)


def test_no_rule_beats_the_bound(lossy):
    arrived = arrivals(lossy, "best", 12, 5)
    bound = hg.simulation.best_possible(lossy, "best", arrived)
    for name in RULES:
        error = hg.simulation.mesh_errors(lossy, name, arrived).actual[-1]
        assert np.linalg.eigvalsh(error - bound).min() > -1e-9


def test_the_mean_over_losses_is_that_of_all_patterns_listed():
    neighbours = {"a": ["c"], "c": ["a", "d"], "d": ["a"]}
    net = network({"m": hg.fusion.DiffusionWeights()}, neighbours, link=LINK)
    mean = hg.simulation.mean_mesh_errors(net, "m", 3)
    assert mean.claim == "exact"
    oracle = listed_mean(neighbours, ["a", "c", "d"], 3, 0.7)
    assert mean.joint == pytest.approx(oracle, rel=1e-9)


def listed_mean(neighbours, names, steps, chance):
    """Mean of J over all patterns of every step, for diffusion with equal shares."""
    a, q, p, h, r = models(PLANT, ROWS, names)
    n, receives = len(a), senders(neighbours, names)
    count = len(names)
    joint = np.tile(p, (count, count))
    believed = [p] * count
    for _ in range(steps):
        gains = []
        for i, mine in enumerate(receives):
            predicted = a @ believed[i] @ a.T + q
            total = sum(h[j].T @ np.linalg.solve(r[j], h[j]) for j in mine)
            believed[i] = np.linalg.inv(np.linalg.inv(predicted) + total)
            gains.append(([believed[i] @ h[j].T @ np.linalg.inv(r[j]) for j in mine], np.eye(n) - believed[i] @ total))
        mean = np.zeros_like(joint)
        edges = [(i, c) for i, mine in enumerate(receives) for c in range(1, len(mine))]
        for pattern in product([0, 1], repeat=len(edges)):
            there = dict(zip(edges, pattern, strict=True))
            m, f = np.zeros_like(joint), np.zeros((count * n, n))
            k = np.zeros((count * n, sum(map(len, h))))
            starts = np.concatenate([[0], np.cumsum(list(map(len, h)))])
            for i, mine in enumerate(receives):
                rows = slice(i * n, (i + 1) * n)
                used = np.eye(n)
                for c, j in enumerate(mine):
                    if c and not there[i, c]:
                        continue
                    used = used - gains[i][0][c] @ h[j]
                    k[rows, starts[j] : starts[j + 1]] += gains[i][0][c]
                    if c:
                        share = gains[i][1] @ a / len(mine)
                        m[rows, j * n : (j + 1) * n] += share
                        m[rows, rows] -= share
                m[rows, rows] += used @ a
                f[rows] = used
            noise = np.zeros((k.shape[1],) * 2)
            for j in range(count):
                noise[starts[j] : starts[j + 1], starts[j] : starts[j + 1]] = r[j]
            probability = chance ** sum(pattern) * (1 - chance) ** (len(pattern) - sum(pattern))
            mean += probability * (m @ joint @ m.T + f @ q @ f.T + k @ noise @ k.T)
        joint = mean
    return joint.reshape(count, n, count, n)


def test_frozen_best_weights_claim_what_they_err():
    net = network({"m": hg.fusion.DiagonalWeights()}, link=LINK)
    frozen = hg.simulation.freeze(net, "m", arrivals(net, "m", 60, 0), last=40)
    assert frozen.claims()["a"]["m"] == "nominal"
    errors = hg.simulation.mesh_errors(frozen, "m", arrivals(net, "m", 80, 9))
    ratio = np.trace(errors.actual[20:], axis1=2, axis2=3).mean(0) / np.trace(
        errors.claimed[20:], axis1=2, axis2=3
    ).mean(0)
    assert ratio == pytest.approx(np.ones(4), abs=0.1)  # means over 40 and 60 steps of losses


@pytest.mark.slow
def test_frozen_weights_that_are_computed_ahead_are_those_of_a_run(monkeypatch):
    """A recording takes them for some rows at a time by native code, a run at each step by XLA."""
    net = network({"d": hg.fusion.DiagonalWeights(), "m": hg.fusion.MatrixWeights()}, link=LINK)
    for name in ("d", "m"):
        net = hg.simulation.freeze(net, name, arrivals(net, name, 6, 0), last=3)
    record = hg.monte_carlo(net, 11, 1, 4)
    monkeypatch.setattr("heliograph.simulation.recordings.scan_recording.ROWS", 4)
    reports = {f: {n: item.values[0] for n, item in record.reports[f].items()} for f in ("d", "m")}
    again = hg.run(net, {n: z[0] for n, z in record.measurements.items()}, reports=reports)
    for node in net.names:
        for name in ("d", "m"):
            ours, theirs = again.estimates[node][name], record.estimates[node][name]
            # Rounding of two compilers over eleven steps.
            assert ours.mean == pytest.approx(np.asarray(theirs.mean[0]), rel=1e-10, abs=1e-10)
            assert ours.covariance == pytest.approx(np.asarray(theirs.covariance[0]), rel=1e-10)


def test_a_one_way_ring_is_not_starved():
    """Two nodes of opposite sides know a state each: a share by trace alone follows the one that is nearer."""
    names = [f"n{i:02}" for i in range(12)]
    ring = {name: [names[i - 1]] for i, name in enumerate(names)}
    plant = hg.LinearPlant(1.1 * np.eye(2), 0.1 * np.eye(2), np.zeros(2), np.eye(2))
    rows = {"n00": ([[1.0, 0.0]], 0.1), "n06": ([[0.0, 1.0]], 0.1)}
    rules = {"equal": hg.fusion.EqualIntersection(), "m": hg.fusion.TraceIntersection()}
    largest = {}
    for name in rules:
        errors = hg.simulation.mesh_errors(network(rules, ring, plant=plant, rows=rows), name, 80)
        assert np.linalg.eigvalsh(errors.claimed - errors.actual).min() > -1e-9
        largest[name] = np.trace(errors.claimed[-1], axis1=1, axis2=2).max()
    alone = Sources(trace_alone, plant, rows, ring, names)
    for _ in range(80):
        alone.step(np.ones((12, 2), dtype=bool))
    starved = max(np.trace(item) for item in alone.believed)
    assert 2 * largest["m"] < largest["equal"] and 10 * largest["m"] < starved


def trace_alone(i, there, believed, joint):
    """Intersection with shares proportional to trace^-4, whatever else is known."""
    shares = np.array([np.trace(believed[j]) for j in there]) ** -4.0
    information = [s / shares.sum() * np.linalg.inv(believed[j]) for s, j in zip(shares, there, strict=True)]
    covariance = np.linalg.inv(sum(information))
    return [covariance @ item for item in information], covariance


def test_information_consensus_without_a_cap_on_its_counts_is_inconsistent():
    """Counting every measurement omega = N times, as if consensus had ended: the claim is a fraction of the error."""
    a, q, p, h, r = models()
    n, count, receives = len(a), len(NODES), senders()
    joint, believed = np.tile(p, (count, count)), [p] * count
    weight = [np.array([1 / len(mine)] * len(mine)) for mine in receives]
    s = [x.T @ np.linalg.solve(y, x) for x, y in zip(h, r, strict=True)]
    for _ in range(30):
        m, f, k = np.zeros_like(joint), np.zeros((count * n, n)), np.zeros_like(joint)
        following = []
        information = [np.linalg.inv(x) for x in believed]
        for i, mine in enumerate(receives):
            rows = slice(i * n, (i + 1) * n)
            fused = np.linalg.inv(sum(w * information[j] for w, j in zip(weight[i], mine, strict=True)))
            total = count * sum(w * s[j] for w, j in zip(weight[i], mine, strict=True))
            following.append(np.linalg.inv(np.linalg.inv(a @ fused @ a.T + q) + total))
            f[rows] = np.eye(n) - following[i] @ total
            for w, j in zip(weight[i], mine, strict=True):
                m[rows, j * n : (j + 1) * n] = f[rows] @ a @ fused @ (w * information[j])
                k[rows, j * n : (j + 1) * n] = following[i] * w * count
        noise = np.zeros_like(joint)
        for j in range(count):
            noise[j * n : (j + 1) * n, j * n : (j + 1) * n] = s[j]
        joint, believed = m @ joint @ m.T + f @ q @ f.T + k @ noise @ k.T, following
    error = [joint[i * n : (i + 1) * n, i * n : (i + 1) * n] for i in range(count)]
    nees = [np.trace(np.linalg.solve(x, e)) / n for x, e in zip(believed, error, strict=True)]
    assert max(nees) > 1.3


@pytest.mark.parametrize(
    ("call", "line"),
    [
        (lambda net: hg.simulation.mesh_errors(net, "none", 3), "fusion: expected one between neighbours"),
        (
            lambda net: hg.simulation.mesh_errors(net, "best", np.ones((3, 4, 1, 2), bool)),
            "arrivals: expected a number",
        ),
        (lambda net: hg.simulation.mesh_errors(net, "best", 0), "number of steps: expected"),
        (lambda net: hg.simulation.mean_mesh_errors(net, "trace", 3), "expected best weights or diffusion"),
        (lambda net: hg.simulation.freeze(net, "trace", 3), "fusion 'trace' to freeze: expected best weights"),
        (lambda net: hg.simulation.freeze(net, "best", 3, last=4), "last: expected at most the 3 steps"),
        (lambda net: hg.simulation.mesh_arrivals(net, "best", 0, 1), "horizon: expected"),
    ],
)
def test_bad_input_is_refused_in_a_line(lossy, call, line):
    with pytest.raises(ValueError, match=line) as error:
        call(lossy)
    assert "\n" not in str(error.value)


def test_losses_in_bursts_have_no_mean_here():
    burst = hg.gilbert_elliott(hg.perfect(), hg.erasure(hg.perfect(), 0.0), 0.05, 0.2)
    net = network({"m": hg.fusion.MatrixWeights()}, RING, link=burst)
    with pytest.raises(ValueError, match="losses that are independent over steps"):
        hg.simulation.mean_mesh_errors(net, "m", 3)


@pytest.mark.slow
def test_noise_that_is_known_by_a_bound_makes_upper_claims():
    """`Contaminated.at_most` gives the largest covariance: what is computed with it is no error, but bounds it."""
    plant, noise = hg.LinearPlant([[0.9]], 0.2, [0.0], 1.0), hg.Contaminated.at_most(0.1, 0.05, 4.0)
    sensor = hg.LinearSensor([[1.0]], noise)
    node = hg.Node(sensor, hg.perfect(1), {"own": hg.linear_filter(plant, sensor, hg.perfect(1))})
    fusion = hg.Fusion("own", hg.fusion.MatrixWeights(), neighbours={"a": ["b"], "b": ["a"]})
    network = hg.Network(plant, {"a": node, "b": node}, {"mesh": fusion})
    assert hg.simulation.mesh_errors(network, "mesh", 3).claim == "upper"
    assert hg.simulation.mean_mesh_errors(network, "mesh", 3).claim == "upper"
