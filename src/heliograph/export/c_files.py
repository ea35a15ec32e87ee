"""Export of a filter as two files of C99, and what a step costs on this machine, if it has a C compiler."""

import re
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jax.tree_util import keystr, tree_flatten_with_path

from heliograph.disk.atomic_files import check_writable, whole_files
from heliograph.export.c_text import MADE, CText, CTextOptions, generate_header_and_source
from heliograph.export.late_measurement_window import check_and_count_window_steps
from heliograph.export.received_numbers import Received
from heliograph.export.step_program import RESERVED, Real, lower_step_to_c_functions
from heliograph.filters.base import AbstractFilter
from heliograph.filters.linear.scheduled_gains import ScheduledFilter
from heliograph.model.over_time import first
from heliograph.numerics.check import InputError, fail, instance, show_value
from heliograph.numerics.trace_settings import use_precision, write_short_programs
from heliograph.simulation.centres.named_filter import find_filter_by_name
from heliograph.simulation.network import Network

PRECISIONS: dict[str, Real] = {"double": "double", "float": "float"}
COMPILER = "cc"
FLAGS = ("-std=c99", "-pedantic", "-Wall", "-Werror", "-O2")
STEPS = 200_000  # that are timed in each round
REPEATS = 5  # rounds, of which the fastest counts


class Exported(NamedTuple):
    """Result of an export: the files, the number of each operation in a step (in a loop once), bytes of the state."""

    header: Path
    source: Path
    operations: dict[str, int]
    state_bytes: int


def export_c(
    filter: AbstractFilter | Network,
    path: str | Path,
    precision: str = "double",
    name: str | None = None,
    node: str | None = None,
    apart: bool = False,
    size: bool = False,
    window: int | None = None,
) -> Exported:
    """Write one step of a filter as C99, for a device: `step.h` and `step.c` where `path` is "step.c".

    `step_start(state)` initialises; `step_step(state, z, u)` predicts over one step with the inputs u and corrects by
    the components of z that arrived (NaN: did not arrive), and returns 0, or refuses by another number and leaves the
    state unchanged, as where a component is more than 1e6 deviations from what was expected, or a time step "dt" is
    negative; `step_mean(state)` and `step_covariance(state)` (row by row) are the estimate. `apart`: also
    `step_predict(state, u)`, `step_correct(state, z, innovation)`, and `step_start_at(state, mean, covariance)` of a
    filter whose state is these two. There is no heap, no global variable, and no library but libm. All names begin with
    the name of the file. A filter of a plant that varies over time contains its tables, and refuses a step past their
    end.

    Args:
        filter: the filter; or a network, of which `name` says the filter.
        path: path of the source, which ends in .c; the header is written next to it.
        precision: "double", which agrees with `Stream` to rounding; "float", single precision, for filters that carry
            their covariance as factors L D L', whose variances stay positive, and schedules of gains (default
            "double").
        apart: whether prediction and correction are functions of their own beside the step, so that each sensor is used
            when it comes, and the innovation is told; False by default.
        size: whether the code is to be small rather than fast: points are taken one after another in loops, where
            that is shorter; False by default.
        window: how many steps late a measurement may be, with `step_window` around the state and functions of it: what
            comes late is filled into its step, of a plant with an input "dt" at its time, and the steps from there on
            are run again. None by default: none is late.

    Returns:
        The two files, the number of each operation in a step, and the bytes of the state, or of the window around it.

    Raises:
        ValueError: no filter; no filter of that name, or a fusion of finished estimates; a path that does not end in
            .c, is no name in C or cannot be written; random numbers, or operations that C does not have, with the line
            they come from; single precision of another filter; a window of continuous time where parts go by steps.
            Then nothing is written.

    Source: Bierman, Factorization methods for discrete sequential estimation (1977).
    """
    if isinstance(filter, Network):
        named = find_filter_by_name(filter, "" if name is None else name, node)
        received = Received(named.received, named.refused_values, named.leave_out_refused, named.looks_for_stuck)
        return write_filter_files(named.filter, received, path, precision, apart=apart, size=size, window=window)
    if name is not None or node is not None:
        raise fail("export by name", "a network", show_value(filter))
    what = "a filter, or a network and the name of its filter or fusion"
    checked: AbstractFilter = instance("export", filter, AbstractFilter, what)
    return write_filter_files(
        checked, Received(_name_received(checked)), path, precision, apart=apart, size=size, window=window
    )


def _name_received(filter: AbstractFilter) -> tuple[str, ...]:
    """Return the sensor's outputs if the filter has a sensor and as many arrive, else z0, z1, ..."""
    outputs: tuple[str, ...] = first(filter.sensor).outputs if hasattr(filter, "sensor") else ()
    return outputs if len(outputs) == filter.received else tuple(f"z{i}" for i in range(filter.received))


def write_filter_files(
    filter: AbstractFilter,
    received: Received,
    path: str | Path,
    precision: str,
    apart: bool = False,
    size: bool = False,
    window: int | None = None,
) -> Exported:
    """Write a filter as two files of C, and return what was written, as `export_c` does for a user's filter.

    `received`: names of the measurement's components, and which of their values are refused.

    `apart`: prediction and correction are functions of their own, too. `size`: small rather than fast. `window`: how
    many steps late a measurement may be, None for none. `make_c_text` makes the text of both files.
    """
    source = check_source_path(path)
    if precision not in PRECISIONS:
        raise fail("precision", " or ".join(PRECISIONS), show_value(precision))
    late = None if window is None else check_and_count_window_steps(filter, window)
    text = make_c_text(filter, received, source.stem, PRECISIONS[precision], apart=apart, size=size, late=late)
    header = source.with_suffix(".h")
    with whole_files([header, source]) as partials:
        for partial, content in zip(partials, (text.header, text.source), strict=True):
            partial.write_text(content, encoding="utf-8")
    return Exported(header, source, text.operations, text.state_bytes)


def check_source_path(path: str | Path) -> Path:
    """Return the checked path of the C source; the file's name is the prefix of the names in it.

    MADE is a text that exported headers have, by which an earlier one may be replaced; RESERVED has the words of C.

    Raises:
        ValueError: the file does not end in .c, cannot be written, or has a name that is no name of a C function; the
            header would replace a file of somebody else.
    """
    if not isinstance(path, str | Path):
        raise fail("path of the source", "a file that ends in .c", show_value(path))
    source = Path(path)
    check_writable(source, (".c",))
    header = source.with_suffix(".h")
    check_writable(header, (".h",))
    if header.is_file() and MADE not in header.read_text(encoding="utf-8", errors="replace"):
        expected = f"a name beside {source.name} that is free, or has an earlier header"
        raise fail(f"output file {header}", expected, "a file that is not exported")
    stem = source.stem
    if not (stem.isascii() and stem.isidentifier()) or stem in RESERVED or stem.startswith("_"):
        raise fail(f"output file {source}", "a name that C takes for its functions, such as step.c", repr(stem))
    return source


def make_c_text(
    filter: AbstractFilter,
    received: Received,
    prefix: str,
    real: Real,
    apart: bool = False,
    size: bool = False,
    late: int | None = None,
) -> CText:
    """Return the text of both files of a filter in C, its header and its source.

    The filter's step is traced by JAX, lowered to single operations, and written as C functions.

    Args:
        filter: the filter.
        received: names of z's components, and which of their values are refused.
        prefix: with which all names in C begin.
        real: type of numbers.
        apart: whether prediction and correction are functions of their own, too.
        size: whether the source is to be short: the shorter one of two forms, with loops and with loops written out.
        late: how many steps late a measurement may be; None where there is no window for these.

    Raises:
        ValueError: single precision for a filter that cannot keep its covariance in it; a number that is beyond it.
    """
    # In single precision only factors of a covariance, or fixed gains, stay accurate.
    if real == "float" and not (isinstance(filter, ScheduledFilter) or carries_covariance_factors(filter)):
        expected = "a filter that carries its covariance as factors L D L', or a schedule of gains"
        raise fail("single precision", expected, type(filter).__name__)
    exported = filter if real == "double" else filter.for_single_precision()
    precision, dtype = ("double", np.float64) if real == "double" else ("single", np.float32)
    kind = f"a {type(filter).__name__} in {precision} precision"
    form = CTextOptions(prefix=prefix, real=real, received=received, kind=kind, late=late)
    # Loops are not always shorter than what they repeat: for a short source both forms are written.
    forms = (True, False) if size else (False,)
    texts = list[CText]()
    try:
        for in_loops in forms:
            with use_precision(dtype), write_short_programs(in_loops):
                program = lower_step_to_c_functions(exported, real, prefix, apart, in_loops, received.leave_out)
            texts.append(generate_header_and_source(program, form))
    except ValueError as error:
        raise InputError(str(error)) from None  # a number of the filter beyond single precision
    return min(texts, key=lambda text: len(text.source))


def carries_covariance_factors(filter: AbstractFilter) -> bool:
    """Return whether the state has variances of L D L', which stay positive in any precision, and no covariance."""
    return any(keystr(path).endswith(".variances") for path, _ in tree_flatten_with_path(filter.init())[0])


class StepCost(NamedTuple):
    """Bytes of code and constants, and nanoseconds of a step, the fastest of five rounds; None if not measured."""

    code_bytes: int | None
    nanoseconds: float | None


def measure_step_cost(header: Path, source: Path, received: int, inputs: int, real: Real) -> StepCost:
    """Return the bytes of code and the time of a step, compiled and timed in a temporary folder.

    Args:
        header: the exported header.
        source: the exported source.
        received: count of the measurement's components.
        inputs: count of inputs.
        real: type of numbers in C.
    """
    compiler = shutil.which(COMPILER)
    if compiler is None:
        return StepCost(code_bytes=None, nanoseconds=None)
    with tempfile.TemporaryDirectory() as temporary:
        folder, name = Path(temporary), source.stem
        for path in (header, source):
            shutil.copy(path, folder)
        (folder / "main.c").write_text(_generate_timer_program(name, received, inputs, real), encoding="utf-8")
        _run_command(compiler, *FLAGS, "-c", source.name, "-o", "step.o", folder=folder)
        timer = ["-D_POSIX_C_SOURCE=199309L", *FLAGS, "main.c", "step.o", "-lm", "-o", "timer"]
        _run_command(compiler, *timer, folder=folder)
        return StepCost(
            _measure_code_size(folder), nanoseconds=float(_run_command(str(folder / "timer"), folder=folder))
        )


def _measure_code_size(folder: Path) -> int | None:
    """Return the bytes of code and constants in the object file step.o, or None without the program `size`."""
    if shutil.which("size") is None:
        return None
    # Each line holds a section's name, size and address. Names with two underscores are those of macOS.
    table = _run_command("size", "-A", "step.o", folder=folder)
    sections = re.findall(r"^(\S+)\s+(\d+)\s+\d+$", table, re.MULTILINE)
    code_and_constants = (".text", ".rodata", "__text", "__const")
    return sum(int(size) for name, size in sections if name.startswith(code_and_constants))


def _run_command(*command: str, folder: Path) -> str:
    """Run a command in a folder, and return what it prints."""
    return subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout


def _generate_timer_program(name: str, received: int, inputs: int, real: Real) -> str:
    """Return a C program that prints the nanoseconds of a step, by the fastest of REPEATS rounds of STEPS steps.

    Exported filters are timed by it. Where a step is refused, as past the end of a schedule, the filter starts again.

    Args:
        name: name of the filter's header, and the prefix of its functions.
        received: count of z's components, which get numbers from 0.
        inputs: count of u's components, which are 0.1.
        real: type of numbers.
    """
    return f"""#include <stdio.h>
#include <time.h>
#include "{name}.h"

static double now(void)
{{
    struct timespec t;
    clock_gettime(CLOCK_MONOTONIC, &t);
    return 1e9 * (double)t.tv_sec + (double)t.tv_nsec;
}}

int main(void)
{{
    static {name}_state state;
    {real} z[{max(received, 1)}], u[{max(inputs, 1)}];
    double best = 1e30;
    for (int i = 0; i < {max(inputs, 1)}; ++i) u[i] = 0.1f;
    {name}_start(&state);
    for (int r = 0; r < {REPEATS}; ++r) {{
        double start = now();
        for (int k = 0; k < {STEPS}; ++k) {{
            for (int i = 0; i < {max(received, 1)}; ++i) z[i] = 0.01f * (float)(k % 7 + i);
            if ({name}_step(&state, z, u)) {name}_start(&state);
        }}
        double spent = (now() - start) / {STEPS};
        if (spent < best) best = spent;
    }}
    printf("%.3f\\n", best);
    return 0;
}}
"""
