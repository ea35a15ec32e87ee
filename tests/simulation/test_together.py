"""Like kernels of one traced step become one, and nothing else changes."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jax.extend.core import ClosedJaxpr

import heliograph as hg
from heliograph.numerics.over_runs import is_kernel, runs_last
from heliograph.numerics.small_matrix import times
from heliograph.simulation import by_run
from heliograph.simulation.together import together

RNG = np.random.default_rng(0)
A, B, C = RNG.normal(size=(3, 2, 2)), RNG.normal(size=(4, 3, 2, 2)), RNG.normal(size=(2, 2))
product = runs_last(times)
total = runs_last(lambda a, b: a + b)


def kernels(program):
    return [one.params["runs"] for one in program.jaxpr.eqns if is_kernel(one)]


def joined(function, *args, marks=None):
    """The program before and after; of both the numbers."""
    with jax.enable_x64(True):
        program = jax.make_jaxpr(function)(*args)
        chosen = program.jaxpr.invars if marks is None else [program.jaxpr.invars[i] for i in marks]
        after = together(program, by_run._marked(program, [v in chosen for v in program.jaxpr.invars]), many=0)
        was, now = (jax.core.eval_jaxpr(p.jaxpr, p.consts, *args) for p in (program, after))
    assert [v.aval for v in after.jaxpr.outvars] == [v.aval for v in program.jaxpr.outvars]
    for x, y in zip(was, now, strict=True):
        np.testing.assert_array_equal(x, y)
    return kernels(program), kernels(after)


def three(a, b, c):
    first = jax.vmap(product, in_axes=(0, None))(a, c)
    second = jax.vmap(jax.vmap(product, in_axes=(0, None)), in_axes=(0, None))(b, 2 * c)
    return first, second, product(c, c)


def test_like_kernels_of_other_runs_become_one():
    assert joined(three, A, B, C) == ([(3,), (3, 4), ()], [(3 + 12 + 1,)])


def test_a_program_of_few_kernels_stays_as_it_is():
    program = jax.make_jaxpr(three)(A, B, C)
    assert together(program, program.jaxpr.invars) is program
    assert together(program, program.jaxpr.invars, many=4) is program
    assert together(program, program.jaxpr.invars, many=3) is not program


def test_what_is_marked_stays_apart():
    """Else what all runs share would be computed for each of them: here the last product, of C alone."""
    assert sorted(joined(three, A, B, C, marks=[0, 1])[1]) == [(), (15,)]


def test_other_arithmetic_and_other_shapes_stay_apart():
    wide = RNG.normal(size=(2, 3))
    assert len(joined(lambda a, w: (product(a, a), total(a, a), product(a, w)), C, wide)[1]) == 3


def test_a_kernel_waits_for_its_like_but_not_for_one_that_needs_it():
    def late(a, b):
        early = product(a, a)
        return early, product(jnp.sin(total(b, b)), a)

    def chain(a):
        return product(product(a, a), a)

    assert joined(late, C, C)[1] == [(), (2,)]
    assert joined(chain, C)[1] == [(), ()]


def test_kinds_that_wait_for_each_other_are_computed():
    def crossed(a, b):
        one, other = product(a, a), total(b, b)
        return one, other, product(other, a), total(one, b)

    assert joined(crossed, C, C)[1] == [(), (2,), ()]


@pytest.fixture
def network():
    plant = hg.LinearPlant([[0.9, 0.1], [0.0, 0.8]], 0.1 * np.eye(2), np.zeros(2), np.eye(2))
    sensor = hg.LinearSensor(np.eye(2), 0.1)
    nodes = {}
    for name, probability in (("a", 0.9), ("b", 0.7)):
        relay = hg.amplify_and_forward([hg.hop(hg.Rayleigh(0.8), 0.1, dimension=2)])
        channel = hg.dropout(relay, probability)
        filters = {"cubature": hg.cubature_filter, "extended": hg.extended_filter}
        made = {f: make(plant, sensor, channel) for f, make in filters.items()}
        nodes[name] = hg.Node(sensor, channel, made if name == "a" else {"cubature": made["cubature"]})
    return hg.Network(plant, nodes)


@pytest.mark.slow
def test_a_network_says_the_same_with_fewer_kernels(network, monkeypatch):
    """Each run's numbers are worked through in other company: up to rounding the same, 1e-13 of what is near 1."""
    counts = []

    def counted(program: ClosedJaxpr, marked):
        after = together(program, marked, many=0)
        counts.append((len(kernels(program)), len(kernels(after))))
        return after

    monkeypatch.setattr(by_run, "together", counted)
    found = hg.monte_carlo(network, 6, 40, 0)
    assert counts and all(after < before for before, after in counts), counts
    jax.clear_caches()
    left = []
    monkeypatch.setattr(by_run, "together", lambda program, marked: left.append(program) or program)
    alone = hg.monte_carlo(network, 6, 40, 0)
    assert left
    for node, filters in alone.estimates.items():
        for name, estimate in filters.items():
            for x, y in ((estimate.mean, found.estimates[node][name].mean),
                         (estimate.covariance, found.estimates[node][name].covariance)):  # fmt: skip
                np.testing.assert_allclose(x, y, rtol=0, atol=1e-13)
