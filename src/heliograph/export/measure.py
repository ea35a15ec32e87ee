"""Cost of an exported step: bytes and nanoseconds on this machine, if it has a C compiler."""

import re
import shutil
import subprocess
import tempfile
from pathlib import Path
from typing import NamedTuple

from heliograph.codegen.c_source import Real

COMPILER = "cc"
FLAGS = ("-std=c99", "-pedantic", "-Wall", "-Werror", "-O2")
STEPS = 200_000
REPEATS = 5


class Cost(NamedTuple):
    """Bytes of code and constants, and nanoseconds of a step, the fastest of five rounds; None if not measured."""

    code_bytes: int | None
    nanoseconds: float | None


def cost(header: Path, source: Path, received: int, inputs: int, real: Real) -> Cost:
    """Compile and time a step, in a temporary folder."""
    compiler = shutil.which(COMPILER)
    if compiler is None:
        return Cost(None, None)
    with tempfile.TemporaryDirectory() as temporary:
        folder, name = Path(temporary), source.stem
        for path in (header, source):
            shutil.copy(path, folder)
        (folder / "main.c").write_text(_timer(name, received, inputs, real), encoding="utf-8")
        _run(compiler, *FLAGS, "-c", source.name, "-o", "step.o", folder=folder)
        timer = ["-D_POSIX_C_SOURCE=199309L", *FLAGS, "main.c", "step.o", "-lm", "-o", "timer"]
        _run(compiler, *timer, folder=folder)
        return Cost(_code_bytes(folder), float(_run(str(folder / "timer"), folder=folder)))


def _code_bytes(folder: Path) -> int | None:
    """Return the bytes of text and constants of the object file, without debugging data."""
    if shutil.which("size") is None:
        return None
    sections = re.findall(r"^(\S+)\s+(\d+)\s+\d+$", _run("size", "-A", "step.o", folder=folder), re.MULTILINE)
    return sum(int(size) for name, size in sections if name.startswith((".text", ".rodata", "__text", "__const")))


def _run(*command: str, folder: Path) -> str:
    return subprocess.run(command, cwd=folder, check=True, capture_output=True, text=True).stdout


def _timer(name: str, received: int, inputs: int, real: Real) -> str:
    """Return a program that prints the time of a step. After a refusal (the end of a horizon) it starts again."""
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
