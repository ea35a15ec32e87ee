"""What is kept of an object: worked out once, closed, forgotten with the object, and never what is traced."""

import weakref
from functools import partial

import equinox as eqx
import jax
import numpy as np
import pytest

from heliograph.numerics import cache_by_object, share_by_object
from heliograph.random_affine.moments import symmetric_power

CALLS: list[float] = []


class Holder(eqx.Module):
    value: float | jax.Array | np.ndarray

    @cache_by_object
    def power(self, order: int) -> np.ndarray:
        """The value as often."""
        CALLS.append(order)
        return self.value * np.ones(order)


@cache_by_object
def refusing(item: object) -> None:
    """Says no."""
    raise ValueError("no")


def test_each_answer_is_worked_out_once_for_each_object_and_question() -> None:
    CALLS.clear()
    item, other = Holder(2.0), Holder(2.0)
    assert item.power(2) is item.power(2)
    assert item.power(3).shape == (3,) and item.power(order=3).shape == (3,)
    assert other.power(2) is not item.power(2)
    assert CALLS == [2, 3, 3, 2]


def test_what_others_have_too_cannot_be_written_to() -> None:
    with pytest.raises(ValueError, match="read-only"):
        Holder(1.0).power(2)[0] = 5.0


def test_what_is_traced_is_not_cached() -> None:
    item = Holder(1.0)
    result = jax.jit(lambda x: Holder(x).power(2) + item.power(2))(3.0)
    assert np.asarray(result).tolist() == [4.0, 4.0]
    assert np.asarray(jax.grad(lambda x: Holder(x).power(2).sum())(1.0)) == 2.0
    assert item.power(2).tolist() == [1.0, 1.0]


def test_nothing_keeps_the_object_alive(collect_garbage) -> None:
    item = Holder(1.0)
    item.power(2)
    gone = weakref.ref(item)
    del item
    collect_garbage()
    assert gone() is None


def test_what_cannot_be_cached_is_refused_in_words() -> None:
    for item in (3, "text", None, Holder(1.0)):
        with pytest.raises(ValueError, match="no"):
            refusing(item)


def test_it_is_called_as_the_function_is() -> None:
    item = Holder(2.0)
    assert Holder.power(self=item, order=2) is item.power(order=2)
    with pytest.raises(TypeError, match="missing 1 required positional argument: 'item'"):
        refusing()
    with pytest.raises(ValueError, match="no"):
        refusing(item=item)


@pytest.mark.parametrize("order", [(False, True), (True, False)])
def test_what_one_precision_traced_is_not_what_another_sees(order):
    """Tables of a computation in float64 after one in single precision, and the reverse, while the first is there."""
    gain, programs = np.random.default_rng(0).uniform(0.5, 1.0, (3, 3)), []
    for double in order:
        with jax.enable_x64(double):
            programs.append(jax.jit(partial(symmetric_power, degree=3)))
            result = np.asarray(programs[-1](gain))
        assert result.dtype == (np.float64 if double else np.float32)
        np.testing.assert_allclose(result, symmetric_power(gain, 3), rtol=1e-14 if double else 1e-5)


class Compiled:
    def __init__(self, source: Holder):
        self.source = source


def test_what_is_made_of_an_object_is_shared_while_somebody_holds_it(collect_garbage):
    make, source = share_by_object(Compiled), Holder(1.0)
    made = make(source)
    assert make(source) is made and make(Holder(1.0)) is not made
    gone = weakref.ref(made)
    del made
    collect_garbage()
    assert gone() is None and make(source).source is source
