"""Text of the functions of an exported step: whole, or its prediction, its correction and a start apart."""

from heliograph.export.step_parts import PartOfStep
from heliograph.export.step_program import CFunction, Real, StepProgram


def list_signatures(program: StepProgram, prefix: str, real: Real) -> list[str]:
    """Return the heads of the C functions that move the state: the step, and before it its parts if there are any.

    The parts are prediction and correction. If `program.start_at` is not None, a function makes the state from a given
    mean and covariance. `prefix`: with which all names begin. `real`: type of the numbers in C.
    """
    state = f"{prefix}_state *state"
    step = f"int {prefix}_step({state}, const {real} z[], const {real} u[])"
    if len(program.parts) == 1:
        return [step]
    start = f"int {prefix}_start_at({state}, const {real} mean[], const {real} covariance[])"
    predict = f"int {prefix}_predict({state}, const {real} u[])"
    correct = f"int {prefix}_correct({state}, const {real} z[], {prefix}_innovation *innovation)"
    if program.start_at is None:
        return [predict, correct, step]
    return [start, predict, correct, step]


def declare_innovation(program: StepProgram, prefix: str, real: Real) -> str:
    """Return the C declaration of the innovation that a correction tells, or "" if the program has only whole steps.

    It holds the innovation's value, any weights, nis (its square over its covariance), and how many components arrived.
    `prefix`: with which all names begin. `real`: type of the numbers in C.
    """
    if len(program.parts) == 1:
        return ""
    count = max(program.filter.received, 1)
    weight = f"    {real} weight[{count}];\n" if "weight" in program.parts[1].other_results else ""
    return (
        f"typedef struct {{\n    {real} value[{count}];\n{weight}    {real} nis;\n    {real} arrived;\n"
        f"}} {prefix}_innovation;\n\n"
    )


def explain_separate_functions(program: StepProgram, prefix: str) -> list[str]:
    """Return lines for the header's comment on prediction, correction and a start as functions of their own.

    `program`: the step as C functions; `start_at` is None where the state cannot be set. `prefix`: with which all names
    begin.
    """
    lines = [
        "",
        f"{prefix}_step is {prefix}_predict and {prefix}_correct, which may be called apart: predict at each step of",
        "time, and then correct as often as measurements come, each with the components of z that are new and NaN for",
        "all others. Noises of components that come in different calls are taken to be independent.",
        f"{prefix}_correct tells in *innovation, unless that is a null pointer, z - E[z] (NaN: did not arrive), and",
        "its squared size nis in units of its covariance (NaN: nothing arrived), chi-squared of so many degrees of",
        "freedom as components arrived; also of a measurement that it refuses.",
    ]
    if "weight" in program.parts[1].other_results:
        lines.append("weight is how much of each component was used: 1 all, 0 left out.")
    if program.start_at is not None:
        lines += [
            f"{prefix}_start_at starts from another mean and covariance, row by row, in place of {prefix}_start; it",
            "returns 0, or refuses by 7 what is no finite mean or no covariance.",
        ]
    return lines


def generate_c_functions(program: StepProgram, prefix: str, real: Real) -> list[str]:
    """Return the text of the functions of C that move the state, in the order of `list_signatures`.

    A program whose step is one part gives `step` alone. A program in two parts gives `start_at` (if the state can be
    set), `predict`, `correct`, and `step`, which calls the two. Each function of C returns 0, or the number of a reason
    to refuse its arguments, and writes the state only if it refuses nothing.

    A part is the whole step, or prediction and correction (numbers 0 and 1). `_join_function` puts a head and the lines
    of its body together.

    Args:
        program: the filter's step, translated to statements of C, with the members of its state.
        prefix: with which all names in C begin.
        real: type of the numbers in C.
    """
    heads = list_signatures(program, prefix, real)
    if len(program.parts) == 1:
        body = [
            *_generate_measurement_check(program),
            *_generate_inputs_check(program),
            *_generate_part_statements(program, 0, prefix),
            "    return 0;",
        ]
        return [_join_function(heads[0], body)]
    predict = [*_generate_inputs_check(program), *_generate_part_statements(program, 0, prefix), "    return 0;"]
    correct = [*_generate_measurement_check(program), *_generate_part_statements(program, 1, prefix), "    return 0;"]
    # `step` works on a copy of the state, so that the state stays as it was if anything is refused.
    step = [
        f"    {prefix}_state after = *state;",
        f"    int refused = {prefix}_predict(&after, u);",
        "    if (refused != 0) { return refused; }",
        f"    refused = {prefix}_correct(&after, z, NULL);",
        "    if (refused != 0) { return refused; }",
        "    *state = after;",
        "    return 0;",
    ]
    start = [] if program.start_at is None else [_generate_start_statements(program, program.start_at, prefix)]
    return [_join_function(head, body) for head, body in zip(heads, [*start, predict, correct, step], strict=True)]


def _join_function(head: str, body: list[str]) -> str:
    """Return the text of a C function from its head and the lines of its body."""
    return "\n".join([head, "{", *body, "}"])


def _generate_measurement_check(program: StepProgram) -> list[str]:
    """Return the C statements that refuse a measurement with an infinite component: they return 1."""
    return [f"    if (isinf(z[{i}]) != 0) {{ return 1; }}" for i in range(program.filter.received)]


def _generate_inputs_check(program: StepProgram) -> list[str]:
    """Return the C statements that refuse inputs that are not finite (they return 2), and a step past the end (3).

    `program.filter.horizon`: steps of a model that varies over time, None for any other.
    """
    lines = [f"    if (!isfinite(u[{i}])) {{ return 2; }}" for i in range(len(program.filter.inputs))]
    if program.filter.horizon is not None:
        lines.append(f"    if (state->step >= {program.filter.horizon}) {{ return 3; }}")
    return lines


def _generate_part_statements(program: StepProgram, number: int, prefix: str) -> list[str]:
    """Return the C statements of one part of a step: compute it, refuse a bad result, and then write the state.

    All is computed into `after`, a struct like the state, so that a refusal changes nothing. A refusal returns its
    code: 4 the estimate would not be finite, 5 it would lose its digits, 6 the inputs are none.

    `program.read` are the members of the state that a part reads, with their numbers before the first step (`start`),
    `program.members` those that it writes. `program.mean` names the member with the estimate's mean, and
    `program.counts` says whether the state counts its steps.

    Args:
        program: the step as C functions; `other_results` of a part names results other than the state, such as the
            flags "implausible" (code 5) and "spoilt" (code 6).
        number: 0 for the whole step or the prediction, 1 for the correction.
        prefix: beginning of all C names.
    """
    part, code = program.parts[number], program.computes[number]
    is_correction = part.name == "correct"
    flags = [name for name in part.other_results if name in ("implausible", "spoilt")]
    declarations = [
        f"    {prefix}_state after;",
        *([f"    {prefix}_innovation news;"] if is_correction else []),
        *(f"    unsigned char {name}[1];" for name in flags),
    ]
    # The call: a number without axes is passed by value (as [0] of its member), all else as an array.
    read = [f"state->{m.name}" + ("" if m.start.ndim else "[0]") for m in program.read]
    written = [
        *(f"after.{m.name}" for m in program.members),
        *(_name_place_of_result(name) for name in part.other_results),
    ]
    arguments = [*read, *part.data, _generate_step_number_expression(program, part), *written]
    call = f"    {code.name}(\n        " + ",\n        ".join(arguments) + ");"
    checks = [
        *(["    if (spoilt[0] != 0U) { return 6; }"] if "spoilt" in flags else []),
        f"    for (int i = 0; i < {len(program.filter.states)}; ++i) {{",
        f"        if (!isfinite(after.{program.mean}[i])) {{ return 4; }}",
        "    }",
        "    if (implausible[0] != 0U) { return 5; }",
    ]
    # A prediction or a whole step begins the next step; a correction belongs to the step that was predicted.
    step = "state->step" if is_correction else "state->step + 1"
    return [
        *declarations,
        call,
        *(["    if (innovation != NULL) { *innovation = news; }"] if is_correction else []),
        *checks,
        *([f"    after.step = {step};"] if program.counts else []),
        "    *state = after;",
    ]


def _name_place_of_result(name: str) -> str:
    """Return the C expression for where a result beside the state is written.

    Flags are local variables. All other results are members of `news`, the innovation that the function tells. Single
    numbers are passed by their address, and arrays as they are.
    """
    if name in ("implausible", "spoilt"):
        return name
    return f"&news.{name}" if name in ("nis", "arrived") else f"news.{name}"


def _generate_step_number_expression(program: StepProgram, part: PartOfStep) -> str:
    """Return the C expression for the number of the step that a part belongs to.

    A prediction raises the state's count, so that the correction after it belongs to one less. If all steps of the
    filter are alike, the state has no count, and the number is 0. `program`: the step as C functions. `part`: the whole
    step, the prediction or the correction.
    """
    if not program.counts:
        return "0"
    if part.name == "correct":
        return "state->step > 0 ? state->step - 1 : 0"
    return "state->step"


def _generate_start_statements(program: StepProgram, start: CFunction, prefix: str) -> list[str]:
    """Return the C statements of a function that starts a filter from a given mean and covariance.

    It returns 0, or the error code 7 if mean or covariance are invalid: `start`, the C function that makes the state,
    then sets the flag `none` to 1. The new state `after` is copied to the caller's `*state` only if it is valid.
    `program.members`: the members of the state. `prefix`: with which all names begin.
    """
    members = ", ".join(f"after.{member.name}" for member in program.members)
    return [
        f"    {prefix}_state after;",
        "    unsigned char none[1];",
        f"    {start.name}(mean, covariance, {members}, none);",
        "    if (none[0] != 0U) { return 7; }",
        *(["    after.step = 0;"] if program.counts else []),
        "    *state = after;",
        "    return 0;",
    ]
