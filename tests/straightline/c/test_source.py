"""Statements in C of a lowered function, compiled and compared with the function itself."""

import ctypes
import subprocess

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from straightline.c_source import CSource, write_literal
from straightline.lowering import list_nodes
from straightline.nodes import Unsupported
from straightline.program import lower_function
from straightline.strided_arrays import StridedArray
from tests.export.device import needs_compiler
from tests.straightline.conformance.c import FLAGS

X = np.array([0.3, -1.7, 2.5, 0.9])


def written(function, x, real="double"):
    """The statements, tables and results of a function of one array."""
    program = lower_function(function, x)
    arrays = [x.nodes(program.graph) if isinstance(x, StridedArray) else x for x in program.outputs]
    results = [node for array in arrays for node in list_nodes(array)]
    source = CSource(results, {program.inputs[0]: "x[{}]".format}, real, "made")
    body = source.write_statements(program.graph.top)
    stores = [f"    out[{i}] = {source.name_node(node)};" for i, node in enumerate(results)]
    return [*source.declarations(), *body, *stores], source.table_definitions(), len(results)


def compiled(function, x, folder, real="double"):
    """The results as the compiled statements have them."""
    body, tables, count = written(function, x, real)
    head = f"void made(const {real} *x, {real} *out)"
    lines = ["#include <math.h>", "#include <stdint.h>", *tables, f"{head};", head, "{", *body, "}", ""]
    (folder / "made.c").write_text("\n".join(lines))
    command = ["cc", *FLAGS, "-shared", "-fPIC", "made.c", "-o", "made.so", "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    number = np.float64 if real == "double" else np.float32
    out = np.zeros(count, number)
    data = np.ascontiguousarray(x, dtype=number)
    ctypes.CDLL(str(folder / "made.so")).made(*(ctypes.c_void_p(a.ctypes.data) for a in (data, out)))
    return out


def expected(function, x):
    """The results as JAX has them."""
    with jax.enable_x64(True):
        return np.concatenate([np.ravel(np.asarray(leaf, float)) for leaf in jax.tree.leaves(function(jnp.asarray(x)))])


def arithmetic(x):
    return x + 2, x - x[::-1], x * x, x / 3, -x, jnp.abs(x), x**3, jnp.sqrt(jnp.abs(x)), jnp.maximum(x, 0.1), x.min()


def functions(x):
    y = jnp.abs(x) + 0.1
    return (
        jnp.exp(x), jnp.log(y), jnp.log1p(y), jnp.expm1(x), jnp.sin(x), jnp.cos(x), jnp.tan(x), jnp.tanh(x),
        jnp.arctan2(x, x[::-1]), y**x, jnp.floor(x), jnp.ceil(x), jnp.round(x), jnp.sign(x), x % 0.7,
        jax.scipy.special.erf(x), jnp.arcsin(x / 3), jnp.cbrt(x), jnp.sinh(x),
    )  # fmt: skip


def whole_numbers(x):
    k = jnp.floor(x * 3).astype(jnp.int64)
    return k + 1, k // 2, k % 3, k * k, jnp.abs(k), jnp.sign(k), k > 0, (k > 0) & (k < 5), ~(k > 2), k.astype(float) / 2


def choices(x):
    """What is missing stays so through comparisons, maxima and choices."""
    nothing = jnp.array([jnp.nan, jnp.inf, -jnp.inf, 1.0])
    both = x + nothing
    return jnp.where(jnp.isnan(both), 7.0, both), jnp.isfinite(both), jnp.maximum(both, x), jnp.minimum(x, both), both


def guarded(x):
    """A dear branch is one block of code, entered where its condition holds; its results are zero elsewhere."""

    def dear(v):
        for _ in range(40):
            v = jnp.sin(v) + 0.5 * jnp.roll(v, 1)
        return v

    return tuple(jax.lax.cond(x[0] > bound, dear, lambda v: v - 1, x) for bound in (0.0, 1.0))


def repeated(x):
    """A long loop whose numbers change places, and what it stacks."""

    def turn(carry, k):
        a, b = carry
        return (b, 0.9 * a + jnp.sin(b) / (1 + k)), a[0]

    carry, stacked = jax.lax.scan(turn, (x, x[::-1]), jnp.arange(300.0))
    return carry, stacked[::60]


def until(x):
    """Newton's root of x^2 = a, as many turns as it takes."""

    def far(y):
        return jnp.any(jnp.abs(y * y - x * x) > 1e-12)

    return jax.lax.while_loop(far, lambda y: (y + x * x / y) / 2, jnp.ones_like(x))


def looked_up(x):
    """An entry of a long table by a number that is computed."""
    table = jnp.asarray(np.sin(np.arange(200.0)))
    return jax.lax.dynamic_index_in_dim(table, jnp.floor(jnp.abs(x[2]) * 40).astype(int), keepdims=False), table[3]


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize(
    "function", [arithmetic, functions, whole_numbers, choices, guarded, repeated, until, looked_up]
)
def test_it_computes_what_the_function_does(function, tmp_path):
    """To a few units of rounding of libm's functions, some 300 times over in a loop."""
    result, right = compiled(function, X, tmp_path), expected(function, X)
    np.testing.assert_allclose(result, right, rtol=1e-13, atol=1e-14)


@needs_compiler
@pytest.mark.parametrize("function", [arithmetic, functions, guarded, looked_up])
def test_in_single_precision(function, tmp_path):
    """To that many units of rounding of 6e-8."""
    result, right = compiled(function, X, tmp_path, "float"), expected(function, X)
    np.testing.assert_allclose(result, right, rtol=2e-5, atol=1e-6)
    body, tables, _ = written(function, X, "float")
    assert "double" not in "".join(body + tables), "a device without double precision would emulate it"


def at_the_ends_of_doubles(x):
    """A reciprocal of what has one, a bound far below float, and the largest number for an infinite one."""
    least = jnp.finfo(float).tiny
    one = jnp.where(x > least, 1 / jnp.where(x > least, x, 1.0), 0.0)
    return one, 1 / jnp.sqrt(jnp.maximum(x, 1e-60)), jnp.nan_to_num(x + jnp.inf), jnp.where(x < 1e300, x, 0.0)


@needs_compiler
def test_in_single_precision_the_ends_of_doubles_are_those_of_floats(tmp_path):
    """Before, both small bounds were 0, so that a subnormal number had an infinite reciprocal; the others no code."""
    x, limits = np.array([3e-41, 0.25]), np.finfo(np.float32)
    one, bounded, largest, small = compiled(at_the_ends_of_doubles, x, tmp_path, "float").reshape(4, 2)
    assert np.array_equal(one, [0, 4]) and np.array_equal(small, x.astype(np.float32))
    np.testing.assert_allclose(bounded, [float(limits.tiny) ** -0.5, 2], rtol=1e-6)
    assert np.all(largest == limits.max)


def test_control_stays_control():
    """A branch that is not taken is not computed, and a loop is not written out."""
    assert sum(line.strip().startswith("if (") for line in written(guarded, X)[0]) == 2
    assert sum("sin(" in line for line in written(repeated, X)[0]) == len(X)
    assert any("break;" in line for line in written(until, X)[0])


def test_the_text_follows_from_the_function_alone():
    assert written(guarded, X) == written(guarded, X)


@pytest.mark.parametrize("value", [0.1, -1e-300, 1 / 3, 5e-324, 1.7976931348623157e308, -0.0])
def test_a_literal_has_every_digit(value):
    text = write_literal(value, "f64", "double").strip("()")
    assert float(text) == value and np.signbit(float(text)) == np.signbit(value)


def test_a_literal_in_single_precision_is_the_nearest():
    assert np.float32(write_literal(1 / 3, "f64", "float").rstrip("f")) == np.float32(1 / 3)
    assert (
        write_literal(float("nan"), "f64", "float") == "NAN" and write_literal(-np.inf, "f64", "float") == "(-INFINITY)"
    )
    with pytest.raises(ValueError, match=r"single precision: expected numbers up to 3.4e38, got 1e\+39"):
        write_literal(1e39, "f64", "float")


def test_what_c_has_not_is_named():
    with pytest.raises(Unsupported, match="erf_inv"):
        written(lambda x: jax.scipy.special.erfinv(x / 9), X)
