"""Statements of arithmetic, entry by entry: real numbers, integers, truths, comparisons, casts and choices."""

from programs.writer import COMPARISONS, INTEGERS, KINDS, Writer

SMOOTH = (
    "jnp.sqrt", "jnp.exp", "jnp.log", "jnp.sin", "jnp.cos", "jnp.tan", "jnp.tanh", "jnp.arctan", "jnp.log1p",
    "jnp.expm1", "jnp.square", "jnp.cbrt", "jax.nn.sigmoid", "lax.rsqrt", "jnp.reciprocal", "jnp.arcsin",
    "jax.scipy.special.erf",
)  # fmt: skip
PLAIN = ("-", "jnp.abs", "jnp.floor", "jnp.ceil", "jnp.round", "jnp.sign", "jnp.trunc", "jax.nn.relu", "jnp.nan_to_num")
ARITHMETIC = ("{} + {}", "{} - {}", "{} * {}", "{} / {}", "jnp.arctan2({}, {})", "jnp.hypot({}, {})")
WITH_SIGNS = (
    "jnp.minimum({}, {})",
    "jnp.maximum({}, {})",
    "jnp.copysign({}, jnp.nan_to_num({}))",
    "lax.rem({}, {})",
    "jnp.mod({}, {})",
)
QUESTIONS = ("jnp.isnan({})", "jnp.isfinite({})", "jnp.signbit(jnp.nan_to_num({}))", "jnp.isinf({})")  # NaN has no sign
OF_INTEGERS = (
    "{} + {}", "{} - {}", "{} * {}", "{} // {}", "{} % {}", "{} & {}", "{} | {}", "{} ^ {}", "{} << {}", "{} >> {}",
    "lax.div({}, {})", "lax.rem({}, {})", "jnp.minimum({}, {})", "jnp.maximum({}, {})",
    "lax.shift_right_logical({}, {})",
)  # fmt: skip
OF_ONE_INTEGER = ("-", "~", "jnp.abs", "jnp.sign", "jnp.square")
OF_TRUTHS = ("{} & {}", "{} | {}", "{} ^ {}", "jnp.logical_and({}, ~{})")


def _smooth(w: Writer) -> None:
    if x := w.one("float64"):
        w.let(f"{w.random.choice(SMOOTH)}({x.name})", "float64", x.shape, True)


def _plain(w: Writer) -> None:
    if x := w.one("float64"):
        w.let(f"{w.random.choice(PLAIN)}({x.name})", "float64", x.shape)


def _arithmetic(w: Writer) -> None:
    if x := w.one("float64"):
        rounds = w.random.random() < 0.75
        form, pair = w.random.choice(ARITHMETIC if rounds else WITH_SIGNS), [x.name, w.partner(x)]
        w.random.shuffle(pair)
        if "lax" in form:
            form = form.replace("{}, {}", "*jnp.broadcast_arrays({}, {})")
        w.let(form.format(*pair), "float64", x.shape, rounds)


def _powers(w: Writer) -> None:
    if x := w.one("float64"):
        form = w.random.choice(
            (f"{x.name} ** {w.random.randint(-3, 5)}", f"jnp.power(jnp.abs({x.name}), {w.partner(x)})")
        )
        w.let(form, "float64", x.shape, True)


def _integers(w: Writer) -> None:
    if x := w.one(w.random.choice(INTEGERS)):
        if w.random.random() < 0.25:
            w.let(f"{w.random.choice(OF_ONE_INTEGER)}({x.name})", x.kind, x.shape)
            return
        form, other = w.random.choice(OF_INTEGERS), w.partner(x)
        if "lax" in form:
            form = form.replace("{}, {}", "*jnp.broadcast_arrays({}, {})")
        w.let(form.format(x.name, other), x.kind, x.shape)


def _truths(w: Writer) -> None:
    if x := w.one("bool"):
        w.let(w.random.choice(OF_TRUTHS).format(x.name, w.partner(x)), "bool", x.shape)


def _comparison(w: Writer) -> None:
    if x := w.find(lambda v: v.kind != "bool"):
        w.let(f"{x.name} {w.random.choice(COMPARISONS)} {w.partner(x)}", "bool", x.shape)


def _cast(w: Writer) -> None:
    if x := w.find(lambda v: True):
        kind = w.random.choice(KINDS)
        w.let(f"{x.name}.astype(jnp.{kind})", kind, x.shape)


def _question(w: Writer) -> None:
    if x := w.one("float64"):
        w.let(w.random.choice(QUESTIONS).format(x.name), "bool", x.shape)


def _choice(w: Writer) -> None:
    x = w.find(lambda v: True)
    if x is None:
        return
    condition = w.one("bool", x.shape)
    of = w.truth() if condition is None else condition.name
    if w.random.random() < 0.6:
        w.let(f"jnp.where({of}, {x.name}, {w.partner(x)})", x.kind, x.shape)
    elif w.random.random() < 0.5 and x.kind != "bool":
        w.let(f"jnp.clip({x.name}, {w.partner(x)}, {w.partner(x)})", x.kind, x.shape)
    else:
        cases = ", ".join(f"jnp.broadcast_to({w.partner(x)}, {x.name}.shape)" for _ in range(2))
        which = f"(jnp.asarray({w.index()}) % 3).astype(jnp.int32)"
        w.let(f"lax.select_n({which}, {x.name}, {cases})", x.kind, x.shape)


ELEMENTWISE = (
    _smooth, _plain, _arithmetic, _arithmetic, _powers, _integers, _integers, _truths, _comparison, _cast, _question,
    _choice,
)  # fmt: skip
