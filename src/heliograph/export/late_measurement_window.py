"""Text of the functions of an exported filter that takes late measurements: rows held, and run again from a late one.

Held is of each row the state before it, its measurement and its inputs. A measurement of the past is filled into its
row; where the plant's input is a time step, a row is made for it, and that of the row after it becomes the rest. What
was held is run again from there, as in order. Where a row is refused, what was filled in is taken out and the rows
are run again as before, so that all is as it was, to the last bit.
"""

import warnings
from typing import NamedTuple

import numpy as np

from heliograph.export.step_program import Real, StepProgram
from heliograph.export.struct_layout import StructLayout, lay_out_array, lay_out_struct
from heliograph.filters.base import AbstractFilter
from heliograph.model.checks.split_intervals import explain_uneven_prediction, find_indivisible_part
from heliograph.model.over_time import first
from heliograph.model.plant import TIME_STEP
from heliograph.numerics.check import check_count, fail

DIGITS = {"double": float(np.finfo(np.float64).eps), "float": float(np.finfo(np.float32).eps)}


class LateMeasurementWindow(NamedTuple):
    """Sizes of the memory in which exported C code holds its newest steps, for measurements that come late.

    A row is a step: the state before it, its measurement and its inputs.

    Args:
        steps: how many rows before the newest one a measurement may be late.
        time: index of the time step among the inputs; None where time counts steps.
        received: numbers of a measurement.
        inputs: numbers of an input.
    """

    steps: int
    time: int | None
    received: int
    inputs: int

    @property
    def rows(self) -> int:
        """Return how many rows are held."""
        return self.steps + 1

    @property
    def capacity(self) -> int:
        """Return for how many rows (steps) there must be memory.

        In continuous time a late measurement adds a row between others before the oldest row is dropped: one more.
        """
        return self.rows + (self.time is not None)


def check_and_count_window_steps(filter: AbstractFilter, steps: object) -> int:
    """Return how many steps late a measurement may be, checked.

    In continuous time a late measurement splits the interval between two steps. So nothing of the model may count
    steps, and the prediction over an interval should be that over its two parts: warn if it is not. `filter.assumed`
    are plant, sensor, channel and trigger that the filter takes for true, None if it names none;
    `find_indivisible_part` names a part that counts steps, and `explain_uneven_prediction` says why a prediction over
    an interval differs from that over its parts. Both return nothing where all is well. TIME_STEP is the input "dt",
    which only a plant in continuous time has.

    Raises:
        ValueError: no positive whole number; a filter in continuous time with a part of its model that counts steps.
    """
    count = check_count("window", steps)
    if TIME_STEP not in filter.inputs:
        return count
    expected = f"no part that goes by steps where the plant's time does not (its input {TIME_STEP!r})"
    if filter.horizon is not None:
        raise fail("window", expected, f"one that covers {filter.horizon} steps")
    assumed = filter.assumed
    if assumed is not None:
        if what := find_indivisible_part(assumed.plant, assumed.sensor, assumed.channel, assumed.trigger):
            raise fail("window", expected, what)
        if what := explain_uneven_prediction(first(assumed.plant), filter.inputs.index(TIME_STEP)):
            warnings.warn(f"window: predictions depend on what comes late: {what}", stacklevel=4)
    return count


class WindowText(NamedTuple):
    """What late measurements add to the C files: lines of the comment, types, heads and functions.

    `size` is how many bytes a device holds: of the window, or of the state alone where there is no window.
    """

    comment: list[str]
    types: str
    heads: list[str]
    functions: list[str]
    size: int


def generate_window_code(program: StepProgram, steps: int, state: StructLayout, prefix: str, real: Real) -> WindowText:
    """Return the C text of a window: memory of the newest steps, so that a late measurement is filtered in its place.

    A row of the window is a step: the state before it, its measurement and its inputs. A late measurement is put into
    the row of its time, and the filter is run again from that row on. How late it is, is given as a number of steps;
    or if the time step is an input of the plant (TIME_STEP, "dt"), as an age, and then a row may be added for it.

    Args:
        program: the filter's step, as functions of C.
        steps: how many rows before the newest one a measurement may be late.
        state: size and alignment in bytes of the filter's state.
        prefix: beginning of all C names.
        real: C type of the numbers.
    """
    filter = program.filter
    inputs, received = filter.inputs, filter.received
    index_of_time = inputs.index(TIME_STEP) if TIME_STEP in inputs else None
    window = LateMeasurementWindow(steps=steps, time=index_of_time, received=received, inputs=len(inputs))
    # Bytes of the structs that `_declare_window` writes. A row: a state, a measurement and inputs; C has no arrays of
    # length 0, so that none is one number.
    data = [lay_out_array(real, max(count, 1)) for count in (received, len(inputs))]
    row = lay_out_struct([state, *data])
    # The window: the present state, the rows, and four counters: the place of the oldest row, the number of rows, and
    # how many measurements were refused as too late (`late`) or as there already (`held`).
    rows = StructLayout(window.capacity * row.size, row.alignment)
    counters = [lay_out_array("uint32_t", 1)] * 4
    whole = lay_out_struct([state, rows, *counters])
    return WindowText(
        comment=_explain_window(window, prefix, whole.size),
        types=_declare_window(window, prefix, real),
        heads=_list_function_heads(window, prefix, real),
        functions=_generate_window_functions(window, prefix, real),
        size=whole.size,
    )


def _list_function_heads(window: LateMeasurementWindow, prefix: str, real: Real) -> list[str]:
    """Return the heads of the window's C functions: its start, a step, and a late measurement (by steps or age).

    `window.time`: index of the time step among the inputs, None where time counts steps. `prefix`: with which all names
    begin.
    """
    pointer = f"{prefix}_window *window"
    how_late = "uint32_t steps" if window.time is None else f"{real} age"
    return [
        f"void {prefix}_window_start({pointer})",
        f"int {prefix}_window_step({pointer}, const {real} z[], const {real} u[])",
        f"int {prefix}_window_late({pointer}, {how_late}, const {real} z[])",
    ]


def _declare_window(window: LateMeasurementWindow, prefix: str, real: Real) -> str:
    """Return the C declarations of two structs: a row (one step), and the window of all rows with its counters.

    `prefix`: with which all names begin. `real`: C type of the numbers.
    """
    received, inputs = max(window.received, 1), max(window.inputs, 1)
    return f"""typedef struct {{
    {prefix}_state before;
    {real} z[{received}];
    {real} u[{inputs}];
}} {prefix}_row;

typedef struct {{
    {prefix}_state now;
    {prefix}_row rows[{window.capacity}];
    uint32_t first;
    uint32_t count;
    uint32_t late;
    uint32_t held;
}} {prefix}_window;

"""


def _explain_window(window: LateMeasurementWindow, prefix: str, bytes_held: int) -> list[str]:
    """Return lines for the header on the window: what a late measurement is, what it costs, what is refused.

    The window is memory of the exported C code: the last steps of the filter, with their states, data and inputs, one
    row each. A late measurement is put into its row, and all rows from there on are run again, at most all that there
    is memory for. If one of them is refused they are run once more without it, hence twice the time.

    Args:
        window: how many rows it holds, and whether time counts steps or is an input.
        prefix: with which all names in C begin.
        bytes_held: size of the window in C, in bytes.
    """
    late = f"{prefix}_window_late"
    # How late: in steps, or as an age where the time step is an input.
    if window.time is None:
        when = [
            f"{late} takes a measurement of an earlier step: of the newest one where `steps`",
            f"is 0, of the one before where it is 1, up to {window.steps}. What z has is filled into that step, and",
        ]
        refused_ages = ""
    else:
        when = [
            f"{late} takes a measurement of a time `age` before the newest step, in the unit of",
            f"{TIME_STEP}. A step of that time, to rounding, is filled; else one is made, with the inputs that led to",
            f"the one after it, whose {TIME_STEP} is divided. At most {window.rows} are held, also of those made, and",
        ]
        refused_ages = "by 6 an age that is negative or not finite; "
    return [
        "",
        f"Measurements that come late: call {prefix}_window_start and {prefix}_window_step in place of {prefix}_start",
        f"and {prefix}_step; the estimate is that of the state `now`, as {prefix}_mean(&window.now).",
        *when,
        "all from it on are run again: the estimate is that of measurements in order, to rounding. Refused is, and",
        "leaves the estimate as it was, by 8 what is before all that is held, counted in `late`; by 9 a component that",
        f"is there already, counted in `held`; {refused_ages}and, by the code of {prefix}_step, one",
        "that would have its own step refused, or one after it.",
        f"sizeof({prefix}_window) is {bytes_held:,}. {prefix}_window_step takes the time of one step,",
        f"{late} that of at most {window.capacity}, or {2 * window.capacity} where a step is refused.",
    ]


def _generate_window_functions(window: LateMeasurementWindow, prefix: str, real: Real) -> list[str]:
    """Return the text of the window's C functions, made from the templates below.

    The names that the templates leave open are the prefix p of all names in C, counts of rows, and statements that
    depend on the lengths of measurement and inputs. DIGITS: relative rounding of the type `real`, to which times are
    compared.
    """
    received, inputs = window.received, window.inputs
    missing = " && ".join(f"(isnan(z[{i}]) != 0)" for i in range(received)) or "1"
    nothing = f"    if ({missing}) {{ return 0; }} /* nothing arrived */"
    names = {
        "p": prefix,
        "real": real,
        "capacity": f"{window.capacity}U",
        "rows": f"{window.rows}U",
        "check": "\n".join([*(f"    if (isinf(z[{i}]) != 0) {{ return 1; }}" for i in range(received)), nothing]),
        "copy_z": _generate_array_copy("row->z", "z", received),
        "copy_u": _generate_array_copy("row->u", "u", inputs),
        "received": received,
        "head": _list_function_heads(window, prefix, real)[2],
    }
    late = _LATE_STEP if window.time is None else _LATE_TIME
    if window.time is not None:
        names |= {"dt": window.time, "rounding": _format_literal(window.capacity * DIGITS[real], real)}
    return [text.format(**names) for text in (_PLACE, _RUN, _FILL, _START, _STEP, late)]


def _generate_array_copy(target: str, source: str, count: int) -> str:
    """Return the C statement that copies an array; for an empty one it marks `source` as not used."""
    if not count:
        return f"    (void){source};"
    return f"    for (int c = 0; c < {count}; ++c) {{ {target}[c] = {source}[c]; }}"


def _format_literal(number: float, real: Real) -> str:
    """Return a number as a literal of C of the type `real`; one of float ends in f."""
    return f"{number:.3e}" + ("f" if real == "float" else "")


_PLACE = """static {p}_row *{p}_row_at({p}_window *window, uint32_t i)
{{
    return &window->rows[(window->first + i) % {capacity}];
}}"""

_RUN = """/* Run the rows from one on again; the estimate changes only where none is refused. */
static int {p}_run_again({p}_window *window, uint32_t i)
{{
    {p}_state state = {p}_row_at(window, i)->before;
    for (uint32_t k = i; k < window->count; ++k) {{
        {p}_row *row = {p}_row_at(window, k);
        row->before = state;
        const int refused = {p}_step(&state, row->z, row->u);
        if (refused != 0) {{ return refused; }}
    }}
    window->now = state;
    return 0;
}}"""

_FILL = """/* Fill what arrived into a row and run again; what is refused leaves all as it was. */
static int {p}_fill({p}_window *window, uint32_t i, const {real} z[])
{{
    {p}_row *row = {p}_row_at(window, i);
    for (int c = 0; c < {received}; ++c) {{
        if ((isnan(z[c]) == 0) && (isnan(row->z[c]) == 0)) {{
            ++window->held;
            return 9;
        }}
    }}
    for (int c = 0; c < {received}; ++c) {{
        if (isnan(z[c]) == 0) {{ row->z[c] = z[c]; }}
    }}
    const int refused = {p}_run_again(window, i);
    if (refused != 0) {{
        for (int c = 0; c < {received}; ++c) {{
            if (isnan(z[c]) == 0) {{ row->z[c] = NAN; }}
        }}
        (void){p}_run_again(window, i);
    }}
    return refused;
}}"""

_START = """void {p}_window_start({p}_window *window)
{{
    {p}_start(&window->now);
    window->first = 0U;
    window->count = 0U;
    window->late = 0U;
    window->held = 0U;
}}"""

_STEP = """int {p}_window_step({p}_window *window, const {real} z[], const {real} u[])
{{
    {p}_state after = window->now;
    const int refused = {p}_step(&after, z, u);
    if (refused != 0) {{ return refused; }}
    /* The row takes the place behind the newest one, or that of the oldest. */
    if (window->count == {rows}) {{
        window->first = (window->first + 1U) % {capacity};
        --window->count;
    }}
    {p}_row *row = {p}_row_at(window, window->count);
    row->before = window->now;
{copy_z}
{copy_u}
    ++window->count;
    window->now = after;
    return 0;
}}"""

_LATE_STEP = """{head}
{{
{check}
    if (steps >= window->count) {{
        ++window->late;
        return 8;
    }}
    return {p}_fill(window, window->count - 1U - steps, z);
}}"""

_LATE_TIME = """/* Make a row before row i with what is left of its time step when it keeps `rest` of it. */
static int {p}_make_row({p}_window *window, uint32_t i, {real} rest, const {real} z[])
{{
    const {real} whole = {p}_row_at(window, i)->u[{dt}];
    for (uint32_t k = window->count; k > i; --k) {{ *{p}_row_at(window, k) = *{p}_row_at(window, k - 1U); }}
    {p}_row *row = {p}_row_at(window, i);
{copy_z}
    row->u[{dt}] = whole - rest;
    {p}_row_at(window, i + 1U)->u[{dt}] = rest;
    ++window->count;
    const int refused = {p}_run_again(window, i);
    if (refused != 0) {{
        /* As if there had been none. */
        const {p}_state before = row->before;
        for (uint32_t k = i + 1U; k < window->count; ++k) {{ *{p}_row_at(window, k - 1U) = *{p}_row_at(window, k); }}
        --window->count;
        row->before = before;
        row->u[{dt}] = whole;
        (void){p}_run_again(window, i);
    }} else if (window->count > {rows}) {{
        window->first = (window->first + 1U) % {capacity};
        --window->count;
    }}
    return refused;
}}

{head}
{{
{check}
    if ((isfinite(age) == 0) || (age < 0)) {{ return 6; }}
    /* The age of row i, and of the state before it. */
    {real} since = 0;
    for (uint32_t i = window->count; i > 0U; --i) {{
        const {real} before = since + {p}_row_at(window, i - 1U)->u[{dt}];
        if (age <= since * (1 + {rounding})) {{ return {p}_fill(window, i - 1U, z); }}
        if (age < before * (1 - {rounding})) {{ return {p}_make_row(window, i - 1U, age - since, z); }}
        since = before;
    }}
    ++window->late;
    return 8;
}}"""
