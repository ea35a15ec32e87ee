"""One random program by native code and by XLA, and where they differ by more than rounding explains."""

import warnings
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from programs.flow import program
from programs.writer import Program, Variable
from straightline.compiled import CompiledFunction
from straightline.nodes import Unsupported
from straightline.program import lower_function

RUNS = 16
DISTURBED = 6  # times that a program is computed with other roundings
PLACES = 251  # disturbances, which the numbers of a program take in turn
EPS = float(np.finfo(float).eps)
TIMES = 16.0  # how many times as far as disturbed results native code may be off
SMALL = 1e-280  # added to what is rounded: below it numbers are subnormal to one of both, and a zero has either sign
EDGES = np.array([np.nan, np.inf, -np.inf, 0.0, -0.0, 1.0, -1.0, 0.5, -2.5, 3.0, 1e30, 2.0**31, -(2.0**63), 0.1])

Disturbance = tuple[Any, Any]  # relative and absolute, (PLACES,) each


class Verdict(NamedTuple):
    """What became of a program: an empty text of what differs, why native code refused it, and what was compared."""

    differs: str = ""
    refused: str = ""
    compared: int = 0
    sensitive: int = 0  # numbers that rounding alone decides


def judged(seed: int) -> Verdict:
    """Compare the program of a seed."""
    made = program(seed)
    random = np.random.default_rng(seed)
    columns = [values(x, random) for x in made.inputs]
    by_xla = reference(made, columns, random)
    compared, sensitive = 0, 0
    for known in ([False] * len(columns), list(random.random(len(columns)) < 0.6)):
        runs = RUNS if not any(known) else 1
        given = [c[:runs] for c in columns]
        try:
            native = by_native(made, given, known)
        except Unsupported as error:
            return Verdict(refused=str(error).split("/")[0])
        for name, result in native.items():
            expected = by_xla[name][:, :runs]
            wrong, decided = difference(result, expected)
            compared, sensitive = compared + result.size, sensitive + int(np.sum(~decided))
            if np.any(wrong):
                return Verdict(said(name, wrong, result, expected[0], [n for n, k in enumerate(known) if k]))
    return Verdict("", "", compared, sensitive)


def values(x: Variable, random: np.random.Generator) -> np.ndarray:
    """Random numbers of an input for each run, edge values among them."""
    shape, edge = (RUNS, *x.shape), random.random((RUNS, *x.shape)) < 0.3
    if x.kind == "bool":
        return random.random(shape) < 0.5
    if x.kind == "float64":
        return np.where(edge, random.choice(EDGES, shape), random.normal(size=shape) * 3)
    ends = np.iinfo(x.kind)
    far = random.choice(np.array([ends.min, ends.max, ends.max // 2, 64, 31], x.kind), shape)
    near = random.integers(0 if ends.min == 0 else -4, 9, shape).astype(x.kind)
    return np.where(edge, far, near).astype(x.kind)


def function(made: Program, rounded: Callable[[Any, int], Any]) -> Callable[..., dict[str, Any]]:
    """The function of a program's text."""
    scope = {"jax": jax, "jnp": jnp, "lax": lax, "rounded": rounded}
    exec(compile(made.text, "random program", "exec"), scope)
    named: Callable[..., dict[str, Any]] = scope["program"]  # type: ignore[assignment]
    return named


def by_native(made: Program, columns: Sequence[np.ndarray], known: Sequence[bool]) -> dict[str, np.ndarray]:
    """By native code, each run a lane; of known inputs the first run's, which are constants of the program."""
    plain = function(made, lambda x, n: x)

    def rest(*data: Any) -> dict[str, Any]:
        left = iter(data)
        return plain(*(jnp.asarray(c[0]) if k else next(left) for c, k in zip(columns, known, strict=True)))

    data = [c for c, k in zip(columns, known, strict=True) if not k]
    with warnings.catch_warnings():
        warnings.simplefilter("error", RuntimeWarning)
        code = CompiledFunction(lower_function(rest, *(c[0] for c in data)), [True] * len(data))
        results: dict[str, np.ndarray] = code(*data)
    return results


def reference(made: Program, columns: Sequence[np.ndarray], random: np.random.Generator) -> dict[str, np.ndarray]:
    """By XLA, run by run, undisturbed and disturbed: (disturbed + 1, runs, ...).

    What is rounded, x, becomes x (1 + e) + f; undisturbed e = 0 and f = -0, which changes nothing. Which e follows
    from the bits of x too: of one e for all turns of a loop, x / (1 + e) of a turn would undo that of the turn before.
    """

    def disturbed(disturbance: Disturbance, row: Sequence[Any]) -> dict[str, Any]:
        def rounded(x: Any, n: int) -> Any:
            if x.dtype != np.float64:
                return x
            bits = (lax.bitcast_convert_type(x, np.uint64) % PLACES).astype(np.int64)
            places = (jnp.arange(x.size).reshape(x.shape) + 37 * n + bits) % PLACES
            return x * (1 + disturbance[0][places]) + disturbance[1][places]

        return function(made, rounded)(*row)

    relative = 8 * EPS * random.uniform(-1, 1, (DISTURBED + 1, PLACES))
    absolute = SMALL * random.choice([-1.0, 1.0], (DISTURBED + 1, PLACES))
    half = DISTURBED // 2
    relative[-half:] = -relative[1 : half + 1]  # what the sign of a rounding error decides is seen from both sides
    relative[0], absolute[0] = 0.0, -0.0
    with jax.enable_x64(True):
        every = jax.jit(lambda both, rows: lax.map(lambda d: lax.map(lambda row: disturbed(d, row), rows), both))
        results = every((relative, absolute), tuple(columns))
        return {name: np.asarray(x) for name, x in results.items()}


def difference(result: np.ndarray, expected: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Where native code differs from XLA, (disturbed + 1, ...), and which numbers rounding does not decide."""
    if result.dtype != expected.dtype or result.shape != expected.shape[1:]:
        return np.ones(1, bool), np.ones(1, bool)
    right = expected[0]
    if right.dtype != np.float64:
        decided = np.all(expected == right, axis=0)
        return (result != right) & decided, decided
    with np.errstate(all="ignore"):
        decided = np.all(
            (expected == right) | np.isfinite(expected + right) | (np.isnan(expected) & np.isnan(right)), 0
        )
        spread = np.max(np.abs(expected - right), axis=0)
        near = (spread > 0) & (np.abs(result - right) <= TIMES * spread)
    free = (spread > 0) | np.any(np.signbit(expected) != np.signbit(right), axis=0)  # a zero of which rounding decides
    same = (result == right) & ((np.signbit(result) == np.signbit(right)) | free)
    return ~(same | (np.isnan(result) & np.isnan(right)) | near) & decided, decided


def said(name: str, wrong: np.ndarray, result: np.ndarray, right: np.ndarray, known: Sequence[int]) -> str:
    """The first number that differs."""
    of = f"{name}, known inputs {list(known)}" if known else name
    if result.dtype != right.dtype or result.shape != right.shape:
        return f"{of}: {result.dtype} {result.shape} by native code, {right.dtype} {right.shape} by XLA"
    place = tuple(int(i) for i in np.argwhere(wrong)[0])
    return f"{of}: run {place[0]}, entry {place[1:]}: {result[place]!r} by native code, {right[place]!r} by XLA"
