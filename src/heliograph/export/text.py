"""Text of the two files of an exported step: a header with explanations, and a source that computes."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

import heliograph
from heliograph.disk.quoting import visible
from heliograph.export.program import StepProgram, no_c, place_of
from heliograph.filters.base import AbstractFilter
from heliograph.model.estimate import Claim
from heliograph.model.over_time import first
from straightline.c_source import CSource, Place, Real, c_type, literal
from straightline.nodes import Node, Type, Unsupported

MEANING: dict[Claim, str] = {
    "exact": "the covariance is E[(x - mean)(x - mean)']",
    "upper": "the covariance dominates E[(x - mean)(x - mean)']",
    "nominal": "the covariance is what the filter's approximations say, and nothing is proved",
    "none": "no covariance: NaN",
}


class Member(NamedTuple):
    """An array in the state of the step: its name, type, initial values, and the values after a step."""

    name: str
    type: Type
    start: Sequence[float]
    after: Sequence[Node]


class Form(NamedTuple):
    """Options of the text: the prefix of all names, the type of numbers, names of z's components, and a description."""

    prefix: str
    real: Real
    received: Sequence[str]
    kind: str


class CText(NamedTuple):
    """Header and source; the number of each operation in a step; bytes of the state."""

    header: str
    source: str
    operations: dict[str, int]
    state_bytes: int


def c_text(program: StepProgram, form: Form) -> CText:
    """Write a step as C.

    Raises:
        ValueError: an operation that C does not have, with its place; numbers beyond single precision.
    """
    prefix, real = form.prefix, form.real
    members, mean, covariance = _members(program)
    # Where inputs are read: members of the state, z, u, and the step counter.
    places = {leaf.buffer: _entry(f"state->{leaf.name}") for leaf in program.leaves}
    places |= {program.z: _entry("z"), program.u: _entry("u"), program.k: lambda index: "state->step"}
    roots = [node for member in members for node in member.after]
    source = CSource([*roots, *program.mean, program.implausible, program.spoilt], places, real, prefix)
    try:
        body = source.statements(program.graph.top)
    except Unsupported as error:
        raise no_c(error.operation, place_of(error.operation, program.equations)) from None
    # The step counter is part of the state only if something depends on it.
    counts = program.k in source.needed or program.filter.horizon is not None
    finish = _finish(members, program, source, counts)
    text = _SOURCE.format(
        prefix=prefix,
        comment=f"{prefix}.c: one step of {form.kind}; {prefix}.h says how to use it.",
        tables="".join(f"\n{table}\n" for table in source.table_definitions()),
        start="\n".join(_start(members, real, counts)),
        checks="\n".join(_checks(program, real)),
        body="\n".join([*source.declarations(), *body, *finish]),
        mean=mean,
        covariance=covariance,
        real=real,
    )
    # The header declares the state and explains the functions.
    header = _HEADER.format(
        prefix=prefix,
        guard=f"{prefix.upper()}_H",
        comment=_comment(program, form),
        members="\n".join(_fields(members, real, counts)),
        real=real,
    )
    return CText(header, text, source.operations, _size(members, real, counts))


def _entry(array: str) -> Place:
    return lambda index: f"{array}[{index}]"


def _members(program: StepProgram) -> tuple[list[Member], str, str]:
    """Return the arrays of the state, and the names of those that hold the estimate, which may be the filter's."""
    members = [Member(leaf.name, leaf.buffer.type, leaf.start.ravel().tolist(), leaf.after) for leaf in program.leaves]
    names = []
    for name, nodes, start in (
        ("estimate_mean", program.mean, program.start_mean),
        ("estimate_covariance", program.covariance, program.start_covariance),
    ):
        same = (m for m in members if list(m.after) == nodes and np.array_equal(m.start, start.ravel(), equal_nan=True))
        member = next(same, None)
        if member is None:
            member = Member(name, "f64", start.ravel().tolist(), nodes)
            members.append(member)
        names.append(member.name)
    return members, names[0], names[1]


def _stored(type: Type, real: Real) -> str:
    """Return the type in which a number is stored: a flag is a byte."""
    return "unsigned char" if type == "bool" else c_type(type, real)


def _fields(members: Sequence[Member], real: Real, counts: bool) -> list[str]:
    lines = [f"    {_stored(m.type, real)} {m.name}[{max(len(m.start), 1)}];" for m in members]
    return [*lines, "    int64_t step;"] if counts else lines


def _size(members: Sequence[Member], real: Real, counts: bool) -> int:
    """Return the bytes of the state, each number aligned to its own size."""
    sizes = {"f64": 8 if real == "double" else 4, "bool": 1, "i32": 4, "u32": 4, "i64": 8, "u64": 8}
    fields = [(sizes[m.type], max(len(m.start), 1)) for m in members] + ([(8, 1)] if counts else [])
    total = 0
    for size, count in fields:
        total = -(-total // size) * size + size * count
    largest = max(size for size, _ in fields)
    return -(-total // largest) * largest


def _start(members: Sequence[Member], real: Real, counts: bool) -> list[str]:
    lines = [
        f"    state->{m.name}[{i}] = {literal(value, m.type, real)};"
        for m in members
        for i, value in enumerate(m.start)
    ]
    return [*lines, "    state->step = 0;"] if counts else lines


def _checks(program: StepProgram, real: Real) -> list[str]:
    """Return the statements that refuse invalid inputs before the computation."""
    filter = program.filter
    lines = [] if filter.received else ["    (void)z;"]
    lines += [] if filter.inputs else ["    (void)u;"]
    lines += [f"    if (isinf(z[{i}])) return 1;" for i in range(filter.received)]
    lines += [f"    if (!isfinite(u[{i}])) return 2;" for i in range(len(filter.inputs))]
    return [*lines, f"    if (state->step >= {filter.horizon}) return 3;"] if filter.horizon is not None else lines


def _finish(members: Sequence[Member], program: StepProgram, source: CSource, counts: bool) -> list[str]:
    """Return the statements that refuse an implausible step, and then write all that changed."""
    known = [node for node in program.mean if node.op != "constant"]
    lines = []
    if program.spoilt.op != "constant":
        lines.append(f"    if ({source.name(program.spoilt)}) return 6;")
    lines += [f"    if (!isfinite({source.name(node)})) return 4;" for node in dict.fromkeys(known)]
    if program.implausible.op != "constant":
        lines.append(f"    if ({source.name(program.implausible)}) return 5;")
    for member in members:
        for i, node in enumerate(member.after):
            lines.append(f"    state->{member.name}[{i}] = {source.name(node)};")
    return [*lines, "    state->step += 1;"] if counts else lines


def claim_of(filter: AbstractFilter, real: Real) -> Claim:
    """Return the filter's claim; single precision proves nothing, since its rounding is not bounded."""
    return filter.claim if real == "double" or filter.claim == "none" else "nominal"


def _comment(program: StepProgram, form: Form) -> str:
    """Return the explanation for a reader of the header."""
    filter, prefix, claim = program.filter, form.prefix, claim_of(program.filter, form.real)
    # States that are angles say so.
    circular = first(filter.plant).circular if hasattr(filter, "plant") else ()
    units = [" (radians, from -pi to pi)" if name in circular else "" for name in filter.states]
    lines = [
        f"{prefix}.h: one step of {form.kind}.",
        f"Made by heliograph {heliograph.__version__}; do not edit.",
        "",
        f"Call {prefix}_start once, then {prefix}_step at every step: it moves the estimate on with the inputs u and",
        "corrects it by the measurement z. A component of z that did not arrive is NaN; nothing may be infinite.",
        f"{prefix}_step returns 0, or refuses and leaves the state as it was: 1 a measurement is infinite, 2 an input",
        "is not finite, 3 the step is past the end of what varies over time, 4 the estimate would not be finite,",
        "5 the measurement or an input is so far from what was expected that the estimate would lose its digits,",
        "6 the inputs are none: dt is negative, beyond 2^53 units or the wrapped difference of unsigned counters of 32",
        "bits, or a function of the inputs returned no finite numbers, or no covariance.",
        "",
        *_numbered("z", form.received, [""] * len(form.received)),
        *_numbered("u", filter.inputs, [""] * len(filter.inputs)),
        *_numbered("mean", filter.states, units),
        f"covariance[{len(filter.states)} * i + j] is that of the errors of mean[i] and mean[j].",
        "All numbers are in the units in which the plant and the sensor were described.",
        f"Claim: {claim}, {MEANING[claim]}.",
    ]
    if filter.horizon is not None:
        lines.append(f"Steps: {filter.horizon}, from 0 on.")
    return "\n".join(f" * {visible(line).replace('*/', '* /').replace('/*', '/ *')}".rstrip() for line in lines)


def _numbered(array: str, names: Sequence[str], notes: Sequence[str]) -> list[str]:
    if not names:
        return [f"{array}: not used"]
    return [f"{array}[{i}]: {name}{note}" for i, (name, note) in enumerate(zip(names, notes, strict=True))]


_HEADER = """/*
{comment}
 */
#ifndef {guard}
#define {guard}

#include <stdint.h>

#ifdef __cplusplus
extern "C" {{
#endif

typedef struct {{
{members}
}} {prefix}_state;

void {prefix}_start({prefix}_state *state);
int {prefix}_step({prefix}_state *state, const {real} z[], const {real} u[]);
const {real} *{prefix}_mean(const {prefix}_state *state);
const {real} *{prefix}_covariance(const {prefix}_state *state);

#ifdef __cplusplus
}}
#endif

#endif
"""

_SOURCE = """/* {comment} */
#include "{prefix}.h"

#include <math.h>

#ifdef __FAST_MATH__
#error "a missing component is NaN, which this mode of the compiler does not know"
#endif
{tables}
void {prefix}_start({prefix}_state *state)
{{
{start}
}}

int {prefix}_step({prefix}_state *state, const {real} z[], const {real} u[])
{{
{checks}
{body}
    return 0;
}}

const {real} *{prefix}_mean(const {prefix}_state *state)
{{
    return state->{mean};
}}

const {real} *{prefix}_covariance(const {prefix}_state *state)
{{
    return state->{covariance};
}}
"""
