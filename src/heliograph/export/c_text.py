"""Text of the two files of an exported step: a header with explanations, and a source that computes."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import heliograph
from heliograph.disk.quoted_text import visible
from heliograph.export.c_functions import (
    declare_innovation,
    explain_separate_functions,
    generate_c_functions,
    list_signatures,
)
from heliograph.export.late_measurement_window import WindowText, generate_window_code
from heliograph.export.single_precision_notes import explain_ranges, explain_rounding
from heliograph.export.step_program import Real, StepProgram
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
        received: names of z's components.
        kind: description of the filter and the precision.
        late: how many steps late a measurement may be; None of a step that takes none.
    """

    prefix: str
    real: Real
    received: Sequence[str]
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

    Args:
        program: the filter's step, as functions of C, and the arrays of the state (`members`).
        form: the prefix of all names, the C type of numbers (`real`), the names of z's components, a description, and
            how many steps late a measurement may be (`late`; None for none).
    """
    prefix, real = form.prefix, form.real
    # The struct of the state: (C type, name, count of numbers) of each member, then the step's number. The type of a
    # member is that of the result "next_<member>" of a step. C has no arrays of length 0: an empty one has one number.
    types = {x.name.removeprefix("next_"): x.type for x in program.computes[0].results}
    fields = [(types[m.name], m.name, max(m.start.size, 1)) for m in program.members]
    counter = [lay_out_array("int64_t", 1)] if program.counts else []
    state_layout = lay_out_struct([*(lay_out_array(kind, count) for kind, _, count in fields), *counter])
    window = None if form.late is None else generate_window_code(program, form.late, state_layout, prefix, real)
    # The source has the functions that compute, then those that a device calls.
    starts = [program.initial] if program.start_at is None else [program.initial, program.start_at]
    source = _SOURCE.format(
        prefix=prefix,
        comment=f"{prefix}.c: one step of {form.kind}; {prefix}.h says how to use it.",
        functions="\n\n".join(_generate_static_function(code) for code in (*starts, *program.computes)),
        start=_generate_initial_state_statements(program),
        step="\n\n".join([*generate_c_functions(program, prefix, real), *([] if window is None else window.functions)]),
        mean=program.mean,
        covariance=program.covariance,
        real=real,
    )
    # The header declares the state and explains the functions.
    heads = [*list_signatures(program, prefix, real), *([] if window is None else window.heads)]
    header = _HEADER.format(
        prefix=prefix,
        guard=f"{prefix.upper()}_H",
        comment=_generate_header_comment(program, form, window),
        members="\n".join([f"    {kind} {name}[{count}];" for kind, name, count in fields] + _declare_counter(program)),
        innovation=declare_innovation(program, prefix, real),
        window="" if window is None else window.types,
        functions="".join(f"{head};\n" for head in heads),
        real=real,
    )
    return CText(
        header=header,
        source=source,
        operations=program.operations,
        state_bytes=state_layout.size if window is None else window.size,
    )


def _generate_static_function(code: Any) -> str:
    """Return the text of a function that only this file knows."""
    text: str = code.definition
    return text.replace(f"void {code.name}(", f"static void {code.name}(", 1)


def _declare_counter(program: StepProgram) -> list[str]:
    """Return the line that declares the step counter in the state; none where steps are not counted."""
    return ["    int64_t step;"] if program.counts else []


def _generate_initial_state_statements(program: StepProgram) -> str:
    """Return the statements that set the state before the first step."""
    members = ", ".join(f"state->{m.name}" for m in program.members)
    return f"    {program.initial.name}({members});" + ("\n    state->step = 0;" if program.counts else "")


def find_claim_at_precision(filter: AbstractFilter, real: Real) -> Claim:
    """Return the filter's claim; single precision proves nothing, since its rounding is not bounded."""
    return filter.claim if real == "double" or filter.claim == "none" else "nominal"


def _generate_header_comment(program: StepProgram, form: CTextOptions, window: WindowText | None) -> str:
    """Return the comment at the head of the header: how to call the functions, and what the arrays hold.

    Args:
        program: the filter's step, as functions of C.
        form: the prefix of all names, the C type of numbers (`real`), the names of z's components, and a description.
        window: the functions for measurements that come late; None where there are none.
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
        *([] if window is None else window.comment),
        "",
        *_explain_entries("z", form.received, ranges),
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
