"""Text of the two files of an exported step: a header with explanations, and a source that computes."""

from collections.abc import Sequence
from typing import NamedTuple

import heliograph
from heliograph.disk.quoted_text import visible
from heliograph.export.c_functions import (
    declare_innovation,
    explain_separate_functions,
    generate_c_functions,
    list_signatures,
)
from heliograph.export.late_measurement_window import WindowText, generate_window_code
from heliograph.export.received_numbers import Received
from heliograph.export.single_precision_notes import explain_ranges, explain_rounding
from heliograph.export.step_program import CFunction, Real, StepProgram
from heliograph.export.struct_layout import lay_out_array, lay_out_struct
from heliograph.filters.base import AbstractFilter
from heliograph.model.estimate import Claim
from heliograph.model.over_time import first

MEANING: dict[Claim, str] = {
    "exact": "the covariance is E[(x - mean)(x - mean)']",
    "upper": "the covariance dominates E[(x - mean)(x - mean)']",
    "nominal": "the covariance is what the filter's approximations say, and nothing is proved",
    "none": "no covariance: NaN",
}
MADE = "Made by heliograph"  # by which a header that was exported is known again


class CTextOptions(NamedTuple):
    """Options of the text.

    Args:
        prefix: of all names.
        real: type of numbers.
        received: names of z's components, and which of their values are refused.
        kind: description of the filter and the precision.
        late: how many steps late a measurement may be; None of a step that takes none.
    """

    prefix: str
    real: Real
    received: Received
    kind: str
    late: int | None = None


class CText(NamedTuple):
    """Header and source; the number of each operation in a step; bytes of the state, or of the window around it."""

    header: str
    source: str
    operations: dict[str, int]
    state_bytes: int


def generate_header_and_source(program: StepProgram, form: CTextOptions) -> CText:
    """Return header and source of a step in C, with its counts of operations and bytes.

    A field of the state's struct is a C type, a name and a length; `lay_out_array` and `lay_out_struct` return size and
    alignment in bytes.

    Args:
        program: the filter's step, as functions of C, and the arrays of the state (`members`).
        form: the prefix of all names, the C type of numbers (`real`), the names of z's components, a description, and
            how many steps late a measurement may be (`late`; None for none).
    """
    fields = _list_state_fields(program)
    counter = [lay_out_array("int64_t", 1)] if program.counts else []  # the number of the step
    state_layout = lay_out_struct([*(lay_out_array(field.type, field.length) for field in fields), *counter])
    # What the files have for measurements that come late: nothing, unless these are taken.
    window = WindowText(comment=[], types="", heads=[], functions=[], size=state_layout.size)
    if form.late is not None:
        window = generate_window_code(program, form.late, state_layout, form.prefix, form.real)
    return CText(
        header=_generate_header(program, form, fields, window),
        source=_generate_source(program, form, window),
        operations=program.operations,
        state_bytes=window.size,
    )


class StateField(NamedTuple):
    """A member of the struct in which C holds a filter's state: an array of `length` numbers of a C type."""

    type: str
    name: str
    length: int


def _list_state_fields(program: StepProgram) -> list[StateField]:
    """Return the members of the state's struct but for the step counter, in order.

    A step returns the new value of the member "x" as its result "next_x", of the same type. C has no arrays of length
    0: an empty one has one number. `program`: the step as C functions, of which `computes` are those that compute, and
    `members` the arrays of the state.
    """
    results = program.computes[0].results  # of the whole step, or of the prediction
    types = {result.name.removeprefix("next_"): result.type for result in results}
    return [StateField(types[m.name], m.name, max(m.start.size, 1)) for m in program.members]


def _generate_source(program: StepProgram, form: CTextOptions, window: WindowText) -> str:
    """Return the text of the source: first the functions that only compute, then those that a device calls.

    Args:
        program: the filter's step, as functions of C.
        form: the prefix of all names, the C type of numbers, and a description of the filter.
        window: the functions for measurements that come late, if there are any.
    """
    prefix, real = form.prefix, form.real
    # Functions that make the first state, and the state of a given mean and covariance where a filter can have it.
    starts = [program.initial] if program.start_at is None else [program.initial, program.start_at]
    return _SOURCE.format(
        prefix=prefix,
        comment=f"{prefix}.c: one step of {form.kind}; {prefix}.h says how to use it.",
        functions="\n\n".join(_generate_static_function(code) for code in (*starts, *program.computes)),
        start=_generate_initial_state_statements(program),
        step="\n\n".join([*generate_c_functions(program, prefix, real), *window.functions]),
        mean=program.mean,
        covariance=program.covariance,
        real=real,
    )


def _generate_header(program: StepProgram, form: CTextOptions, fields: Sequence[StateField], window: WindowText) -> str:
    """Return the text of the header, which explains the functions and declares them and the state.

    Args:
        program: the filter's step, as functions of C.
        form: the prefix of all names, the C type of numbers, the names of z's components, and a description.
        fields: members of the state's struct, but for the step counter.
        window: the functions for measurements that come late, if there are any.
    """
    prefix, real = form.prefix, form.real
    members = [f"    {field.type} {field.name}[{field.length}];" for field in fields]
    heads = [*list_signatures(program, prefix, real), *window.heads]
    return _HEADER.format(
        prefix=prefix,
        guard=f"{prefix.upper()}_H",
        comment=_generate_header_comment(program, form, window),
        members="\n".join([*members, *_declare_counter(program)]),
        innovation=declare_innovation(program, prefix, real),
        window=window.types,
        functions="".join(f"{head};\n" for head in heads),
        real=real,
    )


def _generate_static_function(code: CFunction) -> str:
    """Return the text of a function of C as one that only its file knows ("static")."""
    definition: str = code.definition
    return definition.replace(f"void {code.name}(", f"static void {code.name}(", 1)


def _declare_counter(program: StepProgram) -> list[str]:
    """Return the line that declares the step counter in the state's struct; none where steps are not counted."""
    return ["    int64_t step;"] if program.counts else []


def _generate_initial_state_statements(program: StepProgram) -> str:
    """Return the C statements that set each member of `state` to its numbers before the first step."""
    members = ", ".join(f"state->{m.name}" for m in program.members)
    return f"    {program.initial.name}({members});" + ("\n    state->step = 0;" if program.counts else "")


def find_claim_at_precision(filter: AbstractFilter, real: Real) -> Claim:
    """Return the filter's claim; single precision proves nothing, since its rounding is not bounded."""
    return filter.claim if real == "double" or filter.claim == "none" else "nominal"


def _generate_header_comment(program: StepProgram, form: CTextOptions, window: WindowText) -> str:
    """Return the comment at the head of the header: how to call the functions, and what the arrays hold.

    Lines on functions of their own are there if the program has several parts. MADE marks a header that was exported,
    by which it may be overwritten later.

    Args:
        program: the filter's step, as functions of C.
        form: the prefix of all names, the C type of numbers (`real`), the names of z's components, and a description.
        window: the functions for measurements that come late, if there are any, with lines that explain them.
    """
    filter, prefix, claim = program.filter, form.prefix, find_claim_at_precision(program.filter, form.real)
    # Beside each measurement, the range of single precision; "" in double.
    ranges = explain_ranges(filter) if form.real == "float" else [""] * filter.received
    rounding = explain_rounding(filter, any(ranges)) if form.real == "float" else []
    lines = [
        f"{prefix}.h: one step of {form.kind}.",
        f"{MADE} {heliograph.__version__}; do not edit.",
        "",
        f"Call {prefix}_start once, then {prefix}_step at every step: it moves the estimate on with the inputs u and",
        "corrects it by the measurement z. A component of z that did not arrive is NaN; nothing may be infinite.",
        f"{prefix}_step returns 0, or refuses and leaves the state as it was: 1 a measurement is infinite, 2 an input",
        "is not finite, 3 the step is past the end of what varies over time, 4 the estimate would not be finite,",
        "5 the measurement or an input is so far from what was expected that the estimate would lose its digits,",
        "6 the inputs are none: dt is negative, beyond 2^53 units or the wrapped difference of unsigned counters of 32",
        "bits (of its unit, a thousandth or a millionth), or a function of the inputs returned no finite numbers, or",
        "no covariance.",
        *(explain_separate_functions(program, prefix) if len(program.parts) > 1 else []),
        *window.comment,
        "",
        *form.received.explain(ranges),
        *_explain_entries("u", filter.inputs, [""] * len(filter.inputs)),
        *_explain_entries("mean", filter.states, _explain_angles(filter)),
        f"covariance[{len(filter.states)} * i + j] is that of the errors of mean[i] and mean[j].",
        "All numbers are in the units in which the plant and the sensor were described.",
        *rounding,
        f"Claim: {claim}, {MEANING[claim]}.",
    ]
    if filter.horizon is not None:
        lines.append(f"Steps: {filter.horizon}, from 0 on.")
    # A name of the user's may hold the marks of a comment, which would end this one.
    return "\n".join(f" * {visible(line).replace('*/', '* /').replace('/*', '/ *')}".rstrip() for line in lines)


def _explain_angles(filter: AbstractFilter) -> list[str]:
    """Return a note for each state: the unit and range of an angle, a word on an attitude, and "" for others."""
    circular = first(filter.plant).circular if hasattr(filter, "plant") else ()
    notes = {filter.states.index(name): " (radians, from -pi to pi)" for name in circular}
    notes |= dict.fromkeys(filter.attitude, " (of a rotation vector, radians; its errors are turns in the body's axes)")
    return [notes.get(i, "") for i in range(len(filter.states))]


def _explain_entries(array: str, names: Sequence[str], notes: Sequence[str]) -> list[str]:
    """Return a line for each entry of an array, such as "z[0]: position", with its note, or "z: not used"."""
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

{innovation}{window}void {prefix}_start({prefix}_state *state);
{functions}const {real} *{prefix}_mean(const {prefix}_state *state);
const {real} *{prefix}_covariance(const {prefix}_state *state);

#ifdef __cplusplus
}}
#endif

#endif
"""

_SOURCE = """/* {comment} */
#include "{prefix}.h"

#include <math.h>
#include <stddef.h>

#ifdef __FAST_MATH__
#error "a missing component is NaN, which this mode of the compiler does not know"
#endif

{functions}

void {prefix}_start({prefix}_state *state)
{{
{start}
}}

{step}

const {real} *{prefix}_mean(const {prefix}_state *state)
{{
    return state->{mean};
}}

const {real} *{prefix}_covariance(const {prefix}_state *state)
{{
    return state->{covariance};
}}
"""
