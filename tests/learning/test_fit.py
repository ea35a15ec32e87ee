"""What is free is learned: likelihoods by an oracle, derivatives by differences, estimates with honest intervals."""

import numpy as np
import pytest

import heliograph as hg
from heliograph.learning.likelihood import LikelihoodSurface, gather_data
from heliograph.learning.likelihood.trust_region import maximise_from_starts
from tests.oracles.learning_links import likelihood

STEPS = 400
INPUTS = np.where(np.arange(STEPS) // 30 % 2, 0.4, -0.4)[:, None]
TRUTH = {"plant noise": 0.2, "mean gain": 0.8, "gain variance": 0.16, "hop noise": 0.3}


def network():
    """x+ = .95 x + u + w; a relayed measurement that is lost now and then, and a direct one."""
    mean, variance = hg.free(0.7, "mean gain"), hg.free(0.1, "gain variance", "positive")
    law = hg.random_affine.GivenMoments([mean, mean**2 + variance])
    plant = hg.LinearPlant([[0.95]], hg.free(0.3, "plant noise"), [0.0], [[1.0]], [[1.0]])
    sensor = hg.LinearSensor([[1.0], [1.0]], np.diag([0.3, 0.2]))
    channel = hg.parallel([hg.erasure(hg.hop(law, hg.free(0.2)), 0.8), hg.perfect()])
    return hg.Network(plant, {"node": hg.Node(sensor, channel, {})})


@pytest.fixture(scope="module")
def recording():
    """Of the world with gains 0.4 and 1.2, by hand."""
    rng = np.random.default_rng(0)
    w, *noises = np.sqrt([0.2, 0.3, 0.2, 0.3])[:, None] * rng.normal(size=(4, STEPS))
    x, states = rng.normal(), []
    for u, noise in zip(INPUTS[:, 0], w, strict=True):
        x = 0.95 * x + u + noise
        states.append(x)
    sent, direct = states + noises[0], states + noises[1]
    relayed = np.where(rng.random(STEPS) < 0.8, rng.choice([0.4, 1.2], STEPS) * sent + noises[2], np.nan)
    measurements = {"node": np.stack([relayed, direct], axis=1)[None]}
    return hg.Record(np.arange(1.0, STEPS + 1), ("x0",), np.reshape(states, (1, STEPS, 1)), measurements, {})


@pytest.fixture(scope="module")
def result(recording):
    return hg.fit(network, recording, INPUTS, starts=3)


def oracle(values, z, form, inputs=INPUTS):
    mean, variance, noise = values["mean gain"], values["gain variance"], values["hop noise"]
    m, item = np.diag([mean, 1.0]), np.eye(1)

    def spread(w):
        return np.diag([variance * w[0, 0] + noise, 0.0])

    c, r = np.ones((2, 1)), np.diag([0.3, 0.2])
    model = (0.95 * item, item, values["plant noise"] * item, c, r, 0.0, m, np.zeros(2), spread, np.zeros(1), item)
    return likelihood(model, z, inputs, form)


@pytest.mark.parametrize("form", ["linear", "conditional"])
def test_the_likelihood_is_that_of_the_recursion(result, recording, form):
    solution = next(single for single in result.solutions if single.form == form)
    values = result.description.parameters.known(solution.x)
    assert set(values) == {"plant noise", "mean gain", "gain variance", "hop noise"}
    expected = oracle(values, recording.measurements["node"][0], form)
    assert result.log_likelihoods[form] == pytest.approx(expected, rel=1e-12)


@pytest.mark.slow
def test_what_is_learned_covers_the_truth(result):
    assert result.converged
    for row in result.rows():
        assert row.low < row.estimate < row.high and row.identified and not row.boundary
        assert abs(row.estimate - TRUTH[row.name]) < 4 * row.standard_error


@pytest.mark.slow
def test_the_network_runs(result, recording):
    record = hg.run(result.network, {"node": recording.measurements["node"][0]}, INPUTS)
    assert record.measurements["node"].shape == (STEPS, 2)
    assert result.network.plant.noise.covariance[0, 0] == result.values["plant noise"]


def test_scores_are_derivatives_of_the_likelihood(result, recording):
    """By central differences, whose own error is of the order of the step's square."""
    step, shifts = 1e-5, 1e-5 * np.eye(4)
    for solution in result.solutions:
        surface = solution.surface
        x = solution.x + np.array([0.3, -0.2, 0.1, 0.4])
        at = surface.evaluations(x[None])
        totals = surface.evaluations(np.concatenate([x + shifts, x - shifts])).total
        np.testing.assert_allclose(at.gradient[0], (totals[:4] - totals[4:]) / (2 * step), rtol=1e-6, atol=1e-4)
        np.testing.assert_allclose(at.information, at.halves.sum(axis=1))
        gradients = surface.evaluations(solution.x[None]).gradient
        assert np.abs(gradients).max() < 1e-5


def test_intervals_by_every_method_hold_the_estimate_and_hardly_differ_in_order(result):
    rows = {
        method: result.rows(method, "conditional")
        for method in ("cosines", "bartlett", "white", "hessian", "bootstrap")
    }
    for item in zip(*rows.values(), strict=True):
        errors = [row.standard_error for row in item]
        assert max(errors) < 3 * min(errors)
        assert all(row.low < row.estimate < row.high for row in item)
    np.testing.assert_allclose(
        np.sqrt(np.diag(result.covariance)), [row.standard_error for row in rows["cosines"]], rtol=1e-8
    )
    with pytest.raises(ValueError, match="method of intervals: expected one of cosines"):
        result.rows("wald")


def test_a_profile_ends_where_the_likelihood_has_fallen(result):
    """At the end of an interval, with all others at their best, l is lower by half the 95 % point of chi-square."""
    linear = result.solutions[0]
    place = linear.parameters.entries[1].coordinate
    row = result.rows("profile", "linear")[1]
    start = np.repeat(linear.x[None], 2, axis=0)
    start[:, place] = np.log([row.low, row.high])
    active = np.ones(start.shape, dtype=bool)
    active[:, place] = False
    fallen = (
        linear.total - maximise_from_starts(linear.surface.evaluate, start, active, None, linear.surface.domains).total
    )
    np.testing.assert_allclose(fallen, 1.9207, atol=0.01)  # ends are exact to a thousandth of the root of a fall
    narrower = result.rows("profile", "linear", level=0.9)[1]
    assert row.low < narrower.low < narrower.estimate < narrower.high < row.high
    white, other = (result.rows("white", "linear", level)[1] for level in (0.95, 0.9))
    widths = [np.log(r.high / r.low) for r in (white, other)]
    assert widths[1] / widths[0] == pytest.approx(1.6449 / 1.9600, abs=1e-4)  # quantiles of the normal law
    with pytest.raises(ValueError, match="level of intervals"):
        result.rows(level=0.3)


def test_several_recordings_are_one_likelihood(result, recording):
    z = recording.measurements["node"][0]
    solution = result.solutions[0]
    surface = solution.surface
    parts = gather_data(result.description.start, [z, z[:150]], [INPUTS, INPUTS[:150]], 4)
    assert parts.lengths == (STEPS, 150) and parts.measurements.shape == (2, STEPS, 2)
    whole = LikelihoodSurface(surface.objective, parts).evaluations(solution.x[None]).total
    values = result.description.parameters.known(solution.x)
    short = oracle(values, z[:150], solution.form, INPUTS[:150])
    assert whole == pytest.approx(surface.evaluations(solution.x[None]).total + short, rel=1e-12)


def test_who_interrupts_keeps_the_best_so_far(recording):
    def stop(line):
        if "linear: step 2" in line:
            raise KeyboardInterrupt

    fitted = hg.fit(network, recording, INPUTS, starts=3, progress=stop)
    assert fitted.stopped and not fitted.converged
    assert fitted.sentences[0] == "Stopped before the end: this is the best so far."
    assert all(np.isfinite(row.estimate) for row in fitted.rows())


def test_who_interrupts_as_the_second_form_begins_keeps_the_first(recording, monkeypatch):
    """Before the second form's first point there is none of it: the first form's maximum is the best so far."""
    evaluations = LikelihoodSurface.evaluations

    def stopping(surface, x):
        if surface.objective.form == "conditional" and len(x) == 1:
            raise KeyboardInterrupt
        return evaluations(surface, x)

    monkeypatch.setattr(LikelihoodSurface, "evaluations", stopping)
    fitted = hg.fit(network, recording, INPUTS, starts=1)
    assert fitted.stopped and [solution.form for solution in fitted.solutions] == ["linear"]
    assert fitted.best.converged and np.isfinite(fitted.best.total)
    assert "Stopped before the end: this is the best so far." in fitted.sentences


def chain():
    first = hg.hop(hg.Rayleigh(hg.free(0.7, "fading")), 0.2)
    plant = hg.LinearPlant([[0.95]], 0.2, [0.0], [[1.0]], [[1.0]])
    channel = hg.amplify_and_forward([first, hg.hop(hg.free(0.9, "gain"), hg.free(0.3, "last noise"))])
    return hg.Network(plant, {"node": hg.Node(hg.LinearSensor([[1.0]], 0.0), channel, {})})


def test_a_ridge_is_said_before_the_data():
    """The route's mean gain and its noise, gain^2 0.2 + last noise, are two of three numbers."""
    before = hg.learning.identifiable(chain, INPUTS)
    assert before.ridges == 1 and before.identified == ()
    assert before.sentences == (
        "Of fading, gain and last noise only the product fading * gain and one other combination are identified; "
        "fix one.",
    )


@pytest.mark.parametrize(
    ("build", "data", "message"),
    [
        (network, np.zeros((STEPS, 2)), "recording: expected measurements that vary, got 0 throughout"),
        (network, np.full((STEPS, 2), np.nan), "at least 40 numbers that arrived for 4 free ones, got 0"),
        (network, [], "recordings: expected at least one, got none"),
        (network, {"other": np.zeros((STEPS, 2))}, r"measurements of the nodes \['node'\], got \['other'\]"),
        (network, np.zeros((STEPS, 3)), r"measurements of 'node': expected shape \(rows, 2\)"),
    ],
)
def test_recordings_that_cannot_be_learned_from(build, data, message):
    with pytest.raises(ValueError, match=message):
        hg.fit(build, data, INPUTS)


def test_a_value_of_a_noise_with_two_values_is_learned():
    """Its powers, 0 to 2, are moments of a noise that depends on what is searched for."""

    def network_of(value):
        noise = hg.random_affine.FiniteSupport([[value], [-0.2]], [0.3, 0.7])
        plant = hg.LinearPlant([[0.9]], 0.2, [0.0], 1.0)
        return hg.Network(plant, {"a": hg.Node(hg.LinearSensor([[1.0]], 0.1), hg.hop(1.0, noise), {})})

    z = hg.monte_carlo(network_of(2.0), STEPS, 1, key=1).measurements["a"][0]
    fitted = hg.fit(lambda: network_of(hg.free(0.5, "value")), {"a": z})
    (row,) = fitted.rows()
    assert row.low <= 2.0 <= row.high and row.high - row.low < 0.5
    node = fitted.network.nodes["a"]
    by_filter = hg.log_likelihood(hg.linear_filter(fitted.network.plant, node.sensor, node.channel), z)
    np.testing.assert_allclose(fitted.log_likelihoods["linear"], by_filter, rtol=1e-10)  # 400 terms of order 1


def test_a_plant_is_learned_from_its_true_states_where_nothing_arrived():
    """E x_k+1 = a x_k of 199 pairs: least squares, whose deviation is some .04."""
    rng, x = np.random.default_rng(0), np.zeros((200, 1))
    for k in range(1, 200):
        x[k] = 0.8 * x[k - 1] + 0.3 * rng.normal()
    sensor = hg.LinearSensor([[1.0]], 0.1)

    def build():
        plant = hg.LinearPlant([[hg.free(0.5, "a", "real")]], 0.1, [0.0], 1.0)
        return hg.Network(plant, {"node": hg.Node(sensor, hg.perfect(), {"k": hg.kalman_filter(plant, sensor)})})

    found = hg.fit(build, {"node": np.full((200, 1), np.nan)}, truth=x, starts=1)
    assert abs(found.values["a"] - 0.8) < 0.12


def test_a_list_of_rows_is_one_recording_and_not_one_of_each_row():
    def build():
        plant, sensor = hg.LinearPlant([[0.9]], hg.free(0.1), [0.0], 1.0), hg.LinearSensor([[1.0]], 0.1)
        return hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {})})

    z = np.random.default_rng(0).normal(size=(40, 1))
    forms = z, z.tolist(), z[:, 0].tolist(), [z], {"a": z}
    found = {hg.fit(build, form, starts=1).log_likelihood for form in forms}
    assert len(found) == 1
    halves = hg.fit(build, [z[:20, 0].tolist(), z[20:, 0].tolist()], starts=1)
    assert halves.log_likelihood not in found
    for seed in (-1, True, 1.5, "a"):
        with pytest.raises(hg.InputError, match="seed: expected a whole number from 0"):
            hg.learning.identifiable(build, horizon=20, seed=seed)


SPREADS = {
    "two gains that begin as one": lambda: hg.Discrete([hg.free(1.0, "a"), hg.free(1.0, "b")], [0.5, 0.5]),
    "a deviation that begins as 0": lambda: hg.random_affine.GivenMoments([0.7, 0.49 + hg.free(0.0, "a") ** 2]),
}
NEARBY = {
    "two gains that begin as one": lambda: hg.Discrete([hg.free(0.8, "a"), hg.free(1.1, "b")], [0.5, 0.5]),
    "a deviation that begins as 0": lambda: hg.random_affine.GivenMoments([0.7, 0.49 + hg.free(0.2, "a") ** 2]),
}


@pytest.mark.parametrize("name", SPREADS)
def test_a_gain_that_is_known_at_the_start_alone_is_learned_as_a_random_one(name):
    rng = np.random.default_rng(0)
    z = rng.choice([0.4, 1.0], 150) * (3 + 0.3 * rng.normal(size=150)) + 0.1 * rng.normal(size=150)

    def build(law):
        plant, sensor = hg.LinearPlant([[1.0]], 0.0, [3.0], 0.01), hg.LinearSensor([[1.0]], 0.09)
        return hg.Network(plant, {"a": hg.Node(sensor, hg.hop(law(), 0.01), {})})

    found, near = (hg.fit(lambda law=laws[name]: build(law), z, starts=3) for laws in (SPREADS, NEARBY))
    assert [solution.form for solution in found.solutions] == ["linear", "conditional"]
    assert found.log_likelihood == pytest.approx(near.log_likelihood, abs=1e-4)
    assert "not identified" not in str(found)
