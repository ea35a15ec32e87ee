"""The checks of shapes: each combination of kinds is checked, and a wrong one refused after right ones too."""

import jax
import jax.numpy as jnp
import jaxtyping
import numpy as np
import pytest
from jaxtyping import Float

from tests.shapes import checked, once_a_kind, where_shaped

Array = jax.Array | np.ndarray
Pair = tuple[Float[Array, "n n"], Float[Array, " n"] | None]


def moved(matrix: Float[Array, "n n"], x: Float[Array, " n"] | None = None, cut: int = 0) -> Pair:
    return matrix, None if x is None else x[cut:]


def longer(n: int) -> Float[np.ndarray, "{n}"]:
    return np.zeros(n + n // 3)


@pytest.fixture
def function():
    return where_shaped(moved, typechecker=checked)


def test_the_same_kinds_are_checked_once(function, monkeypatch):
    counted = []
    original = jaxtyping.AbstractArray.__class__.__instancecheck__
    monkeypatch.setattr(
        jaxtyping.AbstractArray.__class__, "__instancecheck__", lambda *a: counted.append(1) or original(*a)
    )
    for _ in range(3):
        function(np.eye(2), np.ones(2))
    before = len(counted)
    assert before and function(np.eye(2), np.ones(2))[1].shape == (2,) and len(counted) == before
    function(np.eye(3), x=np.ones(3))
    assert len(counted) > before


@pytest.mark.parametrize("wrong", [
    lambda f: f(np.eye(2), np.ones(3)), lambda f: f(np.ones((2, 3))), lambda f: f(np.eye(2), x=np.ones(3)),
    lambda f: f(np.eye(2, dtype=int), np.ones(2)), lambda f: f([[1.0]]), lambda f: f(np.eye(2), np.ones(2), cut=1),
    lambda f: f(jnp.eye(2), np.ones(3)), lambda f: jax.jit(f)(np.eye(2), np.ones(3)),
])  # fmt: skip
def test_what_is_wrong_is_refused_after_what_is_right(function, wrong):
    function(np.eye(2), np.ones(2))
    function(np.eye(2), x=np.ones(2))
    function(np.eye(2), np.ones(2), cut=0)
    function(np.eye(2))
    jax.jit(function)(np.eye(2), np.ones(2))
    with pytest.raises(jaxtyping.TypeCheckError):
        wrong(function)


def test_shapes_that_arguments_say_are_checked_at_each_call():
    of_length = where_shaped(longer, typechecker=checked)
    assert len(of_length(2)) == 2
    with pytest.raises(jaxtyping.TypeCheckError):
        of_length(3)


def test_a_function_without_shapes_and_a_class_stay_as_they_were():
    def plain(x: int) -> int:
        return x

    assert where_shaped(plain, typechecker=checked) is plain
    assert once_a_kind(moved, {"matrix": moved.__annotations__["matrix"]}, checked).__wrapped__ is moved


def joined(parts: tuple[Float[np.ndarray, "_ n"], ...], other: bool = False) -> tuple[Float[np.ndarray, " n"], ...]:
    return (*(part.sum(axis=0) for part in parts), *([parts[0]] if other else []))


@pytest.mark.parametrize("wrong", [
    lambda f: f((np.ones((1, 2)), np.ones((2, 2)), np.ones((2, 3)))), lambda f: f((*[np.ones((1, 2))] * 9, np.ones(2))),
    lambda f: f((*[np.ones((1, 2))] * 9, [1.0])), lambda f: f((np.ones((1, 2)), np.ones((2, 2))), other=True),
])  # fmt: skip
def test_each_entry_of_a_tuple_of_any_length_is_checked(wrong):
    of_parts = where_shaped(joined, typechecker=checked)
    assert len(of_parts((np.ones((1, 2)), np.ones((2, 2))))) == 2 and of_parts(()) == ()
    assert len(of_parts((np.ones((1, 2)), np.ones((2, 2)), np.ones((0, 2))))) == 3
    with pytest.raises(jaxtyping.TypeCheckError):
        wrong(of_parts)
