"""Statements that hold others: loops of known and of data's length, branches, and functions of each row."""

from programs.arrays import ARRAYS
from programs.elementwise import ELEMENTWISE
from programs.writer import Program, Variable, Writer

DEEPEST = 2  # loops and branches within each other
LENGTHS = (0, 1, 2, 3, 5)
LONG = 300  # turns of a loop that is not written out


def _same_again(w: Writer, given: list[Variable]) -> str:
    """Write some statements, and return for each of the given variables one like it, made of what was computed."""
    before = len(w.known)
    for _ in range(w.random.randint(1, 4)):
        w.statement()
    made, results = w.known[before:], []
    for v in given:
        like = [x.name for x in made if (x.kind, x.shape) == (v.kind, v.shape)]
        if not like and made and v.kind == "bool":
            like = [f"{v.name} ^ jnp.any({made[-1].name} > 0)"]
        elif not like and made:
            like = [f"{v.name} + jnp.max({made[-1].name}, initial=0).astype(jnp.{v.kind})"]
            like = [f"rounded({like[0]}, 0)"] if v.kind == "float64" else like
        results.append(like[-1] if like and w.random.random() < 0.8 else (w.one(v.kind, v.shape) or v).name)
    return f"({', '.join(results)},)"


def _block(w: Writer, arguments: str, given: list[Variable]) -> str:
    """Write a function of variables that are given together, which returns as many; return its name."""
    name, known = w.name("f"), list(w.known)
    inner = [Variable(w.name(), v.kind, v.shape) for v in given]
    w.line(f"def {name}({arguments.format(carry='carry')}):")
    w.depth += 1
    w.line(f"{', '.join(v.name for v in inner)}, = carry")
    w.known += inner
    if "turn" in arguments:
        w.known.append(Variable("turn", "int64", ()))
    w.line(f"return {_same_again(w, inner)}")
    w.depth -= 1
    w.known = known
    return name


def _carried(w: Writer) -> list[Variable]:
    """What a loop carries: one to three variables."""
    found = [w.find(lambda v: v.size <= 12) for _ in range(w.random.randint(1, 3))]
    return list(dict.fromkeys(v for v in found if v is not None))


def _unpacked(w: Writer, text: str, given: list[Variable]) -> None:
    """Write what gives as many variables."""
    made = [Variable(w.name(), v.kind, v.shape) for v in given]
    w.line(f"{', '.join(v.name for v in made)}, = {text}")
    w.known += made


def _names(given: list[Variable]) -> str:
    return f"({', '.join(v.name for v in given)},)"


def _counted(w: Writer) -> None:
    given = _carried(w)
    if not given or w.depth >= DEEPEST:
        return
    body = _block(w, "turn, {carry}", given)
    turns = w.random.choice(LENGTHS)
    last = str(turns) if w.random.random() < 0.6 else f"jnp.clip(jnp.asarray({w.index()}), 0, 6).astype(jnp.int64)"
    if w.depth == 0 and w.random.random() < 0.1:
        last = str(LONG)
    w_first = "jnp.int64(0)" if "jnp" in last else "0"
    _unpacked(w, f"lax.fori_loop({w_first}, {last}, {body}, {_names(given)})", given)


def _scanned(w: Writer) -> None:
    given, rows = _carried(w), w.find(lambda v: len(v.shape) in (1, 2) and v.size <= 24)
    if not given or rows is None or w.depth >= DEEPEST:
        return
    name, known = w.name("f"), list(w.known)
    inner, row = [Variable(w.name(), v.kind, v.shape) for v in given], Variable(w.name(), rows.kind, rows.shape[1:])
    w.line(f"def {name}(carry, {row.name}):")
    w.depth += 1
    w.line(f"{', '.join(v.name for v in inner)}, = carry")
    w.known += [*inner, row]
    after = _same_again(w, inner)
    out = w.find(lambda v: len(v.shape) < 2) or row
    w.line(f"return {after}, {out.name}")
    w.depth -= 1
    w.known = known
    stacked, carry = Variable(w.name(), out.kind, (rows.shape[0], *out.shape)), w.name("c")
    back = w.random.choice(("", ", reverse=True"))
    w.line(f"{carry}, {stacked.name} = lax.scan({name}, {_names(given)}, {rows.name}{back})")
    _unpacked(w, carry, given)
    w.known.append(stacked)


def _while(w: Writer) -> None:
    given = _carried(w)
    numbers = [n for n, v in enumerate(given) if v.shape == ()]
    if not given or w.depth >= DEEPEST:
        return
    body, question, counted, carry = _block(w, "{carry}", given), w.name("f"), w.name("f"), w.name("c")
    goes_on = "turns[0] < 5"
    if numbers:
        v = given[numbers[0]]
        test = f"turns[1][{numbers[0]}]"
        goes_on += f" & {test}" if v.kind == "bool" else f" & ({test} < {w.partner(v)})"
    goes_on = goes_on.replace("turns[0] < 5", "(turns[0] < 5)")
    w.line(f"def {question}(turns):")
    w.line(f"    return {goes_on}")
    w.line(f"def {counted}(turns):")
    w.line(f"    return turns[0] + 1, {body}(turns[1])")
    w.line(f"_, {carry} = lax.while_loop({question}, {counted}, (0, {_names(given)}))")
    _unpacked(w, carry, given)


def _branched(w: Writer) -> None:
    given = _carried(w)
    if not given or w.depth >= DEEPEST:
        return
    count = w.random.randint(2, 3)
    branches = [_block(w, "{carry}", given) for _ in range(count)]
    if count == 2:
        _unpacked(w, f"lax.cond({w.truth()}, {', '.join(branches)}, {_names(given)})", given)
    else:
        _unpacked(w, f"lax.switch({w.index()}, [{', '.join(branches)}], {_names(given)})", given)


def _of_each_row(w: Writer) -> None:
    rows = w.find(lambda v: len(v.shape) == 2 and 0 < v.size <= 12)
    if rows is None or w.depth >= DEEPEST:
        return
    body = _block(w, "{carry}", [rows._replace(shape=rows.shape[1:])])
    _unpacked(w, f"jax.vmap({body})(({rows.name},))", [rows])


FLOW = (_counted, _scanned, _while, _branched, _branched, _of_each_row)


def program(seed: int) -> Program:
    """Return the program of a seed."""
    return Writer(seed, [*ELEMENTWISE * 3, *ARRAYS * 3, *FLOW * 3]).program()
