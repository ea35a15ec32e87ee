"""A time step that goes backwards and a function that returns what it must not are refused where they come in."""

import re

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.model.checks.plant_inputs import do_inputs_spoil, mask_invalid_covariances

BACKWARDS, WRAPPED, HUGE = -1.0, 2.0**32 - 1, 1e30


def network_of(noise, matrix=lambda u: jnp.eye(2), name="dt"):
    plant = hg.LinearPlant(matrix, noise, [0.0, 0.0], jnp.eye(2), states=["x", "v"], inputs=[name])
    sensor = hg.LinearSensor([[1.0, 0.0]], 0.04, outputs=["y"])
    return hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {"k": hg.kalman_filter(plant, sensor)})})


def walk(u):
    return 0.1 * u[0] * jnp.eye(2)


def doors(network, u):
    """Each way by which inputs of all rows come in."""
    filter, z, u = network.nodes["a"].filters["k"], np.ones((len(u), 1)), np.asarray(u)[:, None]
    return {
        "run": lambda: hg.run(network, {"a": z}, u),
        "simulate": lambda: hg.simulate(network, len(u), 0, inputs=u),
        "monte_carlo": lambda: hg.monte_carlo(network, len(u), 2, 0, keep=hg.Statistics(), inputs=u),
        "filter": lambda: filter.run(z, u),
        "likelihood": lambda: hg.log_likelihood(filter, z, u),
        "smoother": lambda: hg.rts_smoother(filter, z, u),
    }


DOORS = ["run", "simulate", "monte_carlo", "filter", "likelihood", "smoother"]


@pytest.mark.parametrize("door", DOORS)
@pytest.mark.parametrize(
    ("dt", "said"),
    [(BACKWARDS, "does not go backwards, got -1"), (WRAPPED, "-1 as a difference of unsigned"), (HUGE, "at most 2^53")],
)
def test_a_time_step_that_is_none_is_refused(door, dt, said):
    with pytest.raises(ValueError, match="input 'dt', row 3: expected a time step") as raised:
        doors(network_of(walk), [1.0, 1.0, dt, 1.0])[door]()
    assert said in str(raised.value)


@pytest.mark.parametrize(("unit", "said"), [(1.0, "-3 as"), (1e-3, "-3 / 1000 as"), (1e-6, "-3 / 1e+06 as")])
def test_a_counter_that_wrapped_is_named_in_its_own_counts(unit, said):
    """Of milliseconds and microseconds that were made seconds too; hours and months beside them are time steps."""
    filter, z = network_of(walk).nodes["a"].filters["k"], np.ones((2, 1))
    with pytest.raises(ValueError, match=f"row 2: expected a time step, got 4.*: {re.escape(said)} a difference of"):
        filter.run(z, [[1.0], [(2.0**32 - 3) * unit]])
    filter.run(z, [[(2.0**32 - 2.0**25) * unit], [(2.0**32 + 2.0**11) * unit]])


@pytest.mark.parametrize("door", DOORS)
def test_what_a_function_returns_for_the_inputs_is_judged(door):
    """Its name, the row and the value; no input is called dt, so that the function alone is to blame."""
    u = [0.5, 0.5, 2.0, 0.5]
    indefinite = network_of(lambda u: jnp.array([[1.0, u[0]], [u[0], 1.0]]), name="s")
    skewed = network_of(lambda u: jnp.array([[1.0, u[0] - 0.5], [0.0, 1.0]]), name="s")
    imaginary = network_of(walk, lambda u: jnp.diag(jnp.sqrt(1 - u[0]) * jnp.ones(2)), name="s")
    covariance = "process noise covariance(u): expected a covariance, got "
    wrong = {
        f"{covariance}[[1.0, 2.0], [2.0, 1.0]] in row 3, for s = 2": indefinite,
        f"{covariance}[[1.0, 1.5], [0.0, 1.0]] in row 3, for s = 2": skewed,
        "plant matrix(u): expected finite numbers, got [[nan, 0.0], [0.0, nan]] in row 3, for s = 2": imaginary,
    }
    for said, network in wrong.items():
        with pytest.raises(ValueError) as raised:
            doors(network, u)[door]()
        assert str(raised.value) == said


@pytest.mark.parametrize("dt", [BACKWARDS, WRAPPED, HUGE])
def test_a_stream_refuses_it_and_stays(dt):
    """The estimates after it are those of a stream that never had it, bit for bit."""
    filter = network_of(walk).nodes["a"].filters["k"]
    stream, clean = hg.Stream(filter), hg.Stream(filter)
    for step in (0.0, 1.0):
        stream.push([1.0], [step])
        clean.push([1.0], [step])
    for u in (np.array([dt]), [dt], (dt,)):
        with pytest.raises(ValueError, match="input 'dt': expected a time step"):
            stream.push([1.0], u)
    with pytest.raises(ValueError, match="input 'dt': expected a time step"):
        filter.step(filter.init(), [1.0], [dt])
    np.testing.assert_array_equal(stream.push([1.0], [1.0]).covariance, clean.push([1.0], [1.0]).covariance)


def test_a_stream_names_the_function_of_a_live_input():
    filter = network_of(lambda u: jnp.array([[1.0, u[0]], [u[0], 1.0]]), name="s").nodes["a"].filters["k"]
    stream = hg.Stream(filter)
    stream.push([1.0], np.array([0.5]))
    said = r"process noise covariance\(u\): expected a covariance, got .* in step 1, for s = 2"
    with pytest.raises(ValueError, match=said):
        stream.push([1.0], np.array([2.0]))


@pytest.mark.parametrize("door", ["step", "predict", "step_with_smoother"])
def test_a_step_of_a_filter_alone_judges_what_the_functions_return(door):
    """Also after others that are right, of whichever step; what is right passes."""
    filter = network_of(lambda u: u[0] * jnp.eye(2), lambda u: jnp.eye(2) / u[0], "s").nodes["a"].filters["k"]
    state, data = filter.init(), () if door == "predict" else ([1.0],)
    getattr(filter, door)(state, *data, [0.5], 3)
    for s, said in ((-1.0, "process noise covariance.* step 3, for s = -1"), (0.0, "plant matrix.* step 3, for s = 0")):
        with pytest.raises(ValueError, match=said):
            getattr(filter, door)(state, *data, [s], 3)


def test_no_rows_are_the_same_for_functions_of_the_inputs_as_for_constants():
    """No rows give no estimates and the likelihood 1, or what refuses them says so."""
    filter = network_of(walk).nodes["a"].filters["k"]
    z, u = np.ones((0, 1)), np.ones((0, 1))
    assert filter.run(z, u).means.shape == (0, 2)
    assert hg.log_likelihood(filter, z, u) == 0.0  # of a likelihood of 1, exactly
    with pytest.raises(ValueError, match="measurements: expected at least one row, got none"):
        hg.rts_smoother(filter, z, u)


def test_a_step_of_a_filter_takes_what_is_traced():
    filter = network_of(lambda u: u[0] * jnp.eye(2), lambda u: jnp.eye(2) / u[0], "s").nodes["a"].filters["k"]
    state = filter.init()
    with jax.enable_x64(True):
        slope = jax.grad(
            lambda s: filter.predict(state, s[None]).mean.sum() + filter.step(state, [1.0], s[None])[1].mean[0]
        )
        assert np.isfinite(jax.jit(slope)(2.0))


def test_a_timeline_uses_no_event_to_whose_time_there_is_no_prediction():
    """Q is indefinite from an interval of 1.5 on; the events after it are at 1 of the last that was used."""
    network = network_of(lambda u: 0.1 * u[0] * jnp.array([[1.0, u[0] / 1.5], [u[0] / 1.5, 1.0]]))
    with pytest.warns(UserWarning, match="predictions depend on when others are asked for"):
        timeline = hg.Timeline(network, 10.0)
    verdicts = [timeline.push("a", i, time, [1.0]) for i, time in enumerate([1.0, 2.0, 4.0, 3.0, 1e30])]
    assert verdicts == ["used", "used", "implausible", "used", "implausible"]
    assert np.isfinite(timeline.estimates()["a"]["k"].mean).all()


def test_a_recording_is_refused_with_the_row_of_its_time_step():
    table = {"time": [0.0, 1, 2, 3], "dt": [1.0, 1, -1, 1], "y": [1.0] * 4}
    with pytest.raises(ValueError, match="row 3, column 'dt': expected a time step that does not go backwards, got -1"):
        hg.files.read_recording(table, network_of(walk))


CURVED = {  # f, h and what is named: h of a state below 1.2, f of one below .5
    "measure(x) of the sensor returned [nan] for x = [1.0": (lambda x, u: x, lambda x: jnp.sqrt(x - 1.2)),
    "transition(x, u) returned [nan] for x = [": (lambda x, u: jnp.sqrt(x - 0.5), lambda x: x),
}


@pytest.mark.parametrize("named", CURVED)
def test_a_function_without_a_number_is_named_and_never_silent(named):
    """Estimates stay numbers in a recording and a timeline; a stream raises; a simulation warns."""
    f, h = CURVED[named]
    plant, sensor = hg.Plant(f, 0.1, [1.0], 0.1), hg.Sensor(h, 0.04)
    filter = hg.extended_filter(plant, sensor)
    network = hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(), {"k": filter})})
    z = np.array([[1.0], [1.0], [0.3], [1.0], [1.0]])
    with pytest.warns(UserWarning, match="implausible") as said:
        record = hg.run(network, {"a": z})
    assert any(named in str(line.message) for line in said)
    assert np.isfinite(record.estimates["a"]["k"].mean).all()
    stream, raised = hg.Stream(filter), []
    for row in z:
        try:
            stream.push(row)
        except ValueError as error:
            raised.append(str(error))
    assert raised and named in raised[0]
    timeline = hg.Timeline(network, 9)
    assert "implausible" in [timeline.push("a", k, k, row) for k, row in enumerate(z)]
    assert np.isfinite(timeline.estimates()["a"]["k"].mean).all()
    with pytest.warns(UserWarning) as said:
        hg.simulate(network, 6, 0)
    assert "a/k: no valid covariance from step" in str(said[-1].message)
    with pytest.warns(UserWarning, match="the estimate is no finite number from row"):
        filter.run(z)


@pytest.mark.slow
def test_the_test_in_a_step_agrees_with_that_of_all_rows():
    """By elimination and by eigenvalues, on covariances of every rank and the same with one sign or entry changed."""
    rng = np.random.default_rng(0)
    for n in (1, 2, 3, 5):
        for rank in range(n + 1):
            root = rng.normal(size=(n, rank)) * 10.0 ** rng.integers(-6, 6, size=(n, 1))
            sound = root @ root.T
            eigenvalues, vectors = np.linalg.eigh(np.corrcoef(rng.normal(size=(n, 20))).reshape(n, n))
            negative = vectors @ np.diag([-0.1, *eigenvalues[1:]]) @ vectors.T
            skewed = sound + np.outer(np.eye(n)[0], np.eye(n)[-1]) * (sound[0, 0] + 1) * (n > 1)
            for matrix in (sound, negative, skewed, np.full((n, n), np.nan)):
                plant = hg.LinearPlant(np.eye(n), lambda u, m=matrix: jnp.asarray(m), np.zeros(n), 1.0, inputs=["s"])
                with jax.enable_x64(True):
                    spoilt = do_inputs_spoil(plant, ("s",), jnp.zeros(1), 0)
                assert bool(spoilt) == mask_invalid_covariances(matrix[None])[0]


STATE, START = np.zeros((3, 1)), ([0.0, 0.0], np.eye(2))
COMPLEX = {
    "transition": lambda: hg.Plant(lambda x, u: x + 1j, 0.1, *START),
    "process noise": lambda: hg.Plant(lambda x, u: x, lambda u: jnp.eye(2) * 1j, *START, inputs=["u"]),
    "matrix": lambda: hg.LinearPlant(lambda u: jnp.eye(2) * 1j, 0.1, *START, inputs=["u"]),
    "sensor": lambda: hg.cubature_filter(
        hg.LinearPlant(np.eye(2), 0.1, *START), hg.Sensor(lambda x: x[:1] + 1j, 0.1 * np.eye(1))
    ),
}


@pytest.mark.parametrize("what", COMPLEX)
def test_a_function_with_complex_numbers_is_refused(what):
    with pytest.raises(ValueError, match="complex numbers, where real ones are expected") as raised:
        COMPLEX[what]()
    assert "\n" not in str(raised.value)


@pytest.mark.parametrize("make", [hg.cubature_filter, hg.extended_filter, hg.unscented_filter])
def test_flags_and_whole_numbers_of_a_function_are_numbers(make):
    """As if the function had returned them as floats."""
    found = []
    for kind in (lambda x: x, lambda x: x.astype(float)):
        plant = hg.Plant(lambda x, u, kind=kind: kind(x > 0.5), 0.1, *START)
        sensor = hg.Sensor(lambda x, kind=kind: kind(jnp.round(x[:1]).astype(int)), 0.1 * np.eye(1))
        found.append(make(plant, sensor).run(STATE + 0.3))
    np.testing.assert_array_equal(found[0].means, found[1].means)
    np.testing.assert_array_equal(found[0].covariances, found[1].covariances)
    assert np.all(np.isfinite(found[0].means))
