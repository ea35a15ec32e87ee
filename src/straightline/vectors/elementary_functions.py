"""Elementary functions of vectors of doubles or floats as text of LLVM IR, each one straight line of operations.

LLVM's own intrinsics call the scalar library once for each number of a vector; these compute all numbers of a vector at
once. Each is within 2 units of rounding of the true value over its whole range, with NaN, infinities, zeros of both
signs and denormal numbers as in IEEE 754 and JAX. Square root and absolute value need no function.

Source: the reductions and minimax polynomials of Sun's fdlibm, https://www.netlib.org/fdlibm (exp's is a Taylor series
of one degree more than needed).
"""

from collections.abc import Callable, Iterable

from straightline.vectors import error_function as error
from straightline.vectors import exponential as exponential
from straightline.vectors import trigonometry as trigonometry
from straightline.vectors.formula_builder import Vector, write_function

FUNCTIONS: dict[str, tuple[Callable[..., Vector], int]] = {
    "exp": (exponential.exp, 1),
    "expm1": (exponential.expm1, 1),
    "log": (exponential.log, 1),
    "log1p": (exponential.log1p, 1),
    "tanh": (exponential.tanh, 1),
    "sin": (trigonometry.sin, 1),
    "cos": (trigonometry.cos, 1),
    "atan": (trigonometry.atan, 1),
    "atan2": (trigonometry.atan2, 2),
    "erf": (error.erf, 1),
    "erfc": (error.erfc, 1),
    "erf_inv": (error.erf_inv, 1),
}
OF_FLOATS = {"erf_inv": (error.erf_inv_of_floats, 1)}  # which have a form of their own
ATTRIBUTES = "attributes #9 = { noinline nounwind }\n"

# Called for each number of a vector: seldom used, or hard to get right.
SCALAR = {
    "pow": 2,
    "exp2": 1,
    "tan": 1,
    "asin": 1,
    "acos": 1,
    "sinh": 1,
    "cosh": 1,
    "asinh": 1,
    "acosh": 1,
    "atanh": 1,
    "cbrt": 1,
    "lgamma": 1,
}


def write_elementary_functions(names: Iterable[str], width: int) -> str:
    """Return the LLVM text of a function of vectors, `%double @hg_NAME(%double ...)`, for each name.

    A name that ends in f is that of a function of floats, as in C. A function in SCALAR calls the C library lane by
    lane, and needs a declaration. The others have a formula for whole vectors.
    """
    declared, texts = [], []
    for name in sorted(set(names)):
        kind = "double" if name in FUNCTIONS or name in SCALAR else "float"
        op = name if kind == "double" else name[:-1]
        if op in SCALAR:
            declared.append(f"declare {kind} @{name}({', '.join([kind] * SCALAR[op])})\n")
            texts.append(_write_by_number(name, kind, SCALAR[op], width))
        else:
            formula, count = OF_FLOATS.get(op, FUNCTIONS[op]) if kind == "float" else FUNCTIONS[op]
            texts.append(write_function(name, formula, count, kind))
    return "\n".join([*declared, *texts, ATTRIBUTES])


def _write_by_number(name: str, kind: str, count: int, width: int) -> str:
    """Return the LLVM text of a function of vectors that calls the C library's function `name` for each lane.

    The function has `count` arguments of the type `kind`, "double" or "float"; a vector has `width` lanes.
    """
    real = f"%{kind}"
    lines, results = [], "poison"  # `results` names the vector of results so far; "poison" has no number set
    for lane in range(width):
        for i in range(count):
            lines.append(f"%a{lane}_{i} = extractelement {real} %x{i}, i64 {lane}")
        args = ", ".join(f"{kind} %a{lane}_{i}" for i in range(count))
        lines.append(f"%b{lane} = call {kind} @{name}({args})")
        lines.append(f"%r{lane} = insertelement {real} {results}, {kind} %b{lane}, i64 {lane}")
        results = f"%r{lane}"
    signature = ", ".join(f"{real} %x{i}" for i in range(count))
    body = "".join(f"  {line}\n" for line in lines)
    return f"define internal {real} @hg_{name}({signature}) #9 {{\n{body}  ret {real} {results}\n}}\n"
