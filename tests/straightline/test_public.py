"""The public names, as a stranger uses them."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import straightline as sl

RANDOM = np.random.default_rng(8)


def test_a_function_of_one_run_is_computed_for_many():
    """Trees of arguments; one that all runs share has no axis of runs."""
    code = sl.compile(lambda x, more: {"sum": x @ more["a"]}, np.zeros(3), {"a": np.zeros(3)}, shared=[1])
    x, a = RANDOM.normal(size=(21, 3)), RANDOM.normal(size=3)
    np.testing.assert_allclose(code(x, {"a": a})["sum"], x @ a, rtol=1e-14)
    assert code.operations == 6 + 5  # numbers that are read, products and sums


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((np.zeros((5, 4)), np.zeros(3)), r"array 0 of the arguments: expected shape \(run, 3\), got \(5, 4\)"),
        ((np.zeros((5, 3)), np.zeros((5, 3))), r"array 1 of the arguments: expected shape \(3,\), got \(5, 3\)"),
        ((np.zeros((5, 3)),), "arguments: expected 2 arrays, got 1"),
        ((np.zeros((5, 3)), np.zeros(3, complex)), "arguments: expected numbers of type float64, got complex128"),
    ],
)
def test_arguments_unlike_the_examples_are_refused(arguments, message):
    """Code reads memory as the examples say: other shapes would be read beyond their end."""
    code = sl.compile(lambda x, a: x @ a, np.zeros(3), np.zeros(3), shared=[1])
    with pytest.raises(ValueError, match=message):
        code(*arguments)


def test_what_is_not_taken_is_refused_with_its_line():
    assert sl.explain(jnp.linalg.svd, np.eye(3)).startswith("refused: svd")
    with pytest.raises(sl.Unsupported, match=r"svd at .*test_public.py:\d+"):
        sl.compile(lambda x: jnp.linalg.svd(x)[1], np.eye(3))
    with pytest.raises(sl.Unsupported, match="a program of more than 3 operations"):
        sl.compile(lambda x: x @ x, np.eye(3), most=3)


def test_what_no_result_depends_on_is_left_out_but_printing_is_not():
    """An operation that is not taken stands in nobody's way where nothing uses it; one with an effect has a use."""

    def sum_beside_svd(x):
        jnp.linalg.svd(x)
        return x.sum()

    def print_and_double(x):
        jax.debug.print("{}", x[0])
        return 2 * x

    alone = sl.compile(lambda x: x.sum(), np.eye(3))
    assert sl.compile(sum_beside_svd, np.eye(3)).operations == alone.operations
    assert sl.compile(sum_beside_svd, np.eye(3))(np.eye(3)[None]) == [3.0]
    with pytest.raises(sl.Unsupported, match="debug"):
        sl.compile(print_and_double, np.ones(2))


def test_one_run_is_computed_in_place():
    """x+ = x / 2 + u, y = x: the state is written over itself, also where the result is counted from the last."""
    for number in (0, -2):
        code = sl.compile_one(lambda x, u: (x / 2 + u, x), np.zeros(2), np.zeros(2), in_place={number: 0})
        (x, u), (_, y) = code.inputs, code.outputs
        u[...] = 1.0, 2.0
        code()
        code()
        assert x.tolist() == [1.5, 3.0] and y.tolist() == [1.0, 2.0]
        other = code.with_new_memory([])
        other()
        assert other.inputs[0].tolist() == [0.0, 0.0] and x.tolist() == [1.5, 3.0]


def drawn(key, scale, number):
    z = scale * jax.random.normal(jax.random.fold_in(key, number))
    return {"z": z, "zz": z * z, "count": jnp.ones(())}, z


def test_runs_are_summed_by_batch_with_the_draws_of_jax():
    key, runs = jax.random.key(3), 1003
    code = sl.accumulate(drawn, key, 1.0, batches=10)
    sums, each = code(key, 2.0, runs=runs, first=7)
    numbers = np.arange(7, 7 + runs)
    with jax.enable_x64(True):
        expected = np.asarray(jax.vmap(lambda n: drawn(key, 2.0, n)[1])(numbers.astype(np.uint32)))
    # Arithmetic of JAX by XLA, of which logarithm and square root round differently.
    np.testing.assert_allclose(each, expected, rtol=1e-13)
    by_batch = [each[numbers % 10 == b] for b in range(10)]
    np.testing.assert_allclose(sums["zz"], [np.sum(z**2) for z in by_batch], rtol=1e-13)
    assert sums["count"].tolist() == [len(z) for z in by_batch]


def test_what_is_known_of_an_example_is_a_constant():
    """A zero that is known costs no product; the call's own entry there is not read."""

    def product(a, number):
        return a @ a, number

    whole = sl.accumulate(product, np.eye(2))
    known = sl.accumulate(product, np.diag([2.0, 3.0]), known={0: ~np.eye(2, dtype=bool)})
    assert known.operations < whole.operations
    sums, _ = known(np.full((2, 2), 5.0), runs=4)
    assert sums[..., 0].tolist() == [[100.0, 0.0], [0.0, 100.0]]
    with pytest.raises(ValueError, match="function of a run: expected a pair of what is summed and what is collected"):
        sl.accumulate(lambda number: number * 1.0)


def test_what_is_present_is_not_asked_for():
    def filled(x):
        return jnp.where(jnp.isnan(x), 0.0, 2 * x)

    assert sl.explain(filled, 1.0) != sl.explain(lambda x: filled(sl.present(x)), 1.0) == "2 operations"
    assert jax.grad(lambda x: filled(sl.present(x)))(1.0) == 2.0


def test_few_names_are_public():
    assert len(sl.__all__) <= 9


def pid(state, error, gains):
    """A controller with a bounded integral: u = P e + I int e + D e', within +-10."""
    integral = jnp.clip(state["integral"] + 0.01 * error, -1.0, 1.0)
    u = gains @ jnp.stack([error, integral, (error - state["last"]) / 0.01])
    return {"integral": integral, "last": error}, jnp.clip(u, -10.0, 10.0)


def test_c_names_what_it_reads_and_writes():
    code = sl.to_c(pid, {"integral": 0.0, "last": 0.0}, 0.0, np.zeros(3), name="pid")
    assert "const double gains[3]" in code.header and '#include "pid.h"' in code.source
    assert [x.name for x in code.arguments] == ["state_integral", "state_last", "error", "gains"]
    assert [x.name for x in code.results] == ["result_0_integral", "result_0_last", "result_1"]
    assert code.operations["div"] == 1 and code.source.count("/") >= 1


def test_c_says_what_depends_on_what():
    code = sl.to_c(
        lambda p, f, unused: (f @ p @ f.T, f @ p @ f.T, f[0]), np.eye(2), np.eye(2), 0.0, name="move",
        names=(["p", "f", "double"], ["after", "again", "row"]), symmetric=[0],
    )  # fmt: skip
    assert [x.symmetric for x in code.results] == [True, True, False]
    assert [x.same for x in code.results] == [0, 0, 2]
    assert [x.used for x in code.arguments] == [True, True, False] and code.arguments[2].name == "double_"
    assert "p[2]" not in code.source  # the lower triangle


def test_zero_times_a_finite_number_is_zero_in_c():
    for finite, count in ((), 1), ([0], 0):
        assert sl.to_c(lambda x: 0.0 * x, np.zeros(1), name="zero", finite=finite).operations.get("mul", 0) == count


@pytest.mark.parametrize(
    ("function", "name", "error", "message"),
    [
        (lambda x: x, "while", ValueError, "name: expected one that C takes for a function, got 'while'"),
        (lambda x: jnp.linalg.svd(x[None])[1], "f", sl.Unsupported, r"svd at .*test_public.py:\d+"),
        (lambda x: x + jax.random.normal(jax.random.key(0)), "f", sl.Unsupported, r"random_\w+ at .*public.py:\d+"),
        (lambda x: 1e39 * x, "f", ValueError, r"single precision: expected numbers up to 3.4e38, got 1e\+39"),
    ],
)  # fmt: skip
def test_what_c_does_not_have_is_refused(function, name, error, message):
    with pytest.raises(error, match=message):
        sl.to_c(function, np.zeros(2), name=name, single=True)


def in_closed_form(a):
    """Singular values of ((a, b), (c, d)): |hypot(a + d, b - c) +- hypot(a - d, b + c)| / 2."""
    half = jnp.hypot(a[0, 0] + a[1, 1], a[0, 1] - a[1, 0]) / 2, jnp.hypot(a[0, 0] - a[1, 1], a[0, 1] + a[1, 0]) / 2
    return jnp.stack([half[0] + half[1], jnp.abs(half[0] - half[1])])


@sl.operation(in_closed_form)
def singular_values(a):
    """Singular values by the library."""
    return jnp.linalg.svd(a)[1]


def test_an_operation_of_one_s_own_is_computed_by_its_native_function():
    """Which C takes too; what it is decorated on is refused."""
    a = RANDOM.normal(size=(9, 2, 2))
    np.testing.assert_allclose(sl.compile(singular_values, a[0])(a), np.linalg.svd(a)[1], rtol=1e-13)
    assert sl.explain(lambda a: jnp.linalg.svd(a)[1], a[0]).startswith("refused: svd")
    assert "sqrt" in sl.to_c(singular_values, a[0], name="values").source


def test_to_jax_an_operation_is_the_plain_function():
    """By XLA, under vmap, and with derivatives forward and back: a singular value moves by u' dA v."""
    a = RANDOM.normal(size=(9, 2, 2))
    with jax.enable_x64(True):
        alone, mapped = singular_values(a[0]), jax.jit(jax.vmap(singular_values))(a)
        slopes = [jac(singular_values)(jnp.asarray(a[0])) for jac in (jax.jacfwd, jax.jacrev)]
    np.testing.assert_allclose(alone, np.linalg.svd(a[0])[1], rtol=1e-13)
    np.testing.assert_allclose(mapped, np.linalg.svd(a)[1], rtol=1e-13)
    u, _, v = np.linalg.svd(a[0])
    for slope in slopes:
        np.testing.assert_allclose(slope, np.einsum("ik,kj->kij", u, v), rtol=1e-12)


@sl.operation(lambda x: jnp.sum(jnp.stack([x**k for k in range(2, 400)])))
def summed_powers(x):
    """sum_i sum_k x_i^k by Horner's rule, in a loop over k."""
    return jnp.sum(jax.lax.fori_loop(0, 398, lambda _, s: (s + 1) * x, jnp.zeros_like(x)) * x)


@pytest.mark.parametrize("count", [2, 300])
def test_a_native_function_of_too_many_operations_is_the_plain_one(count):
    """Of a number 800 operations are written out, of 300 numbers a loop over the powers with 5 of each."""
    x = RANDOM.uniform(-0.9, 0.9, size=(4, count))
    code = sl.compile(summed_powers, x[0])
    assert (code.operations > 100 * count) == (count == 2)
    np.testing.assert_allclose(code(x), sum(x**k for k in range(2, 400)).sum(axis=1), rtol=1e-11)


@sl.operation(lambda a, x: {"image": a @ x, "size": jnp.sum(x)})
def image(a, x):
    return {"image": jnp.einsum("ij,j->i", a, x), "size": x.sum()}


@pytest.mark.parametrize("count", [3, 200])
def test_vmap_within_a_run_maps_the_native_function(count):
    """A few are written out, many are a loop; what is shared stays whole, and the last axis may be the mapped one."""
    a, x = RANDOM.normal(size=(5, 2, 2)), RANDOM.normal(size=(5, 2, count))
    code = sl.compile(lambda a, x: jax.vmap(lambda y: image(a, y)["image"], 1, 1)(x), a[0], x[0])
    np.testing.assert_allclose(code(a, x), a @ x, rtol=1e-13)
    twice = sl.compile(lambda a, x: jax.vmap(jax.vmap(image, (0, None)), (None, 1))(a, x), np.stack([a[0]] * 3), x[0])
    result = twice(np.stack([a] * 3, axis=1), x)
    np.testing.assert_allclose(result["image"], np.stack([np.swapaxes(a @ x, 1, 2)] * 3, axis=2), rtol=1e-13)
    np.testing.assert_allclose(result["size"], np.stack([x.sum(axis=1)] * 3, axis=2), atol=1e-13)
