"""Statements on arrays: shapes, reductions, places decided by data, small matrices, random numbers."""

from programs.writer import INTEGERS, Variable, Writer

READS = ('mode="fill"', 'mode="clip"', 'mode="fill", fill_value=3')
WRITES = ('mode="drop"', 'mode="clip"')
METHODS = ("set", "add", "subtract", "multiply", "min", "max")
SORTED = 20  # numbers that native code sorts
SUMS = ("jnp.sum", "jnp.prod", "jnp.mean", "lax.cumsum", "jnp.cumprod")


def _rows(w: Writer) -> Variable | None:
    """An array with axes and entries."""
    return w.find(lambda v: v.shape != () and v.size > 0)


def _moved(w: Writer) -> None:
    x = _rows(w)
    if x is None:
        return
    n, rest = x.shape[0], x.shape[1:]
    draw = w.random
    a, b = sorted((draw.randint(0, n), draw.randint(0, n)))
    low, high = draw.randint(0, 2), draw.randint(-1, 2)
    gap = " (0, 0, 0)," * len(rest)
    text, shape = draw.choice([
        (f"{x.name}[::-1]", x.shape), (f"{x.name}.T", x.shape[::-1]), (f"{x.name}.reshape(-1)", (x.size,)),
        (f"{x.name}[{a}:{b}]", (b - a, *rest)), (f"{x.name}[::2]", ((n + 1) // 2, *rest)), (f"{x.name}[0]", rest),
        (f"{x.name}[..., None]", (*x.shape, 1)), (f"jnp.concatenate([{x.name}, {x.name}[:1]])", (n + 1, *rest)),
        (f"jnp.stack([{x.name}] * 2)", (2, *x.shape)),
        (f"lax.pad({x.name}, {w.number(x.kind)}, [({low}, {high}, 1),{gap}])", (max(2 * n - 1 + low + high, 0), *rest)),
        (f"jnp.roll({x.name}, {draw.randint(-2, 2)}, axis=0)", x.shape),
        (f"jnp.broadcast_to({x.name}, (2, *{x.name}.shape))", (2, *x.shape)),
    ])  # fmt: skip
    if len(shape) <= 2:
        w.let(text, x.kind, shape)


def _reduced(w: Writer) -> None:
    x = w.find(lambda v: v.shape != () and v.kind != "bool")
    if x is None:
        return
    function, axis = w.random.choice(SUMS), w.random.randrange(len(x.shape))
    kind = "float64" if function == "jnp.mean" else x.kind
    if function.endswith(("cumsum", "cumprod")):
        w.let(f"{function}({x.name}, axis={axis})", kind, x.shape, True)
        return
    if kind in ("int32", "uint32") and function != "jnp.mean":  # NumPy's rule: sums of short integers are long
        kind = kind.replace("32", "64")
    given = f"{x.name}.astype(jnp.float64)" if function == "jnp.mean" else x.name
    w.let(f"{function}({given}, axis={axis})", kind, x.shape[:axis] + x.shape[axis + 1 :], True)


def _extremes(w: Writer) -> None:
    x = _rows(w)
    if x is None:
        return
    axis, draw = w.random.randrange(len(x.shape)), w.random
    rest = x.shape[:axis] + x.shape[axis + 1 :]
    text, kind, shape = draw.choice([
        (f"jnp.max({x.name}, axis={axis})", x.kind, rest), (f"jnp.min({x.name}, axis={axis})", x.kind, rest),
        (f"jnp.argmax({x.name}, axis={axis})", "int64", rest), (f"jnp.argmin({x.name}, axis={axis})", "int64", rest),
        (f"jnp.any({x.name} > 0, axis={axis})", "bool", rest),
        (f"jnp.all({x.name} == {x.name}, axis={axis})", "bool", rest),
        (f"lax.cummax({x.name}.astype(jnp.float64), axis={axis}, reverse=True)", "float64", x.shape),
    ])  # fmt: skip
    w.let(text, kind, shape)


def _sorted(w: Writer) -> None:
    x = w.find(lambda v: v.kind != "bool" and len(v.shape) == 1 and 0 < v.size <= SORTED)
    if x is not None:
        text, kind = w.random.choice([(f"jnp.sort({x.name})", x.kind), (f"jnp.argsort({x.name})", "int64")])
        w.let(text, kind, x.shape)


def _read(w: Writer) -> None:
    x = _rows(w)
    if x is None:
        return
    rest, draw = x.shape[1:], w.random
    many = w.find(lambda v: v.kind in INTEGERS and len(v.shape) == 1 and v.size <= 6)
    text, shape = draw.choice([
        (f"{x.name}[{w.index()}]", rest), (f"{x.name}.at[{w.index()}].get({draw.choice(READS)})", rest),
        (f"{x.name}.at[{w.index()}].get({draw.choice(READS)})", rest),
        (f"lax.dynamic_slice_in_dim({x.name}, {w.index()}, 1)", (1, *rest)),
        (f"jnp.take({x.name}, jnp.array([0, {w.place()}]), axis=0)", (2, *rest)),
        (f"jnp.take({x.name}, jnp.array([1, {w.place()}]), axis=0, mode=\"wrap\")", (2, *rest)),
    ])  # fmt: skip
    if many is not None and draw.random() < 0.5:
        text, shape = f"{x.name}.at[{many.name}].get({draw.choice(READS)})", (*many.shape, *rest)
    if len(shape) <= 2:
        w.let(text, x.kind, shape)


def _written(w: Writer) -> None:
    x = w.find(lambda v: v.shape != () and v.size > 0 and v.kind != "bool")
    if x is None:
        return
    draw, value = w.random, w.find(lambda v: v.shape == ()) or Variable("x9", "int32", ())
    entry = f"{value.name}.astype(jnp.{x.kind})" if value.kind != "float64" or x.kind == "float64" else w.number(x.kind)
    places = draw.choice([w.index(), f"jnp.array([{w.place()}, {draw.randint(-2, 3)}, 0])"])
    method = draw.choice(METHODS)
    if draw.random() < 0.2:
        w.let(f"lax.dynamic_update_slice_in_dim({x.name}, {x.name}[:1] * 2, {w.index()}, 0)", x.kind, x.shape, True)
    else:
        w.let(f"{x.name}.at[{places}].{method}({entry}, {draw.choice(WRITES)})", x.kind, x.shape, True)


def _moderate(x: Variable) -> str:
    """A factor of a product. Where sums overflow on their way, their order decides between an infinity and NaN."""
    return (
        f"jnp.where(jnp.isfinite({x.name}), jnp.clip({x.name}, -1e60, 1e60), {x.name})"
        if x.kind == "float64"
        else x.name
    )


def _products(w: Writer) -> None:
    x = w.find(lambda v: v.shape != () and v.size > 0)
    y = None if x is None else w.find(lambda v: v.kind == x.kind and v.shape[:1] == x.shape[-1:])
    if x is None:
        return
    if len(x.shape) == 2 and w.random.random() < 0.3:
        w.let(f"{_moderate(x)} @ {_moderate(x)}.T", x.kind, (x.shape[0], x.shape[0]), True)
    elif y is not None and x.kind != "bool":
        w.let(f"{_moderate(x)} @ {_moderate(y)}", x.kind, (*x.shape[:-1], *y.shape[1:]), True)
    elif len(x.shape) == 1 and x.size < 6 and x.kind != "bool":
        w.let(f"jnp.outer({x.name}, {x.name})", x.kind, (x.size, x.size), True)


def _solved(w: Writer) -> None:
    a = w.find(lambda v: v.kind == "float64" and len(v.shape) == 2 and v.shape[0] == v.shape[1] and 0 < v.size < 20)
    if a is None:
        return
    n = a.shape[0]
    # Of entries that are no finite numbers, and of singular systems, every library makes its own.
    w.let(f"jnp.clip(jnp.nan_to_num({a.name}), -1e3, 1e3)", "float64", (n, n))
    a = w.known[-1]
    definite = f"({a.name} @ {a.name}.T + {n} * jnp.eye({n}))"
    square = a.name if w.random.random() < 0.3 else definite
    regular = definite if w.random.random() < 0.5 else f"jnp.roll({definite}, 1, axis=0)"
    b = w.one("float64", (n,))
    right = f"jnp.arange({n}.0)" if b is None else b.name
    text, matrix, shape = w.random.choice([
        (f"jnp.linalg.solve({{}}, {right})", regular, (n,)), ("jnp.linalg.inv({})", regular, (n, n)),
        ("jnp.linalg.cholesky({})", square, (n, n)), ("jnp.linalg.det({})", square, ()),
        (f"jax.scipy.linalg.solve_triangular({{}}, {right}, lower=True)", square, (n,)),
        (f"jax.scipy.linalg.cho_solve((jnp.linalg.cholesky({{}}), True), {right})", square, (n,)),
    ])  # fmt: skip
    w.marks += 1
    w.let(text.format(f"rounded({matrix}, {w.marks})"), "float64", shape, True)


def _drawn(w: Writer) -> None:
    n = w.random.randint(1, 3)
    text, kind = w.random.choice([
        ("jax.random.normal", "float64"), ("jax.random.uniform", "float64"), ("jax.random.bits", "uint32"),
    ])  # fmt: skip
    more = ', "uint32"' if kind == "uint32" else ""
    w.let(f"{text}(jax.random.fold_in(jax.random.key({w.index()}), {n}), ({n},){more})", kind, (n,), True)


ARRAYS = (_moved, _moved, _reduced, _extremes, _sorted, _read, _read, _written, _written, _products, _solved, _drawn)
