"""Native code means what JAX means: every operation that it takes, on edge values, against XLA.

The cases are made of the table of rules, so that a new rule is covered by being there. What may differ, and why:

* Subnormal numbers, which XLA's code takes for zeros, and native code computes with (`difference`): arguments of the
  table and results are held against NumPy instead (`test_subnormal.py`).
* Eigenvectors, of which any sign, and of equal eigenvalues any basis, is right: V diag(w) V', V'V and v v' of separate
  eigenvalues are compared (`matrices.py`).
* Bits of NaN.
* Units of rounding of functions, which both compute in their own way, and of sums and products, in their own order
  and with a product and a sum rounded once (`Case.units`). XLA's cosh, sinh and exp2 of large numbers have 14 digits,
  its cbrt of powers of two 14, and its lgamma is off beside its zeros.
* A term of a matrix product in which data meet a known zero. Native code has no such term, so that NaN and infinity
  pass only to what depends on them; XLA makes 0 NaN = NaN (`PRODUCTS`; `rules/test_matrices.py` says what is right).
* In single precision: the sums of cumsum, of up to 90 numbers of which some are 2^31 and have no units of the others,
  are made in another order; lgamma, whose zeros XLA has to 4e-7 (`vectors/test_elementary.py` has its values).
* The sign of a sum that is zero: XLA drops a known 0 that is added to -0, as native code does, and begins some sums
  with a 0 that others do not have (`ADDED`).
* What XLA makes of two operations together, where native code agrees with JAX operation by operation: XLA takes a flag
  times a number for a choice, so that False times NaN is 0, and an integer that is cast to an unsigned one and on to a
  real number keeps its sign (`test_where_xla_rewrites_native_code_means_what_the_operations_say`).
"""

import sys
import warnings
from functools import partial
from itertools import product
from typing import Any

import jax
import jax.extend.core
import jax.numpy as jnp
import numpy as np
import pytest

import straightline as sl
from straightline.compiled import CompiledFunction
from straightline.lowering import IN_MEMORY, RULES, trace_function
from straightline.nodes import Unsupported
from tests.straightline.conformance import arrays, elementwise, matrices, programs
from tests.straightline.conformance.case import Case, Table, in_single, is_taken
from tests.straightline.conformance.engines import by_known, by_lanes, by_xla, difference, program_of

LISTED = [{name: partial(list, cases) for name, cases in part.CASES.items()} for part in (arrays, matrices, programs)]
CASES = Table(LISTED[0] | elementwise.MAKERS | LISTED[1] | LISTED[2])
ADDED = {"add", "sub", "add_any", "reduce_sum", "cumsum", "dot_general", "scatter-add", "scatter_add", "scatter-sub"}
PRODUCTS = {"dot_general"}
SINGLE = {"cumsum": 90.0}  # units in single precision, where they are more than in double
RULES_OF_ALL = sorted({*RULES, *IN_MEMORY})
MOST = 12  # cases of an operation
ONE_AT_A_TIME = {
    "scan",
    "while",
    "cond",
    "random_gamma",
    "eigh",
    "igamma",
    "igammac",
}  # loops, of which a lane is one run
# Of other releases of JAX, or without a function of its own.
LATER = {
    "closed_call",
    "eq_to",
    "polynomial",
    "one_minus_square",
    "log2",
    "empty",
    "empty2",
    "call_hi_primitive",
    "copy_p",
    "pjit",
    "core_call",
}


def primitives() -> set[str]:
    """The operations of this release of JAX, and the package's own."""
    modules = [
        m for name, m in list(sys.modules.items()) if name.startswith(("jax", "straightline.")) and m is not None
    ]
    return {v.name for m in modules for v in vars(m).values() if isinstance(v, jax.extend.core.Primitive)}


def operations(jaxpr: Any) -> set[str]:
    """The operations of a traced program and of those inside it, also in the definition of one (JAX from 0.12 on)."""
    names = set()
    for equation in jaxpr.eqns:
        names.add(equation.primitive.name)
        defined = equation.params.get("_prim") if equation.primitive.name == "call_hi_primitive" else None
        if defined is not None:
            avals = jax.tree.unflatten(defined.in_tree, [v.aval for v in equation.invars])
            shapes = jax.tree.map(lambda aval: jax.ShapeDtypeStruct(aval.shape, aval.dtype), avals)
            with jax.enable_x64(True):
                names |= operations(jax.make_jaxpr(defined.expand)(*shapes).jaxpr)
        for param in equation.params.values():
            for inner in param if isinstance(param, tuple | list) else (param,):
                inner = getattr(inner, "jaxpr", inner)
                names |= operations(inner) if hasattr(inner, "eqns") else set()
    return names


def some(cases: list[Case], most: int) -> list[Case]:
    """So many of the cases at most, spread over the table."""
    return cases[:: -(-len(cases) // most)] if cases else []


def thinned(case: Case, most: int) -> Case:
    """So many runs of a case at most, spread over its runs."""
    step = -(-case.runs // most)
    return case._replace(arguments=tuple(a[::step] for a in case.arguments))


def finite(case: Case) -> Case:
    """A case with halves in place of NaN and infinities."""
    return case._replace(
        arguments=tuple(np.where(np.isfinite(a), a, 0.5) if a.dtype.kind == "f" else a for a in case.arguments)
    )


def compare(
    name: str, cases: list[Case], results: list[np.ndarray], expected: list[list[np.ndarray]], how: str
) -> None:
    """All leaves of all cases."""
    leaves = [(case, e) for case, one in zip(cases, expected, strict=True) for e in one]
    for (case, e), result in zip(leaves, results, strict=True):
        if name in ADDED and e.dtype.kind == "f":
            result, e = result + 0.0, e + 0.0
        differs = difference(result, e, case.units)
        runs = np.unique(np.nonzero(differs)[0]) if differs.ndim else []
        shown = [([a[r] for a in case.arguments], result[r], e[r]) for r in runs[:2]]
        assert not np.any(differs), f"{name} {case.label} {how}: {shown}"


def taken(name: str, cases: list[Case]) -> list[Case]:
    """The cases that native code takes; no rule may fail in any other way than by refusing."""
    kept = []
    for case in cases:
        try:
            CompiledFunction(program_of([thinned(case, 1)]), [True] * len(case.arguments))
        except Unsupported:
            continue
        kept.append(case)
    return kept


@pytest.mark.parametrize("name", RULES_OF_ALL)
def test_every_rule_has_cases_in_which_it_is_used(name):
    if name not in primitives():
        pytest.skip("an operation of other releases of JAX")
    assert CASES.get(name), f"cases of {name}"
    if name not in LATER:
        seen = set[str]()
        for case in CASES[name]:
            seen |= operations(trace_function(case.function, *case.row(0))[0].jaxpr)
            if name in seen:
                return
        raise AssertionError(f"{name} in its cases: {sorted(seen)}")


@pytest.mark.slow
@pytest.mark.parametrize("name", RULES_OF_ALL)
def test_a_rule_computes_what_xla_computes(name):
    """Of data, each run a lane and all in one program; of known numbers; and of both."""
    check(name, CASES.get(name, []))


@pytest.mark.slow
@pytest.mark.parametrize("name", RULES_OF_ALL)
def test_a_rule_computes_what_xla_computes_in_single_precision(name):
    """The same table with numbers of float32, which meet doubles where JAX makes doubles of what is known."""
    check(name, singles(name))


def singles(name: str) -> list[Case]:
    """The cases of an operation that have real numbers, of single precision."""
    table = [] if name == "lgamma" else CASES.get(name, [])
    of_reals = [c for c in table if any(a.dtype == np.float64 for a in c.arguments)]
    made = [in_single(c, max(c.units, SINGLE.get(name, 0.0))) for c in of_reals]
    return [c for c in made if c.runs and is_taken(c.function, c.row(0))]


def check(name: str, table: list[Case]) -> None:
    """Compare the cases of an operation with XLA."""
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        cases = taken(name, some(table, MOST))
        expected = by_xla(cases)
        for case, e in zip(cases, expected, strict=True):
            compare(name, [case], by_lanes(case), [e], "in lanes")
        if name in ONE_AT_A_TIME:
            return
        arity = max((len(case.arguments) for case in cases), default=0)
        few = [thinned(case, 30) for case in cases]
        tables = {False: few, True: [finite(case) for case in few]}
        expected = {only_finite: by_xla(tables[only_finite]) for only_finite in {False, name in PRODUCTS}}
        for known in product((False, True), repeat=arity):
            meets_zeros = name in PRODUCTS and len(set(known)) == 2
            some_cases, how = tables[meets_zeros], f"known: {known}"
            try:
                compare(name, some_cases, by_known(some_cases, known), expected[meets_zeros], how)
            except Unsupported:
                continue


DAILY = (
    "add",
    "sub",
    "neg",
    "max",
    "min",
    "sign",
    "div",
    "rem",
    "convert_element_type",
    "cholesky",
    "lu",
    "dot_general",
)


@pytest.mark.parametrize("name", DAILY)
def test_the_commonest_rules_compute_what_xla_computes(name):
    """Some runs of some cases, of data and of known numbers."""
    cases = [thinned(case, 12) for case in some(CASES[name], 6)]
    cases, expected = taken(name, cases), by_xla(cases)
    for known in ((False,) * 4, (True,) * 4):
        compare(name, cases, by_known(cases, known), expected, f"known: {known[0]}")


@pytest.mark.parametrize("name", DAILY)
def test_the_commonest_rules_compute_in_single_precision_what_xla_computes(name):
    cases = taken(name, [thinned(case, 12) for case in some(singles(name), 3)])
    expected = by_xla(cases)
    for known in ((False,) * 4, (True,) * 4):
        compare(name, cases, by_known(cases, known), expected, f"known: {known[0]}")


@pytest.mark.parametrize("name", [name for name in elementwise.FOURTEEN_DIGITS if name != "lgamma"])
def test_native_code_has_all_digits_where_xla_has_fourteen(name):
    (case,) = (case for case in CASES[name] if case.arguments[0].dtype == np.float64)
    with np.errstate(all="ignore"):
        exact = getattr(np, name)(case.arguments[0])
    compare(name, [case], by_lanes(case), [[exact]], "beside NumPy")
    assert not np.any(difference(by_lanes(case)[0], exact, 4.0))


@pytest.mark.parametrize(
    ("function", "right"),
    [
        (lambda x: (x > 0) * x, [1.5, -0.0, np.nan, 7.0]),
        (lambda x: jnp.nan_to_num(x).astype(int).astype(jnp.uint64).astype(float), [1.0, 2.0**64 - 2, 0.0, 7.0]),
    ],
)
def test_where_xla_rewrites_native_code_means_what_the_operations_say(function, right):
    """As NumPy has them one after another: False times NaN is NaN, and -2 without a sign is 2^64 - 2."""
    x = np.array([1.5, -2.0, np.nan, 7.0])
    with jax.enable_x64(True):
        result = sl.compile(function, x)(x[None])[0]
    np.testing.assert_array_equal(result, right)
    np.testing.assert_array_equal(np.signbit(result[:2]), np.signbit(right[:2]))
