"""Formulas on vectors as text of LLVM IR: `a * b + c` on `Vector`s appends operations to a `FormulaBody`.

Every function of this folder is one straight line of such operations. Numbers of Python stand for vectors of that
number. Operations are written as they stand: no contraction, no reordering; `fma` rounds once.
"""

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import TypeAlias

Operand: TypeAlias = "Vector | float"  # a vector, or a number for a vector of it
REALS = ("double", "float")


@dataclass
class FormulaBody:
    """Operations of one LLVM function on vectors, of as many numbers as the text that it stands in says.

    `lines` are the operations so far, and `block` is the label of the basic block that is being written.
    """

    lines: list[str] = field(default_factory=list)
    block: str = "entry"

    def type(self, scalar: str) -> str:
        """Return the name of the type of a vector of these scalars, such as "%double"."""
        return f"%{scalar}"

    def add(self, scalar: str, operation: str) -> "Vector":
        """Append an LLVM instruction, given without its result; return the result, a vector of numbers `scalar`."""
        name = f"%t{len(self.lines)}"
        self.lines.append(f"{name} = {operation}")
        return Vector(self, scalar, name)

    def compute_where_needed(self, needed: "Vector", costly: Callable[[], "Vector"], value: "Vector") -> "Vector":
        """Return the result of `costly` in the lanes where it is `needed`, and `value` in the others.

        A call of `costly` writes its operations, and returns their result. They are written within a block that is
        skipped if no lane needs it.
        """
        start, mark = self.block, len(self.lines)
        truth = self.type("i1")
        self.lines.append(f"%some{mark} = call i1 @llvm.vector.reduce.or({truth} {needed.name})")
        self.lines.append(f"br i1 %some{mark}, label %costly{mark}, label %end{mark}")
        self.lines.append(f"costly{mark}:")
        chosen = select(needed, costly(), value)
        self.lines.append(f"br label %end{mark}")
        self.lines.append(f"end{mark}:")
        self.block = f"end{mark}"
        return self.add(value.scalar, f"phi {value.type} [{value.name}, %{start}], [{chosen.name}, %costly{mark}]")

    def call(self, intrinsic: str, *args: "Vector") -> "Vector":
        """Return the result of an LLVM intrinsic of real numbers, such as "fma"."""
        real = args[0].type
        return self.add(args[0].scalar, f"call {real} @llvm.{intrinsic}({', '.join(f'{real} {a.name}' for a in args)})")


def _make_operator(
    real_instruction: str, integer_instruction: str, is_reflected: bool = False
) -> Callable[["Vector", Operand], "Vector"]:
    """Return the method of an operator of vectors, such as __add__, which writes an LLVM instruction.

    Reals and integers have different instructions. `is_reflected`: whether the vector is the second operand, as in
    `2 - x` (Python's __rsub__).
    """

    def apply(self: "Vector", other: Operand) -> "Vector":
        """Write the instruction for (self, other), or for (other, self) if `is_reflected`; return its result."""
        operands = (self, self.like(other))
        a, b = reversed(operands) if is_reflected else operands
        instruction = real_instruction if self.scalar in REALS else integer_instruction
        return self.body.add(self.scalar, f"{instruction} {self.type} {a.name}, {b.name}")

    return apply


def _make_comparison(real_condition: str, integer_condition: str) -> Callable[["Vector", Operand], "Vector"]:
    """Return a method that compares vectors, such as __lt__, by LLVM's condition for reals or that for integers."""

    def compare(self: "Vector", other: Operand) -> "Vector":
        """Write the comparison of self with other; return its truth values, lane by lane."""
        comparison = f"fcmp {real_condition}" if self.scalar in REALS else f"icmp {integer_condition}"
        return self.body.add("i1", f"{comparison} {self.type} {self.name}, {self.like(other).name}")

    return compare


@dataclass(frozen=True, eq=False)
class Vector:
    """A vector in a body: doubles, floats, integers or truths (scalars "double", "float", "i64", "i32", "i1")."""

    body: FormulaBody
    scalar: str
    name: str

    @property
    def type(self) -> str:
        """Return the name of the vector's type in LLVM's text, such as "%double"."""
        return self.body.type(self.scalar)

    def like(self, value: Operand) -> "Vector":
        """Convert a number to a vector of this type; vectors are returned unchanged."""
        return value if isinstance(value, Vector) else make_constant(self.body, self.scalar, value)

    __add__, __radd__ = _make_operator("fadd", "add"), _make_operator("fadd", "add", is_reflected=True)
    __sub__, __rsub__ = _make_operator("fsub", "sub"), _make_operator("fsub", "sub", is_reflected=True)
    __mul__, __rmul__ = _make_operator("fmul", "mul"), _make_operator("fmul", "mul", is_reflected=True)
    __truediv__, __rtruediv__ = _make_operator("fdiv", "sdiv"), _make_operator("fdiv", "sdiv", is_reflected=True)
    __and__, __or__, __xor__ = _make_operator("and", "and"), _make_operator("or", "or"), _make_operator("xor", "xor")
    __lshift__, __rshift__ = _make_operator("shl", "shl"), _make_operator("ashr", "ashr")  # the second arithmetically
    __lt__, __le__ = _make_comparison("olt", "slt"), _make_comparison("ole", "sle")
    __gt__, __ge__ = _make_comparison("ogt", "sgt"), _make_comparison("oge", "sge")
    equals = _make_comparison("oeq", "eq")  # false for NaN

    def __neg__(self) -> "Vector":
        """Write the negation of real numbers; return its result."""
        return self.body.add(self.scalar, f"fneg {self.type} {self.name}")

    def __abs__(self) -> "Vector":
        """Write the absolute value of real numbers; return its result."""
        return self.body.call("fabs", self)

    def as_type(self, scalar: str) -> "Vector":
        """Return the vector of scalars of another type, such as "i64", that have the same bits."""
        return self.body.add(scalar, f"bitcast {self.type} {self.name} to {self.body.type(scalar)}")

    def converted(self, scalar: str) -> "Vector":
        """Return the nearest real numbers of another precision, `scalar` "double" or "float"."""
        how = "fpext" if scalar == "double" else "fptrunc"
        return self.body.add(scalar, f"{how} {self.type} {self.name} to {self.body.type(scalar)}")


def rounded(value: float) -> float:
    """Return the number of single precision that is nearest to a number."""
    nearest: float = struct.unpack("f", struct.pack("f", value))[0]
    return nearest


def make_constant(body: FormulaBody, scalar: str, value: float) -> Vector:
    """Return a vector with one number in all lanes, as an LLVM literal; a real one is written by its bits as double."""
    if scalar in REALS:
        value = value if scalar == "double" else rounded(value)
        text = "0x" + struct.pack(">d", value).hex().upper()
    elif scalar == "i1":
        text = "true" if value else "false"
    else:
        text = str(int(value))
    return Vector(body, scalar, f"splat ({scalar} {text})")


def select(condition: Vector, yes: Operand, no: Operand) -> Vector:
    """Return `yes` in the lanes where the condition holds, and `no` in the others.

    Each of them is a vector or a number. Two numbers give a vector of doubles.
    """
    body = condition.body
    any_vector = next((v for v in (yes, no) if isinstance(v, Vector)), make_constant(body, "double", 0.0))
    a, b = any_vector.like(yes), any_vector.like(no)
    text = f"select {condition.type} {condition.name}, {a.type} {a.name}, {b.type} {b.name}"
    return body.add(any_vector.scalar, text)


def fma(a: Operand, b: Operand, c: Operand) -> Vector:
    """Return a b + c, rounded once, lane by lane; at least one of them is a vector, and numbers stand for vectors."""
    model = next(v for v in (a, b, c) if isinstance(v, Vector))  # whose type and text the numbers take
    return model.body.call("fma", *(model.like(v) for v in (a, b, c)))


def sqrt(x: Vector) -> Vector:
    """Return the square root of each number of a vector, correctly rounded."""
    return x.body.call("sqrt", x)


def copy_sign(magnitude: Vector, sign: Vector) -> Vector:
    """Return |magnitude| with the sign of `sign` in each lane; a zero has a sign too."""
    return magnitude.body.call("copysign", magnitude, magnitude.like(sign))


def polynomial(x: Vector, coefficients: Sequence[Operand]) -> Vector:
    """Return c_0 + c_1 x + c_2 x^2 + ... by Horner's rule, for each number x of a vector; c_0 is the first."""
    *lower, value = coefficients
    for c in reversed(lower):
        value = fma(x, value, c)
    return x.like(value)


@cache
def write_function(name: str, formula: Callable[..., Vector], arguments: int = 1, scalar: str = "double") -> str:
    """Return the LLVM text of a function of vectors that computes a formula.

    `formula` is called with as many vectors as `arguments` says, whose numbers are of type `scalar` ("double" or
    "float"). Each operation on them appends a line to the text.
    """
    body = FormulaBody()
    real = body.type(scalar)
    value = formula(*(Vector(body, scalar, f"%x{i}") for i in range(arguments)))
    lines = "".join(f"  {line}\n" for line in body.lines)
    signature = ", ".join(f"{real} %x{i}" for i in range(arguments))
    return f"define internal {real} @hg_{name}({signature}) #9 {{\nentry:\n{lines}  ret {real} {value.name}\n}}\n"
