"""The results of cases by C: one program of all cases of an operation, compiled to stop at what C leaves undefined."""

import shutil
import subprocess
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from straightline.c_source import CSource, c_type
from straightline.constant_folding import DTYPES
from straightline.lowering import list_nodes
from straightline.nodes import Unsupported
from tests.straightline.conformance.case import Case
from tests.straightline.conformance.engines import program_of

FLAGS = ("-std=c99", "-pedantic", "-Wall", "-Werror", "-O2")
COMPILERS = [name for name in ("gcc", "clang") if shutil.which(name)]
STRICT = ("-O0", "-fsanitize=undefined", "-fno-sanitize-recover=all")


def by_c(cases: Sequence[Case], folder: Path, compiler: str, quiet: bool = False) -> list[list[np.ndarray]]:
    """The results of each case; `quiet`: stop if the flag of an invalid operation is raised."""
    texts, calls, data, kinds = [], [], [], []
    for number, case in enumerate(cases):
        text, call, types = _function(case, f"case{number}")
        texts.append(text)
        calls.append(call)
        data += [np.ascontiguousarray(a, np.int32 if a.dtype == bool else a.dtype).tobytes() for a in case.arguments]
        kinds.append(types)
    check = "if (fetestexcept(FE_INVALID)) return 9;" if quiet else ""
    main = "\n".join(["int main(void) {", "feclearexcept(FE_ALL_EXCEPT);", *calls, check, "return 0;", "}"])
    heads = [f"#include <{name}.h>" for name in ("fenv", "math", "stdint", "stdio")]
    (folder / "cases.c").write_text("\n".join([*heads, *texts, main, ""]))
    command = [compiler, *FLAGS, *STRICT, "cases.c", "-o", "cases", "-lm"]
    subprocess.run(command, cwd=folder, check=True)
    done = subprocess.run([folder / "cases"], input=b"".join(data), capture_output=True, check=False)
    assert not done.returncode and not done.stderr, (done.returncode, done.stderr.decode()[:2000])
    return _read(done.stdout, kinds)


def is_written(case: Case) -> bool:
    """Test whether C takes the operations of a case, without compiling it."""
    try:
        _function(case, "case")
    except Unsupported:
        return False
    return True


def _function(case: Case, name: str) -> tuple[str, str, list[tuple[str, tuple[int, ...]]]]:
    program = program_of([case])
    places = {b: f"x{n}[{{}}]".format for n, b in enumerate(program.inputs)}
    nodes = [list_nodes(x) if x.size else [] for x in program.outputs]
    source = CSource([n for x in nodes for n in x], places, "double", name)
    body, arrays, ends, types = source.write_statements(program.graph.top), [], [], []
    for number, buffer in enumerate(program.inputs):
        array = f"x{number}[{max(buffer.size, 1)}]"
        arrays.append(f"    static {c_type(buffer.type, 'double')} {array};")
        arrays.append(f"    if (fread(x{number}, sizeof x{number}[0], {buffer.size}, stdin) != {buffer.size}) return;")
    for flat, x in zip(nodes, program.outputs, strict=True):
        kind = flat[0].type if flat else x.type
        ends += [
            f"    {{ {c_type(kind, 'double')} y = {source.name_node(n)}; fwrite(&y, sizeof y, 1, stdout); }}"
            for n in flat
        ]
        types.append((kind, x.shape))
    lines = [f"static void {name}(void)", "{", *arrays, *source.declarations(), *body, *ends, "}"]
    return "\n".join([*source.table_definitions(), *lines]), f"{name}();", types


def _read(data: bytes, kinds: list[list[tuple[str, tuple[int, ...]]]]) -> list[list[np.ndarray]]:
    results, start = [], 0
    for types in kinds:
        leaves = []
        for type, shape in types:
            stored = np.dtype(np.int32 if type == "bool" else DTYPES[type])
            count = int(np.prod(shape))
            leaves.append(np.frombuffer(data, stored, count, start).reshape(shape).astype(DTYPES[type]))
            start += count * stored.itemsize
        results.append(leaves)
    return results
