"""Filters of links whose gain or noise is told with each message: the same as filters that knew them beforehand."""

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.model import Pilot, over_time, told
from heliograph.random_affine import FiniteSupport

PLANT = hg.LinearPlant([[0.95, 0.1], [0.0, 0.9]], 0.1 * np.eye(2), [0.5, 0.0], np.eye(2))
SENSOR = hg.LinearSensor([[1.0, 0.3]], 0.05, outputs=["y"])
BURSTS = hg.gilbert_elliott(hg.hop(1.0, 0.1), hg.hop(0.2, 0.1), 0.2, 0.3)
STEPS = 12


def rows(numbers):
    """Values that arrived, with one missing, and the numbers that came with them (steps, 1 + told)."""
    values = np.random.default_rng(1).normal(size=STEPS)
    values[4] = np.nan
    return np.column_stack([values, numbers])


def gains():
    return np.random.default_rng(2).uniform(0.2, 1.8, STEPS)


def declared(a):
    return hg.hop(1.0, a[0])


LINKS = {  # a link that tells, and the link given what was told
    "gain": (hg.hop(hg.Rayleigh(0.8), 0.1, known=True), lambda a: hg.hop(a, 0.1)),
    "variance": (told(declared, ["variance"], typical=[0.1]), lambda a: hg.hop(1.0, a)),
    "scatter": (
        told(lambda a: hg.hop(hg.Rayleigh(a[0]), 0.1), ["scale"], typical=[0.8]),
        lambda a: hg.hop(hg.Rayleigh(a), 0.1),
    ),
    "second hop": (
        hg.amplify_and_forward([hg.hop(hg.Rayleigh(0.8), 0.1), hg.hop(hg.Rayleigh(1.0), 0.2, known=True)]),
        lambda a: hg.amplify_and_forward([hg.hop(hg.Rayleigh(0.8), 0.1), hg.hop(a, 0.2)]),
    ),
    "dropout": (
        hg.dropout(hg.hop(hg.Rayleigh(0.8), 0.1, known=True), 0.9),
        lambda a: hg.dropout(hg.hop(a, 0.1), 0.9),
    ),
    "chain": (
        hg.amplify_and_forward(
            [
                hg.gilbert_elliott(hg.hop(1.0, 0.1), hg.hop(0.2, 0.1), 0.2, 0.3),
                hg.hop(hg.Rayleigh(1.0), 0.2, known=True),
            ]
        ),
        None,
    ),
    "delayed": (
        hg.model.delayed(hg.hop(hg.Rayleigh(0.8), 0.1, known=True), 2),
        None,
    ),
}
BEFOREHAND = [name for name, (_, given) in LINKS.items() if given is not None]


@pytest.mark.parametrize("name", BEFOREHAND)
@pytest.mark.parametrize("build", [hg.linear_filter, hg.extended_filter, hg.cubature_filter, hg.unscented_filter])
def test_told_is_known_beforehand(name, build):
    link, given = LINKS[name]
    a = gains()
    filter, beforehand = build(PLANT, SENSOR, link), build(PLANT, SENSOR, over_time([given(v) for v in a]))
    after, expected = filter.run(rows(a)), beforehand.run(rows(a)[:, :1])
    # the same formulas on the same numbers, in another order of rounding
    np.testing.assert_allclose(after.means, expected.means, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(after.covariances, expected.covariances, rtol=1e-11, atol=1e-14)
    assert filter.claim == beforehand.claim


@pytest.mark.parametrize("name", ["gain", "variance", "scatter"])
def test_likelihood_and_smoothing_are_those_of_what_is_known_beforehand(name):
    link, given = LINKS[name]
    a = gains()
    filter = hg.linear_filter(PLANT, SENSOR, link)
    beforehand = hg.linear_filter(PLANT, SENSOR, over_time([given(v) for v in a]))
    likelihoods = hg.log_likelihood(filter, rows(a)), hg.log_likelihood(beforehand, rows(a)[:, :1])
    assert likelihoods[0] == pytest.approx(likelihoods[1], rel=1e-12)
    smoothed, expected = hg.rts_smoother(filter, rows(a)), hg.rts_smoother(beforehand, rows(a)[:, :1])
    np.testing.assert_allclose(smoothed.means, expected.means, rtol=1e-10, atol=1e-13)
    np.testing.assert_allclose(smoothed.covariances, expected.covariances, rtol=1e-10, atol=1e-14)


def test_told_beside_a_link_with_memory_is_the_modal_filter_of_each_message():
    link, _ = LINKS["chain"]
    filter = hg.linear_filter(PLANT, SENSOR, link)
    assert filter.claim == "exact"
    constant = np.full(STEPS, 0.7)
    known = hg.amplify_and_forward([BURSTS, hg.hop(0.7, 0.2)])
    expected = hg.linear_filter(PLANT, SENSOR, known).run(rows(constant)[:, :1])
    np.testing.assert_allclose(filter.run(rows(constant)).means, expected.means, rtol=1e-11, atol=1e-13)


def test_gain_of_a_late_link_is_that_of_arrival():
    link, _ = LINKS["delayed"]
    z = rows(np.full(STEPS, 0.7))
    expected = hg.linear_filter(PLANT, SENSOR, hg.model.delayed(hg.hop(0.7, 0.1), 2)).run(z[:, :1])
    np.testing.assert_allclose(hg.linear_filter(PLANT, SENSOR, link).run(z).means, expected.means, rtol=1e-11)


@pytest.mark.parametrize("known", [True, Pilot(0.04)])
def test_what_is_told_passes_by_all_that_is_built(known):
    hop = hg.hop(hg.Rayleigh(0.8), 0.1, known=known)
    plain = hg.hop(1.0, 0.1)
    for built, outputs in (
        (hg.amplify_and_forward([hop, plain]), 1),
        (hg.amplify_and_forward([plain, hop]), 1),
        (hg.parallel([hop, plain, hop]), 3),
        (hg.model.with_direct_link(hop, plain), 2),
        (hg.superposed([hop, plain], 0.1), 1),
        (hg.dropout(hop, 0.9), 1),
        (hg.erasure(hop, 0.9), 1),
    ):
        assert built.outputs == outputs + (2 if outputs == 3 else 1)


def test_names_of_what_is_told():
    two = hg.parallel([LINKS["gain"][0], LINKS["gain"][0], LINKS["variance"][0]])
    sensor = hg.LinearSensor(np.eye(3, 2), np.eye(3), outputs=["a", "b", "c"])
    node = hg.Node(sensor, two, {})
    assert node.received_names == ("a", "gain_1", "b", "gain_2", "c", "variance")


def test_fusion_centre_that_is_told_by_each_node():
    """Rows of all nodes stand one after another, each node's values before what it is told."""
    links = {"a": LINKS["gain"][0], "b": LINKS["variance"][0]}
    sensors = {"a": SENSOR, "b": hg.LinearSensor([[0.0, 1.0]], 0.2)}
    nodes = {name: hg.Node(sensors[name], links[name], {}) for name in links}
    joint, channel = hg.model.joint_sensor(sensors), hg.parallel(list(links.values()))
    centre = hg.linear_filter(PLANT, joint, channel)
    network = hg.Network(PLANT, nodes, {"all": centre})
    assert network.claims() == {"a": {}, "b": {}, "fused": {"all": "exact"}}
    a, b = gains(), gains()[::-1]
    given = [hg.parallel([hg.hop(g, 0.1), hg.hop(1.0, r)]) for g, r in zip(a, b, strict=True)]
    record = hg.run(network, {"a": rows(a), "b": rows(b)})
    values = np.column_stack([rows(a)[:, 0], rows(b)[:, 0]])
    expected = hg.linear_filter(PLANT, joint, over_time(given)).run(values)
    np.testing.assert_allclose(record.estimates["fused"]["all"].mean, expected.means, rtol=1e-11, atol=1e-13)


def test_of_several_links_only_the_value_is_not_used_whose_number_is_missing():
    """A centre that is told a gain by one node and a variance by the other, and hears one or the other alone."""
    sensors = {"a": SENSOR, "b": hg.LinearSensor([[0.0, 1.0]], 0.2)}
    links = {"a": LINKS["gain"][0], "b": LINKS["variance"][0]}
    centre = hg.linear_filter(PLANT, hg.model.joint_sensor(sensors), hg.parallel(list(links.values())))
    z, a, b = np.concatenate([rows(gains()), rows(gains()[::-1])], axis=1), gains(), gains()[::-1]
    z[2, 1], z[5, 3], z[7, [1, 3]], z[9, 2:] = np.nan, np.nan, np.nan, np.nan
    given = [hg.parallel([hg.hop(g, 0.1), hg.hop(1.0, r)]) for g, r in zip(a, b, strict=True)]
    heard = np.where(np.isnan(z[:, [1, 3]]), np.nan, z[:, [0, 2]])
    expected = hg.linear_filter(PLANT, hg.model.joint_sensor(sensors), over_time(given)).run(heard)
    found = centre.run(z)
    np.testing.assert_allclose(found.means, expected.means, rtol=1e-11, atol=1e-13)
    np.testing.assert_allclose(found.covariances, expected.covariances, rtol=1e-11, atol=1e-14)
    nodes = {name: hg.Node(sensors[name], links[name], {}) for name in links}
    record = hg.run(hg.Network(PLANT, nodes, {"all": centre}), {"a": z[:, :2], "b": z[:, 2:]})
    np.testing.assert_allclose(record.estimates["fused"]["all"].mean, expected.means, rtol=1e-11, atol=1e-13)


def test_message_without_its_number_is_not_used_but_without_a_pilot_by_the_law():
    a = gains()
    z = rows(a)
    z[3, 1] = np.nan
    blank = z.copy()
    blank[3, 0] = np.nan
    blank[3, 1] = 1.0
    filter = hg.linear_filter(PLANT, SENSOR, LINKS["variance"][0])
    np.testing.assert_array_equal(filter.run(z).means, filter.run(blank).means)
    # Without any reading: the filter that knows the law alone.
    pilot = hg.linear_filter(PLANT, SENSOR, hg.hop(hg.Rayleigh(0.8), 0.1, known=Pilot(0.04)))
    z[:, 1] = np.nan
    by_law = hg.linear_filter(PLANT, SENSOR, hg.hop(hg.Rayleigh(0.8), 0.1)).run(z[:, :1])
    np.testing.assert_allclose(pilot.run(z).means, by_law.means, rtol=1e-11, atol=1e-13)


def batch_errors(network, steps, runs, settled):
    """Mean squared error and mean claim of the first state after `settled` steps, in each of some 50 batches."""
    statistics = hg.monte_carlo(network, steps, runs, 3, keep=hg.Statistics()).to_xarray()
    per_batch = statistics["runs"].values
    squared = statistics["errors"].values[:, settled:, 0, 0, 0, 0].mean(axis=1) / per_batch
    return squared, statistics["claimed"].values[:, settled:, 0, 0, 0, 0].mean(axis=1)


def assert_mean(found, expected):
    """Within four standard errors, as the batches show them."""
    assert abs(found.mean() - expected) < 4 * found.std() / np.sqrt(len(found) - 1)


@pytest.mark.parametrize("wrong", [-0.1, 0.0])
def test_numbers_that_give_no_law_refuse_their_message(wrong):
    link = LINKS["variance"][0]
    filter = hg.linear_filter(PLANT, SENSOR, link)
    network = hg.Network(PLANT, {"a": hg.Node(SENSOR, link, {"f": filter})})
    z = rows(gains())
    blank = z.copy()
    z[3, 1], blank[3] = wrong, np.nan
    with pytest.warns(UserWarning, match="node 'a': row 4 is implausible"):
        record = hg.run(network, {"a": z})
    expected = hg.run(network, {"a": blank}).estimates["a"]["f"].mean
    np.testing.assert_array_equal(record.estimates["a"]["f"].mean, expected)
    stream = hg.Stream(filter)
    stream.push(z[0])
    with pytest.raises(ValueError, match="expected a plausible one"):
        stream.push(z[3])
    stream.push(np.array([np.nan, wrong]))  # nothing came, and nothing is used


def test_covariance_that_is_none_refuses_its_message():
    sensor = hg.LinearSensor(np.eye(2), 0.0 * np.eye(2), outputs=["east", "north"])
    link = told(lambda a: hg.hop(1.0, jnp.reshape(a, (2, 2))), list("abcd"), typical=[1.0, 0.0, 0.0, 1.0])
    stream = hg.Stream(hg.linear_filter(PLANT, sensor, link))
    stream.push([0.1, 0.2, 1.0, 0.9, 0.9, 1.0])
    with pytest.raises(ValueError, match="expected a plausible one"):
        stream.push([0.1, 0.2, 1.0, 1.1, 1.1, 1.0])


# E P by quadrature, settled to 1e-9 after 20 steps: x+ = .95 x + w, Q = .1, R = .05, Rayleigh gain of scale .8, n of
# variance .1.
EXPECTED = {0.8: 0.140839, 0.4: 0.122037, 0.2: 0.105783, 0.1: 0.098335, 0.0: 0.095137}


@pytest.mark.slow
@pytest.mark.parametrize("s", EXPECTED)
def test_error_against_the_noise_of_the_pilot(s):
    plant, sensor = hg.LinearPlant([[0.95]], 0.1, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.05)
    link = hg.hop(hg.Rayleigh(0.8), 0.1, known=True if s == 0 else Pilot(s**2))
    network = hg.Network(plant, {"a": hg.Node(sensor, link, {"f": hg.linear_filter(plant, sensor, link)})})
    assert network.claims() == {"a": {"f": "exact"}}
    # 40 steps of 10,000 runs, nearly independent of each other, tell it as well as the last of 250,000.
    squared, claimed = batch_errors(network, 60, 10_000, settled=20)
    for found in (squared, claimed):
        assert_mean(found, EXPECTED[s])


def test_claims():
    link = LINKS["gain"][0]
    other = hg.hop(hg.Rayleigh(0.8), 0.2, known=True)
    filters = {"own": hg.linear_filter(PLANT, SENSOR, link), "other": hg.linear_filter(PLANT, SENSOR, other)}
    network = hg.Network(PLANT, {"a": hg.Node(SENSOR, link, filters)})
    assert network.claims() == {"a": {"own": "exact", "other": "nominal"}}
    near = told(declared, ["variance"], typical=[0.1], exogenous=False)  # as a strength that falls with the distance
    assert hg.linear_filter(PLANT, SENSOR, near).claim == "nominal"
    lost = hg.Network(PLANT, {"a": hg.Node(SENSOR, hg.erasure(link, 0.8), {"f": filters["own"]})})
    assert lost.claims() == {"a": {"f": "exact"}}


NO_CLAIM = {
    "depends on the state": told(declared, ["variance"], typical=[0.1], exogenous=False),
    "leaves open what is not drawn anew with each message": hg.hop(
        hg.Rayleigh(0.8), 0.1, known=Pilot(0.04, fresh=False)
    ),
    "depends on the state and leaves open what is not drawn anew with each message": told(
        lambda a: hg.hop(hg.Rayleigh(a[0]), 0.1), ["scale"], typical=[0.8], exogenous=False, fresh=False
    ),
}


@pytest.mark.parametrize("why", NO_CLAIM)
@pytest.mark.parametrize("arrival", [1.0, 0.8])
def test_where_no_claim_is_made_the_reason_is_named(why, arrival):
    """In claims, in the network as it is printed, and by `check`; a centre claims nothing either."""
    link = NO_CLAIM[why]
    item, channel = hg.linear_filter(PLANT, SENSOR, link), link if arrival == 1 else hg.erasure(link, arrival)
    network = hg.Network(PLANT, {"a": hg.Node(SENSOR, channel, {"f": item})})
    assert network.claims() == {"a": {"f": "nominal"}}
    short = ", not exogenous" * ("state" in why) + ", not fresh" * ("anew" in why)
    assert f"{short})" in repr(network) and "f (nominal)" in repr(network)
    (doubt,) = [d for d in hg.simulation.doubts_before_data(network) if d.words.startswith("told: ")]
    assert doubt.serious and doubt.words.endswith(f"at 'a' {why}, so that claims are nominal")
    nodes = {name: hg.Node(SENSOR, link, {}) for name in ("a", "b")}
    joint = hg.linear_filter(PLANT, hg.model.joint_sensor({"a": SENSOR, "b": SENSOR}), hg.parallel([link, link]))
    assert hg.Network(PLANT, nodes, {"all": joint}).claims()["fused"] == {"all": "nominal"}


def test_a_mode_that_is_told_is_no_memory_that_is_ignored():
    chain = hg.random_affine.MarkovChain([[0.9, 0.1], [0.1, 0.9]])
    link = told(lambda a: hg.hop(hg.Rayleigh(0.2 + 0.8 * a[0]), 0.1), ["mode"], law=chain)
    network = hg.Network(PLANT, {"a": hg.Node(SENSOR, link, {"f": hg.linear_filter(PLANT, SENSOR, link)})})
    assert network.claims() == {"a": {"f": "exact"}}
    assert not any("memory" in doubt.words for doubt in hg.simulation.doubts_before_data(network))


@pytest.mark.slow
@pytest.mark.parametrize(("lost", "ratio"), [(False, 1.18), (True, 0.91)])
def test_what_pilots_leave_open_costs_a_claim_where_it_is_not_fresh(lost, ratio):
    """A Rayleigh gain of scale .8 whose two parts drift by .95 a step, or without which messages are lost below .8.

    E[e^2] over E[P], readings of deviation .4; 1,500 runs tell it to 2 %, half the tolerance.
    """
    rng, runs, steps = np.random.default_rng(4), 1500, 40
    plant, sensor = hg.LinearPlant([[0.95]], 0.1, [0.0], 0.1 / (1 - 0.95**2)), hg.LinearSensor([[1.0]], 0.05)
    filter = hg.linear_filter(plant, sensor, hg.hop(hg.Rayleigh(0.8), 0.1, known=Pilot(0.16, fresh=False)))
    x, parts = rng.normal(0, plant.initial_covariance[0, 0] ** 0.5, runs), 0.8 * rng.normal(size=(2, runs))
    kept, path, z = 0.0 if lost else 0.95, np.empty((steps, runs)), np.empty((steps, runs, 2))
    for k in range(steps):
        x = path[k] = 0.95 * x + rng.normal(0, 0.1**0.5, runs)
        parts = kept * parts + 0.8 * (1 - kept**2) ** 0.5 * rng.normal(size=(2, runs))
        g, y = np.hypot(*parts), x + rng.normal(0, 0.05**0.5, runs)
        z[k] = np.column_stack([g * y + rng.normal(0, 0.1**0.5, runs), g + 0.4 * rng.normal(size=runs)])
        z[k, lost & (g < 0.8)] = np.nan
    found = [filter.run(z[:, run]) for run in range(runs)]
    squared = [np.mean((run.means[20:, 0] - path[20:, i]) ** 2) for i, run in enumerate(found)]
    claimed = np.mean([run.covariances[20:, 0, 0] for run in found])
    assert np.mean(squared) / claimed == pytest.approx(ratio, rel=0.04)


def test_noise_declared_by_messages_of_two_kinds():
    law = FiniteSupport([[0.02], [1.5]], [0.5, 0.5])
    link = told(declared, ["variance"], law=law)
    network = hg.Network(PLANT, {"a": hg.Node(SENSOR, link, {"f": hg.linear_filter(PLANT, SENSOR, link)})})
    runs = hg.monte_carlo(network, 20, 4000, 5)
    numbers = runs.measurements["a"][..., 1]
    assert set(np.unique(numbers)) == {0.02, 1.5}
    squared, claimed = batch_errors(network, 20, 100_000, settled=19)
    assert_mean(squared - claimed, 0.0)


def test_vector_of_numbers():
    sensor = hg.LinearSensor(np.eye(2), 0.0 * np.eye(2), outputs=["east", "north"])
    link = told(lambda a: hg.hop(1.0, jnp.diag(a)), ["var_east", "var_north"], typical=[0.1, 0.2])
    node = hg.Node(sensor, link, {"f": hg.linear_filter(PLANT, sensor, link)})
    assert node.received_names == ("east", "north", "var_east", "var_north")
    z = np.random.default_rng(0).uniform(0.1, 1.0, (STEPS, 4))
    variances = over_time([hg.LinearSensor(np.eye(2), np.diag(v)) for v in z[:, 2:]])
    expected = hg.linear_filter(PLANT, variances, hg.perfect(2)).run(z[:, :2])
    np.testing.assert_allclose(node.filters["f"].run(z).means, expected.means, rtol=1e-11, atol=1e-13)


def test_refusals():
    for wrong, named in (
        (lambda: told(1.0, ["a"], typical=[1.0]), "a function of the numbers"),
        (lambda: told(lambda a: a, ["a"], typical=[1.0]), "a function that returns a link"),
        (lambda: told(declared, ["a"]), "typical numbers"),
        (lambda: told(declared, ["a"], typical=[1.0, 2.0]), "typical numbers"),
        (lambda: told(declared, [" "], typical=[1.0]), "names that are not blank"),
        (lambda: told(declared, ["a", "a"], typical=[1.0, 2.0]), "2 different names"),
        (lambda: told(lambda a: hg.erasure(declared(a), 0.9), ["a"], typical=[1.0]), "erasures"),
        (
            lambda: told(declared, ["a", "b"], law=hg.random_affine.MarkovChain([[0.9, 0.1], [0.2, 0.8]])),
            "1 different names",
        ),
        (lambda: hg.hop(1.0, 0.1, known="yes"), "True, False or a Pilot"),
        (lambda: Pilot(0.0), "noise of a pilot"),
        (lambda: hg.hop(hg.Discrete([0.0, 1.0], [0.5, 0.5], 0.1), 0.1, known=Pilot(0.1)), "known probabilities"),
        (lambda: hg.linear_filter(PLANT, SENSOR, hg.dropout(LINKS["gain"][0], 0.9, 0.05)), "known ones, beside"),
    ):
        with pytest.raises(ValueError, match=named):
            wrong()
    nobody_knows = told(declared, ["variance"], typical=[0.1])
    network = hg.Network(PLANT, {"a": hg.Node(SENSOR, nobody_knows, {})})
    with pytest.raises(ValueError, match="a law of the numbers"):
        hg.monte_carlo(network, 5, 10, 0)
    with pytest.raises(ValueError, match="a filter that takes what a message tells"):
        hg.filters.particle_filter(PLANT, SENSOR, LINKS["gain"][0])


@pytest.mark.parametrize("build", [hg.filters.imm_filter, hg.filters.gpb1_filter, hg.filters.gpb2_filter])
def test_filters_of_modes_are_told_gains_too(build):
    """Beside the modes of a plant: as if each gain had been known beforehand."""
    slow, fast = (hg.LinearPlant([[a]], 0.1, [1.0], 1.0) for a in (0.9, 0.5))
    plant, sensor = hg.markov_plant([slow, fast], [[0.9, 0.1], [0.2, 0.8]]), hg.LinearSensor([[1.0]], 0.1)
    z = np.array([[0.5, 0.9], [0.4, 1.1], [1.0, 2.0]])
    found = build(plant, sensor, hg.hop(hg.Rayleigh(0.8), 0.1, known=True)).run(z)
    right = build(plant, sensor, hg.model.over_time([hg.hop(gain, 0.1) for gain in z[:, 1]])).run(z[:, :1])
    np.testing.assert_allclose(found.means, right.means, rtol=1e-12)
    np.testing.assert_allclose(found.covariances, right.covariances, rtol=1e-12)
    ahead = hg.forecast(found, 1).received
    assert np.isfinite(ahead.mean[0, 0]) and ahead.claim == "nominal"
