"""Texts of traced programs: equal for equal programs, and different where anything is that a result depends on."""

import subprocess
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from heliograph.numerics import write_program_text
from straightline import operation

ROOT = Path(__file__).parents[3]


def text(table, power: int = 2, dtype=np.float64, below: float = 1.0) -> str:
    """Text of a program with an inner one, whose constant is `table`, and with branches and a derivative rule."""
    table = jnp.asarray(table)

    @jax.jit
    def inner(x):
        return jnp.where(x < below, x @ table, x**power)

    def program(x):
        key = jax.random.key(3)
        y = jax.lax.cond(x[0] > 0, inner, lambda x: jax.nn.relu(x) + jax.random.normal(key, x.shape), inner(x))
        return y.astype(dtype), jnp.cumsum(y)

    return write_program_text(jax.jit(program).trace(np.zeros(3)).jaxpr)


def test_the_same_program_has_the_same_text_whatever_was_traced_before():
    """Here, again, and in a process that has traced nothing."""
    with jax.enable_x64(True):
        first = text(np.eye(3))
        assert first == text(np.eye(3)) and "0x" not in first
    program = "import jax, numpy as np; from tests.numerics.trees.test_program_text import text; " + (
        "jax.config.update('jax_enable_x64', True); print(text(np.eye(3)), end='')"
    )
    fresh = subprocess.run([sys.executable, "-c", program], cwd=ROOT, capture_output=True, text=True, check=True)
    assert fresh.stdout == first


@pytest.mark.parametrize(
    "change",
    [{"table": 2 * np.eye(3)}, {"power": 3}, {"dtype": np.float32}, {"below": 1.5}],
    ids=lambda c: next(iter(c)),
)
def test_another_constant_or_parameter_is_another_text(change):
    with jax.enable_x64(True):
        assert text(np.eye(3)) != text(**{"table": np.eye(3), **change})


@operation(lambda x: x + x)
def doubled(x):
    return 2 * x


@operation(lambda x: x**2)
def squared(x):
    return x * x


def test_operations_of_the_same_shapes_differ_by_their_names():
    """What they compute is not in the text: it is the library's, whose version is compared beside it."""

    def text_with(one):
        return write_program_text(jax.make_jaxpr(jax.vmap(one))(np.zeros((3, 2))))

    assert text_with(doubled) == text_with(doubled) != text_with(squared)
