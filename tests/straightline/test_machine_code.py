"""Code in haste, and with care once its executions have cost as much: the same bits."""

import gc
import signal
import warnings
import weakref
from concurrent.futures import ThreadPoolExecutor
from threading import Event

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from straightline import compiled
from straightline.compiled import SingleRunCode, compile
from straightline.machine_code import get_careful_thread
from straightline.nodes import Node
from straightline.program import lower_function
from straightline.size_limits import OFTEN

STEPS = 500
STARTS = np.random.default_rng(7).normal(size=(16, 2))


def rotated(x):
    """A loop with products, a division, a root and functions."""

    def step(x, k):
        a, b = x[0] * 0.9 + x[1] * x[0] / (1.0 + x[1] ** 2), jnp.sqrt(1.0 + jnp.sin(x[0]) ** 2) - jnp.exp(-(x[1] ** 2))
        return jnp.stack([a, b]), a * b

    return jax.lax.scan(step, x, jnp.arange(STEPS))


@pytest.fixture
def optimized():
    """Optimisations, which other tests do without."""
    before = jax.config.values["jax_disable_most_optimizations"]
    jax.config.update("jax_disable_most_optimizations", False)
    yield
    jax.config.update("jax_disable_most_optimizations", before)


@pytest.fixture
def code(optimized):
    return compile(rotated, STARTS[0])


def level(code):
    """The level at which the blocks' code is generated, without another execution."""
    return code.blocks.choose_machine(0).level


def test_code_is_generated_with_care_when_its_executions_have_cost_as_much(code):
    """Two blocks of 500 steps a call; the numbers are the same bits before and after."""
    source = code.code.blocks
    count = -(-OFTEN // (2 * source.work / source.operations))
    calls = [code(STARTS) for _ in range(int(count) - 1)]
    assert level(code) == 0
    calls.append(code(STARTS))
    get_careful_thread().submit(int).result()  # after what was asked for before
    assert level(code) == 1
    calls.append(code(STARTS))
    for a, b in zip(*map(jax.tree.leaves, (calls[0], calls[-1])), strict=True):
        np.testing.assert_array_equal(a, b)


def test_calls_go_on_in_haste_while_care_is_taken(code):
    released, source = Event(), code.code.blocks
    get_careful_thread().submit(released.wait, 60)
    code(STARTS)
    enough = OFTEN * source.operations / source.work  # blocks
    hasty = code.blocks.choose_machine(enough / 2)
    assert code.blocks.choose_machine(enough / 2) is hasty and hasty.level == 0
    released.set()
    get_careful_thread().submit(int).result()
    assert level(code) == 1


def test_code_in_haste_goes_on_where_care_fails_and_it_is_said_once(code, monkeypatch):
    before = code(STARTS)
    hasty = code.blocks.choose_machine(0)
    monkeypatch.setattr("straightline.machine_code.MachineCode", lambda *arguments: [].pop())
    with pytest.warns(RuntimeWarning, match="native code: generated with care it failed .*pop from empty list.*haste"):
        assert code.blocks.choose_machine(OFTEN) is hasty
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        again = code(STARTS)
    for a, b in zip(*map(jax.tree.leaves, (before, again)), strict=True):
        np.testing.assert_array_equal(a, b)


def test_a_call_that_executes_its_code_often_waits_for_care(code):
    code(np.tile(STARTS, (3 * OFTEN // (2 * STEPS), 1)))
    assert level(code) == 1


def test_prepared_code_is_not_generated_by_the_first_call(code):
    code.generate_code()
    prepared = code.blocks.choose_machine(0)
    code(STARTS)
    assert code.blocks.choose_machine(0) is prepared


def test_no_code_is_generated_with_care_without_optimizations(code):
    jax.config.update("jax_disable_most_optimizations", True)
    assert code.blocks.choose_machine(2 * OFTEN).level == 0


def test_a_long_step_in_live_use_is_generated_in_haste(monkeypatch):
    careful = SingleRunCode(lower_function(rotated, STARTS[0]))
    monkeypatch.setattr(compiled, "ALONE", careful.code.operations - 1)
    hasty = SingleRunCode(lower_function(rotated, STARTS[0]))
    assert (careful.machine.level, hasty.machine.level) == (1, 0)
    for step in (careful, hasty):
        step.inputs[0][...] = STARTS[0]
        step()
    for a, b in zip(careful.outputs, hasty.outputs, strict=True):
        np.testing.assert_array_equal(a, b)


def test_code_lets_go_of_the_program_that_it_was_made_of(collect_garbage):
    """Which takes more memory than the code; only its text stays, to be generated again with care."""

    def nodes():
        collect_garbage()
        return sum(isinstance(x, Node) for x in gc.get_objects())

    before = nodes()
    code = compile(rotated, STARTS[0])
    code(STARTS)
    assert nodes() == before
    assert "define void @run" in code.code.blocks.text(8)


def test_threads_hold_what_they_write_when_nobody_waits_any_more(code, monkeypatch, collect_garbage):
    """Freed, it would be another's: a heap that is written over ends the process, or changes numbers."""
    code(STARTS)
    begun, released, made = Event(), Event(), []

    class Slow:
        width = code.width

        def run(self, *_):
            begun.set()
            released.wait(60)

    def interrupted():
        made.extend(weakref.ref(item) for item in (machine, *arguments))
        begun.wait(60)
        signal.raise_signal(signal.SIGINT)

    machine, arguments = Slow(), [STARTS.copy()]
    monkeypatch.setattr(code.blocks, "choose_machine", lambda blocks, held=[machine]: held.pop())
    monkeypatch.setattr(compiled, "get_thread_pool", lambda: Interrupted(interrupted))
    monkeypatch.setattr(compiled, "LITTLE", 0)
    before, stopped = signal.signal(signal.SIGINT, signal.default_int_handler), False
    try:
        code(*arguments)
    except KeyboardInterrupt:
        stopped = True
    finally:
        signal.signal(signal.SIGINT, before)
    del machine, arguments
    collect_garbage()
    assert stopped and len(made) == 2
    assert all(item() is not None for item in made)
    released.set()
    get_careful_thread().submit(int).result()


class Interrupted:
    """Threads whose results are waited for until a Ctrl-C."""

    def __init__(self, interrupt):
        self.pool, self.interrupt = ThreadPoolExecutor(1), interrupt

    def map(self, function, arguments):
        futures = [self.pool.submit(function, item) for item in arguments]
        self.interrupt()
        return [future.result() for future in futures]


def test_calls_go_on_with_first_arguments_that_are_held():
    """What all runs share of them is computed once; where a shared argument is left for calls, at each."""

    def function(matrix, offset, x):
        return jnp.linalg.inv(matrix) @ x + jnp.exp(offset)

    code = compile(function, np.eye(2), 0.0, np.zeros(2), shared=[0, 1])
    matrix, x = np.array([[2.0, 1.0], [0.0, 4.0]]), np.arange(6.0).reshape(3, 2)
    held, all_held = code.with_first_arguments(matrix), code.with_first_arguments(matrix, 0.5)
    for offset in (0.5, -1.0):
        assert np.array_equal(held(offset, x), code(matrix, offset, x))
        assert np.array_equal(all_held(x + offset), code(matrix, 0.5, x + offset))
    assert np.array_equal(code.with_first_arguments(np.eye(2), 0.5)(x), code(np.eye(2), 0.5, x))
    with pytest.raises(ValueError, match="array 0 of the arguments: expected shape"):
        code.with_first_arguments(np.eye(3))


def test_one_run_has_the_bits_of_many_in_memory_of_its_own():
    """A step as of a filter: what all share is computed once, roots and products of it and of the run's own numbers."""

    def step(shared, x):
        root = jnp.sqrt(shared @ shared.T)
        return root @ jnp.sin(x) / (1.0 + x[0] ** 2), root

    rng = np.random.default_rng(0)
    shared, x = rng.uniform(size=(3, 3)), rng.normal(size=(9, 3))
    code = compile(step, shared, x[0], shared=[0]).with_first_arguments(shared)
    one, other = code.make_in_place_code(1), code.make_in_place_code(1)
    moved, root = code(x)
    for run in range(9):
        one.inputs[0][0] = x[run]
        one()
        assert one.outputs[0][0].tobytes() == moved[run].tobytes()
        assert code(x[run : run + 1])[0].tobytes() == moved[run].tobytes()
    assert one.outputs[1][0].tobytes() == root[0].tobytes()
    assert not other.inputs[0].any()
    # Many runs at a time, whose memory is given, and what they share anew in every call.
    loose = compile(step, shared, x[0], shared=[0])
    many = loose.make_in_place_code(9, {1: x})
    for scale in (1.0, 2.0):
        many.inputs[0][...] = scale * shared
        many()
        for held, right in zip(many.outputs, loose(scale * shared, x), strict=True):
            assert held.tobytes() == right.tobytes()
    with pytest.raises(ValueError, match="array 1 read in place: expected contiguous numbers of type float64"):
        loose.make_in_place_code(9, {1: x.astype(np.float32)})
    with pytest.raises(ValueError, match="array 1 of the arguments: expected shape"):
        loose.make_in_place_code(8, {1: x})


@pytest.mark.parametrize("place", [1, 8, 40, 49])
def test_runs_of_several_arrays_are_those_of_one(place):
    x, matrix = np.random.default_rng(4).normal(size=(50, 3)), np.arange(9.0).reshape(3, 3)
    code = compile(lambda x, matrix: (matrix @ jnp.sin(x), matrix.T), x[0], matrix, shared=[1])
    joined = code.compute_calls([(x[:place], matrix), (x[place:], matrix)])
    for a, b in zip(joined, code(x, matrix), strict=True):
        np.testing.assert_array_equal(a, b)
