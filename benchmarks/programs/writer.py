"""Random programs of arrays as text: a program is written statement by statement, from its seed alone.

A program is a function of a few arrays, one statement a line, that returns some of its variables. `rounded(x, n)` marks
what is known up to rounding: whoever runs the text says what it does.
"""

import random
from collections.abc import Callable, Sequence
from typing import NamedTuple

KINDS = ("float64", "bool", "int32", "int64", "uint32", "uint64")
INTEGERS = KINDS[2:]
SHAPES = ((), (), (), (1,), (2,), (3,), (4,), (5,), (2, 2), (3, 3), (2, 3), (3, 1), (0,), (6, 2), (24,), (70,))
REALS = ("0.0", "-0.0", "1.0", "-1.0", "0.5", "2.5", "-3.0", "jnp.nan", "jnp.inf", "-jnp.inf", "1e30", "7.0", "0.1")
WHOLES = ("0", "1", "2", "3", "5", "31", "32", "63", "64", "100")
COMPARISONS = ("==", "!=", "<", "<=", ">", ">=")
MOST = 18  # statements of a program, at most, besides those of its loops and branches


class Variable(NamedTuple):
    """A variable of a program: its name, the type of its numbers and its shape."""

    name: str
    kind: str
    shape: tuple[int, ...]

    @property
    def size(self) -> int:
        """Count of numbers."""
        count = 1
        for n in self.shape:
            count *= n
        return count


class Program(NamedTuple):
    """Text of a function `program(...)`, and the arrays that it takes."""

    text: str
    inputs: list[Variable]


class Writer:
    """A program that is being written: random choices, the lines so far and the variables in reach."""

    def __init__(self, seed: int, statements: "Sequence[Statement]"):
        self.random, self.statements = random.Random(seed), statements
        self.lines: list[str] = []
        self.known: list[Variable] = []
        self.depth, self.names, self.marks = 0, 0, 0

    def program(self) -> Program:
        """Write all of it."""
        draw = self.random
        inputs = [Variable(f"x{n}", draw.choice(KINDS), draw.choice(SHAPES)) for n in range(draw.randint(3, 5))]
        inputs += [Variable("x8", "float64", (3, 3)), Variable("x9", "int32", ())]
        self.known = list(inputs)
        for _ in range(draw.randint(6, MOST)):
            self.statement()
        made = self.known[len(inputs) :]
        kept = draw.sample(made, max(1, 2 * len(made) // 3)) if made else inputs
        kept.sort(key=lambda v: int(v.name[1:]))
        head = f"def program({', '.join(v.name for v in inputs)}):"
        last = f"    return {{{', '.join(f'{v.name!r}: {v.name}' for v in kept)}}}"
        return Program("\n".join([head, *self.lines, last, ""]), inputs)

    # What is in reach.

    def find(self, wanted: Callable[[Variable], bool]) -> Variable | None:
        """Return a variable of this sort, later ones rather; None if there is none."""
        fitting = [v for v in self.known if wanted(v)]
        if not fitting:
            return None
        return fitting[max(self.random.randrange(len(fitting)), self.random.randrange(len(fitting)))]

    def one(self, kind: str, shape: tuple[int, ...] | None = None) -> Variable | None:
        """Return a variable of a type, and of a shape if one is wanted."""
        return self.find(lambda v: v.kind == kind and shape in (None, v.shape))

    def partner(self, x: Variable) -> str:
        """Return what an operation can take beside x, of the same type: a variable or a number."""
        other = self.find(lambda v: v.kind == x.kind and v.shape in (x.shape, ()))
        if other is None or self.random.random() < 0.2:
            return self.number(x.kind)
        return other.name

    def number(self, kind: str) -> str:
        """Return a known number of a type."""
        if kind == "bool":
            return f"jnp.asarray({self.random.choice((True, False))})"
        return f"jnp.asarray({self.random.choice(REALS if kind == 'float64' else WHOLES)}, jnp.{kind})"

    def index(self) -> str:
        """Return an integer: of the data, or known; mostly near what arrays have."""
        v = self.find(lambda v: v.kind in INTEGERS and v.shape == ())
        if v is None or self.random.random() < 0.25:
            return str(self.random.randint(-3, 6))
        return v.name if self.random.random() < 0.4 else f"({v.name} % 7).astype(jnp.int32) - 1"

    def place(self) -> str:
        """Return an index that stands beside others in an array."""
        return f"jnp.asarray({self.index()}).astype(jnp.int64)"

    def truth(self) -> str:
        """Return a condition without axes."""
        v = self.find(lambda v: v.shape == ()) or Variable("x9", "int32", ())
        return v.name if v.kind == "bool" else f"({v.name} {self.random.choice(COMPARISONS)} {self.partner(v)})"

    # What is written.

    def line(self, text: str) -> None:
        """Write a line at the depth of the loops around it."""
        self.lines.append("    " * (self.depth + 1) + text)

    def name(self, letter: str = "v") -> str:
        """Return a new name."""
        self.names += 1
        return f"{letter}{self.names}"

    def let(self, text: str, kind: str, shape: Sequence[int], is_rounded: bool = False) -> None:
        """Write a new variable."""
        v = Variable(self.name(), kind, tuple(shape))
        if is_rounded and kind == "float64":
            self.marks += 1
            text = f"rounded({text}, {self.marks})"
        self.line(f"{v.name} = {text}")
        self.known.append(v)

    def statement(self) -> None:
        """Write a statement, or nothing where the variables in reach do not allow its sort."""
        self.random.choice(self.statements)(self)


Statement = Callable[[Writer], None]
