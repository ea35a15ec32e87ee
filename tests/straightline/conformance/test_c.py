"""The same table through C: compiled to stop at what C leaves undefined, with the numbers of XLA."""

import numpy as np
import pytest

from tests.straightline.conformance.c import COMPILERS, by_c, is_written
from tests.straightline.conformance.engines import by_xla
from tests.straightline.conformance.test_native import CASES, ONE_AT_A_TIME, compare, singles, some, thinned

LEFT_OUT = {*ONE_AT_A_TIME, "lgamma"}  # the sign that lgamma returns beside is a variable of the C library
MOST = 8  # runs of a case


@pytest.mark.slow
@pytest.mark.skipif(not COMPILERS, reason="no C compiler")
@pytest.mark.parametrize("name", sorted(CASES))
def test_a_rule_computes_in_c_what_xla_computes(name, tmp_path):
    if name in LEFT_OUT:
        pytest.skip("a loop, or a function of the C library's own")
    cases = [c._replace(units=c.units and max(c.units, 8.0)) for c in some(CASES[name], 6)]
    cases = [case for case in (thinned(case, MOST) for case in cases) if is_written(case)]
    expected = by_xla(cases)
    for compiler in COMPILERS:
        results = by_c(cases, tmp_path, compiler)
        compare(name, cases, [x for leaves in results for x in leaves], expected, compiler)


DAILY = ("add", "mul", "div", "rem", "convert_element_type", "shift_left", "max", "bitcast_convert_type")


@pytest.mark.skipif(not COMPILERS, reason="no C compiler")
def test_the_commonest_rules_compute_in_c_what_xla_computes(tmp_path):
    """Saturated conversions, integers that wrap around, divisions by zero, the sign of a zero."""
    cases = [thinned(case, 15) for name in DAILY for case in CASES[name]]
    cases = [c for c in cases if "uint32" not in c.label.split(" as ")[1:]]
    results = by_c(cases, tmp_path, COMPILERS[0])
    compare("add", cases, [x for leaves in results for x in leaves], by_xla(cases), COMPILERS[0])


@pytest.mark.skipif(not COMPILERS, reason="no C compiler")
def test_floats_are_floats_in_c(tmp_path):
    """The same of numbers of single precision, with doubles where JAX converts, and functions of libm in float."""
    cases = [thinned(case, 15) for name in (*DAILY, "exp", "atan2") for case in singles(name)[:1]]
    cases += [c for c in CASES["convert_element_type"] if "float32" in c.label]
    results = by_c(cases, tmp_path, COMPILERS[0])
    compare("add", cases, [x for leaves in results for x in leaves], by_xla(cases), COMPILERS[0])


@pytest.mark.skipif(not COMPILERS, reason="no C compiler")
def test_a_missing_number_raises_no_flag(tmp_path):
    """Comparisons, maxima and conversions of NaN, which a device that traps invalid operations would stop at."""
    x = np.array([np.nan, 1.5, -2.0])
    cases = []
    for name in (
        "lt",
        "le",
        "gt",
        "ge",
        "eq",
        "ne",
        "max",
        "min",
        "sign",
        "is_finite",
        "convert_element_type",
        "clamp",
    ):
        of_reals = [c for c in CASES[name] if all(a.dtype == np.float64 for a in c.arguments)]
        cases += [c._replace(arguments=(x, x[::-1], x[[1, 2, 0]])[: len(c.arguments)]) for c in of_reals]
    results = by_c(cases, tmp_path, COMPILERS[0], quiet=True)
    compare("min", cases, [x for leaves in results for x in leaves], by_xla(cases), COMPILERS[0])
