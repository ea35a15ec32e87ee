"""Native code agrees with XLA, whatever the width, the cores and the neighbours."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from heliograph.engine.choice import engine_of
from straightline import machine_code
from straightline.compiled import CompiledFunction, SingleRunCode, compile
from straightline.graph_as_jax_function import make_jax_function
from straightline.program import lower_function

RANDOM = np.random.default_rng(4)
PLANT = hg.LinearPlant([[0.9, 0.1], [0.0, 0.8]], np.diag([0.1, 0.2]), [1.0, 0.0], np.eye(2))
SENSOR = hg.LinearSensor([[1.0, 0.5]], 0.3)
NINE = hg.LinearPlant(np.diag([0.9] * 9) + np.diag([0.1] * 8, 1), 0.1 * np.eye(9), np.zeros(9), np.eye(9))
FIRST = hg.LinearSensor(np.eye(1, 9), 0.3)
LEVEL, READ = hg.LinearPlant([[0.9]], 0.1, [1.0], 1.0), hg.LinearSensor([[1.0]], 0.3)
TURNING = hg.Plant(lambda x, u: 0.8 * x + 0.3 * jnp.sin(jnp.roll(x, 1)), 0.1 * np.eye(2), np.ones(2), np.eye(2))
BENT = hg.Sensor(lambda x: (x[0] + 0.2 * x[1] ** 2)[None], 0.1)
RELAYS = hg.amplify_and_forward([hg.hop(hg.Rayleigh(0.8), 0.02), hg.hop(1.0, noise=0.01, amplification=1.2)])
UNCERTAIN = hg.hop(hg.Discrete([0.5, 1.0], [0.4, 0.6], 0.1), 0.05)
CHAIN = hg.random_affine.MarkovChain([[0.9, 0.1], [0.3, 0.7]])
FADING = hg.markov_fading([0.3, 1.0], CHAIN, noise=0.1)
FILTERS = {
    "kalman": lambda: hg.kalman_filter(PLANT, SENSOR),
    "precise": lambda: hg.kalman_filter(PLANT, hg.LinearSensor([[1.0, 0.5], [0.3, 1.0]], np.diag([1e-12, 1.0]))),
    "linear": lambda: hg.linear_filter(PLANT, SENSOR, RELAYS),
    "extended": lambda: hg.extended_filter(TURNING, BENT, RELAYS),
    "cubature": lambda: hg.cubature_filter(TURNING, BENT, UNCERTAIN),
    "imm": lambda: hg.filters.imm_filter(PLANT, SENSOR, FADING),
    "gpb2": lambda: hg.filters.gpb2_filter(LEVEL, READ, FADING),
    "polynomial": lambda: hg.polynomial_filter(PLANT, SENSOR, RELAYS, 30, 1),
}
LARGE = {
    "kalman": lambda: hg.kalman_filter(NINE, FIRST),
    "linear with memory": lambda: hg.linear_filter(NINE, FIRST, FADING),
    "cubature": lambda: hg.cubature_filter(NINE, FIRST, UNCERTAIN),
    "imm": lambda: hg.filters.imm_filter(NINE, FIRST, FADING),
    "gpb1": lambda: hg.filters.gpb1_filter(NINE, FIRST, FADING),
}


def over_recording(item):
    """A function of one recording: all estimates, and the state after it."""

    def single(z):
        def body(state, row):
            state, estimate = item.step(state, row[0], np.zeros(0), row[1])
            return state, (estimate.mean, estimate.covariance)

        return jax.lax.scan(body, jax.tree.map(jnp.asarray, item.init()), (z, jnp.arange(len(z))))[1]

    return single


def measurements(item, runs, steps):
    z = RANDOM.normal(size=(runs, steps, item.received))
    return np.where(RANDOM.random(z.shape) < 0.1, np.nan, z)


@pytest.mark.slow
@pytest.mark.parametrize("name", FILTERS)
def test_every_filter_gives_what_xla_gives(name):
    """Of LLVM's code and of JAX's operation by operation, to 1e-12 of the claimed deviation; missing data among it."""
    item = FILTERS[name]()
    single, z = over_recording(item), measurements(item, 5, 30)
    program = lower_function(single, z[0])
    with jax.enable_x64(True):
        expected = [np.asarray(x) for x in jax.jit(jax.vmap(single))(z)]
        by_jax = jax.jit(jax.vmap(make_jax_function(program)))(z)
    deviation = np.sqrt(np.diagonal(expected[1], axis1=-2, axis2=-1))
    for mean, covariance in (CompiledFunction(program, [True])(z), map(np.asarray, by_jax)):
        assert np.max(np.abs(mean - expected[0]) / deviation) < 1e-12
        assert np.max(np.abs(covariance - expected[1]) / deviation[..., None] / deviation[..., None, :]) < 1e-12


@pytest.mark.slow
@pytest.mark.parametrize("name", LARGE)
def test_filters_of_more_states_than_xla_writes_out(name):
    item = LARGE[name]()
    single, z = over_recording(item), measurements(item, 5, 10)
    assert engine_of(single, z).startswith("native")
    with jax.enable_x64(True):
        expected = [np.asarray(x) for x in jax.jit(jax.vmap(single))(z)]
    mean, covariance = hg.simulation.over_runs(single, z)
    deviation = np.sqrt(np.diagonal(expected[1], axis1=-2, axis2=-1))
    assert np.max(np.abs(mean - expected[0]) / deviation) < 1e-12
    assert np.max(np.abs(covariance - expected[1]) / deviation[..., None] / deviation[..., None, :]) < 1e-12


@pytest.mark.parametrize("name", ["cubature", "imm"])
def test_bits_depend_on_no_width_and_no_neighbour(name):
    """Of one run alone, of 13 in blocks of 8, 4 and 16, by one core and by several."""
    item = FILTERS[name]()
    single, z = over_recording(item), measurements(item, 13, 20)
    program = lower_function(single, z[0])
    whole = CompiledFunction(program, [True], 8)(z, cores=3)
    for width in (4, 16):
        for a, b in zip(whole, CompiledFunction(lower_function(single, z[0]), [True], width)(z, cores=1), strict=True):
            np.testing.assert_array_equal(a, b)
    alone = SingleRunCode(lower_function(single, z[0]))
    for run in (0, 12):
        alone.inputs[0][...] = z[run]
        alone()
        for a, b in zip(whole, alone.outputs, strict=True):
            np.testing.assert_array_equal(a[run], b)


def test_a_state_stays_in_its_place_from_call_to_call():
    """A filter stepped through a recording by one call a row."""
    item = FILTERS["cubature"]()
    start, z = item.init(), measurements(item, 1, 20)[0]
    leaves, tree = jax.tree.flatten(start)

    def step(z, *leaves):
        state, estimate = item.step(jax.tree.unflatten(tree, leaves), z)
        return *jax.tree.leaves(state), estimate.mean

    alone = SingleRunCode(lower_function(step, z[0], *map(np.asarray, leaves)), {k: k + 1 for k in range(len(leaves))})
    for place, leaf in zip(alone.inputs[1:], leaves, strict=True):
        place[...] = leaf
    expected = compile(over_recording(item), z)(z[None])[0][0]
    for row, mean in zip(z, expected, strict=True):
        alone.inputs[0][...] = row
        alone()
        np.testing.assert_array_equal(alone.outputs[-1], mean)


def test_what_all_runs_share_is_computed_once_and_gives_the_same_bits():
    """A filter whose covariances depend on no data: computed beside the runs, or within them."""
    item = FILTERS["linear"]()

    def single(z, noise):
        sensor = hg.LinearSensor([[1.0, 0.5]], noise)
        return over_recording(hg.linear_filter(PLANT, sensor, hg.perfect()))(z)

    z = RANDOM.normal(size=(9, 40, item.received))
    noise = np.full((1, 1), 0.3)
    shared = compile(single, z[0], noise, shared=(1,))
    assert shared.once is not None
    for a, b in zip(shared(z, noise), compile(single, z[0], noise)(z, np.repeat(noise[None], 9, 0)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_loops_end_for_each_run_at_its_turn():
    def root(x):
        """Newton's method until nothing changes, and how many turns that took."""

        def closer(state):
            y, _, turns = state
            return 0.5 * (y + x / y), y, turns + 1

        y, _, turns = jax.lax.while_loop(
            lambda s: (jnp.abs(s[0] - s[1]) > 1e-15 * s[0]) & (s[2] < 60), closer, (x, 0 * x, jnp.asarray(0))
        )
        return y, turns

    x = 10.0 ** RANDOM.uniform(-8, 8, size=37)
    y, turns = compile(root, x[0])(x)
    with jax.enable_x64(True):
        expected = jax.jit(jax.vmap(root))(x)
        by_jax = jax.jit(jax.vmap(make_jax_function(lower_function(root, x[0]))))(x)
    np.testing.assert_allclose(y, np.sqrt(x), rtol=1e-15)
    np.testing.assert_array_equal(turns, expected[1])
    np.testing.assert_array_equal(by_jax[1], expected[1])


def test_arithmetic_on_whole_recordings_is_a_loop_over_their_rows():
    def function(x, y):
        both = jnp.concatenate([x[1:], x[:1]]) * jnp.sin(y)[:, None] - x[::-1]
        return (
            both,
            (2.0 * x).reshape(3, 90),
            jnp.sum(both, axis=0),
            x @ jnp.ones((3, 2)),
            jax.vmap(lambda r: jnp.outer(r, r))(x),
            both[7, 1],
        )

    x, y = RANDOM.normal(size=(6, 90, 3)), RANDOM.normal(size=(6, 90))
    result = compile(function, x[0], y[0])(x, y)
    with jax.enable_x64(True):
        expected = jax.jit(jax.vmap(function))(x, y)
    for a, b in zip(result, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-13, atol=1e-13)


def test_integers_are_sorted_with_what_comes_with_them():
    def function(k, x):
        return jnp.sort(k), *jax.lax.sort((k, x), dimension=0, num_keys=1), jnp.argsort(k, axis=1)

    k, x = RANDOM.integers(-3, 4, size=(11, 7, 4)), RANDOM.normal(size=(11, 7, 4))
    with jax.enable_x64(True):
        expected = jax.jit(jax.vmap(function))(k, x)
    for a, b in zip(compile(function, k[0], x[0])(k, x), expected, strict=True):
        np.testing.assert_array_equal(a, b)


def test_numbers_of_the_data_choose_rows_of_tables_and_recordings():
    table = RANDOM.normal(size=(80, 2))

    def function(x, k):
        computed = 2 * x[:40].reshape(20, 2)  # 40 numbers, which are not in memory
        return jnp.asarray(table)[k], x[k], jax.lax.dynamic_slice(x, (k,), (3,)), computed[k]

    x, k = RANDOM.normal(size=(11, 100)), RANDOM.integers(-120, 120, size=11)
    with jax.enable_x64(True):
        expected = jax.jit(jax.vmap(function))(x, k)
    for a, b in zip(compile(function, x[0], k[0])(x, k), expected, strict=True):
        np.testing.assert_array_equal(a, b)


@pytest.mark.parametrize(
    "function",
    [
        lambda x: (jnp.maximum(x, 0.1), jnp.sign(x), jnp.isfinite(x), x != x, jnp.round(x), jnp.floor(x)),
        lambda x: (x.astype(int), (x > 0).astype(float), jnp.fmod(x, 0.3), jnp.abs(x), jnp.sqrt(x), 1 / x),
        lambda x: (jnp.where(x > 0, jnp.log(x), jnp.exp(x)), jnp.arctan2(x, -1.0), jnp.tanh(x), jnp.log1p(x)),
    ],
)
def test_special_numbers_are_what_jax_makes_of_them(function):
    x = np.concatenate([RANDOM.normal(size=20), [0.0, -0.0, np.nan, np.inf, -np.inf, 1e300, 1e-300, 0.5, -2.5]])
    result = compile(function, x[0])(x)
    with jax.enable_x64(True):
        expected = jax.jit(jax.vmap(function))(x)
    for a, b in zip(result, expected, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-14)


@pytest.mark.slow
def test_random_draws_are_those_of_jax():
    def draw(number):
        key = jax.random.fold_in(jax.random.key(3), number)
        return jax.random.uniform(key), jax.random.normal(jax.random.split(key)[1], (2,))

    numbers = np.arange(20)
    uniform, normal = compile(draw, numbers[0])(numbers)
    with jax.enable_x64(True):
        expected = jax.jit(jax.vmap(draw))(numbers)
        by_jax = jax.jit(jax.vmap(make_jax_function(lower_function(draw, numbers[0]))))(numbers)
    np.testing.assert_array_equal(uniform, expected[0])
    np.testing.assert_allclose(normal, expected[1], rtol=1e-14)
    np.testing.assert_array_equal(by_jax[0], expected[0])


@pytest.mark.slow
def test_derivatives_of_the_graph_are_those_of_the_function():
    item = FILTERS["extended"]()
    single, z = over_recording(item), RANDOM.normal(size=(15, item.received))
    with jax.enable_x64(True):
        by_graph, by_jax = (
            jax.jit(jax.grad(lambda z, f=f: jnp.sum(f(z)[0] ** 2)))(z)
            for f in (make_jax_function(lower_function(single, z)), single)
        )
    np.testing.assert_allclose(by_graph, by_jax, rtol=1e-11, atol=1e-12)


def test_gradients_through_a_loop_run_on_native_code():
    """Which begin with memory that the loop fills; of x' = x a^2, whose last state is x a^(2 N)."""

    def last(a, x):
        return jax.lax.scan(lambda x, _: (x * a**2, None), x, length=300)[0]

    a, x = 1 + 1e-3 * RANDOM.random(5), RANDOM.normal(size=5)
    slopes = jax.grad(last, argnums=(0, 1))
    assert engine_of(slopes, a, x).startswith("native")
    by_a, by_x = hg.simulation.over_runs(slopes, a, x)
    np.testing.assert_allclose(by_a, 600 * x * a**599, rtol=1e-12)  # 600 products, each rounded
    np.testing.assert_allclose(by_x, a**600, rtol=1e-12)


def test_a_user_can_ask_for_the_engine_and_force_one(monkeypatch):
    def svd(x):
        return jnp.linalg.svd(x)[1]

    x = RANDOM.normal(size=(3, 2, 2))
    assert engine_of(lambda x: x @ x, x) == "native: 15 operations"  # one product of eight is two entries'
    assert engine_of(svd, x).startswith("xla: svd")
    np.testing.assert_allclose(hg.simulation.over_runs(svd, x), np.linalg.svd(x)[1])
    monkeypatch.setenv("HELIOGRAPH_ENGINE", "native")
    with pytest.raises(ValueError, match="native code: expected a program of operations that it takes, got svd"):
        hg.simulation.over_runs(svd, x)
    monkeypatch.setenv("HELIOGRAPH_ENGINE", "xla")
    assert engine_of(svd, x) == "xla: HELIOGRAPH_ENGINE is set to it"
    monkeypatch.setenv("HELIOGRAPH_ENGINE", "gpu")
    with pytest.raises(ValueError, match="HELIOGRAPH_ENGINE: expected native or xla, got gpu"):
        engine_of(svd, x)


@pytest.mark.parametrize("length", [2, 300])
def test_a_number_is_read_as_two_words(length):
    """The low word first, as a key of random numbers takes them; of long arrays in a loop."""

    def words(x):
        return jax.lax.bitcast_convert_type(x, jnp.uint32)

    x = RANDOM.normal(size=(3, length))
    assert engine_of(words, x).startswith("native")
    np.testing.assert_array_equal(hg.simulation.over_runs(words, x), x.view(np.uint32).reshape(3, length, 2))


def test_numbers_read_as_others_of_fewer_bits_are_computed_by_xla():
    def short(x):
        return jax.lax.bitcast_convert_type(x, jnp.int32)

    x = RANDOM.normal(size=(3, 2))
    assert engine_of(short, x).startswith("xla: bitcast from f64 to i32")
    np.testing.assert_array_equal(hg.simulation.over_runs(short, x), x.view(np.int32).reshape(3, 2, 2))


def test_numbers_may_be_multiplied_with_truth_values_and_integers():
    """Sums of some components, as a plant or a sensor may write them; a product converts what it takes."""

    def sums(x):
        return x @ (x[:, None] > jnp.arange(2)), (x > 0) @ x, x.astype(int) @ jnp.outer(x, x)

    x = RANDOM.normal(size=(5, 3))
    assert engine_of(sums, x).startswith("native")
    by_numpy = [(r @ (r[:, None] > np.arange(2)), (r > 0) @ r, r.astype(int) @ np.outer(r, r)) for r in x]
    for values, expected in zip(hg.simulation.over_runs(sums, x), zip(*by_numpy, strict=True), strict=True):
        np.testing.assert_allclose(values, expected, rtol=1e-14, atol=1e-15)  # fused or not: a rounding of 1


def test_exponents_may_be_integers():
    """Each number its own, known or of the data; also of what is negative, and one over a power."""

    def powers(x, k):
        return x[:, None] ** jnp.arange(-1, 4), x**k

    x, k = RANDOM.normal(size=(5, 3)), RANDOM.integers(-2, 4, size=(5, 3))
    assert engine_of(powers, x, k).startswith("native")
    table, single = hg.simulation.over_runs(powers, x, k)
    np.testing.assert_allclose(table, x[..., None] ** np.arange(-1.0, 4.0), rtol=1e-14)
    np.testing.assert_allclose(single, x ** k.astype(float), rtol=1e-14)


def test_the_largest_and_least_of_many_integers_and_truth_values():
    """A loop over a long array begins with what is neutral, which is no infinity there."""

    def extremes(x):
        whole = (100 * x).astype(int)
        return jnp.max(whole), jnp.min(whole), jnp.max(x > 9), jnp.min(x > -9)

    x = RANDOM.normal(size=(3, 300))
    assert engine_of(extremes, x).startswith("native")
    whole = (100 * x).astype(int)
    expected = whole.max(axis=1), whole.min(axis=1), [False] * 3, [True] * 3
    for values, by_numpy in zip(hg.simulation.over_runs(extremes, x), expected, strict=True):
        np.testing.assert_array_equal(values, by_numpy)


def test_numbers_are_found_in_a_table_as_jax_finds_them():
    """Which of several choices a uniform number means; NaN and zeros with a sign by their bits."""
    table = np.array([-np.inf, -2.0, -0.0, 0.0, 5e-300, 1.0, 1.0, np.inf, np.nan])

    def indices(x):
        return jnp.searchsorted(table, x), jnp.searchsorted(table, x, side="right")

    x = np.array([*table, -np.nan, -3.0, 0.5, 1e300])
    assert engine_of(indices, x).startswith("native")
    with jax.enable_x64(True):
        by_jax = jax.jit(jax.vmap(indices))(x)
    for values, expected in zip(hg.simulation.over_runs(indices, x), by_jax, strict=True):
        np.testing.assert_array_equal(values, expected)


def test_a_machine_without_native_code_says_so_once_and_computes_by_xla(monkeypatch):
    def unknown():
        raise RuntimeError("no target for this processor")

    x = RANDOM.normal(size=(3, 2, 2))
    monkeypatch.setattr(machine_code.llvm.Target, "from_default_triple", unknown)
    for cached in (machine_code.find_llvm_target, machine_code.find_processor_features):
        cached.cache_clear()
    with pytest.warns(RuntimeWarning, match="no native code: expected a processor that LLVM knows, got no target"):
        assert engine_of(lambda x: x @ x, x) == "xla: LLVM does not know this processor"
    np.testing.assert_allclose(hg.simulation.over_runs(lambda x: x @ x, x), x @ x)
