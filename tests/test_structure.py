"""The shape of the package: exported names, docstrings, and imports that flow with the data."""

import ast
import inspect
import re
import textwrap
from collections import Counter
from graphlib import TopologicalSorter
from importlib import import_module
from pathlib import Path

import heliograph
from tests.map import BORDERS, names_taken_by, parsed, statements

SOURCE = Path(heliograph.__file__).parent
PACKAGES = SOURCE, SOURCE.parent / "straightline", SOURCE.parents[1] / "studies"
# Later may import earlier, never the reverse.
ORDER = [
    ["numerics"],
    ["engine"],
    ["disk"],
    ["factors"],
    ["random_affine"],
    ["model"],
    ["models"],
    [
        "filters.vector_check",
        "filters.call_checks",
        "filters.angle_indices",
        "filters.derivatives_of_likelihood",
        "filters.base",
        "filters.remark",
        "filters.sizes",
        "filters.plausibility",
        "filters.rows.gaussians_in_states",
        "filters.rows.linear_recursion",
        "filters.rows.row_windows",
        "filters.rows.settled_covariance",
        "filters.rows.chunks",
        "filters.rows.run_over_data",
        "filters.event.truncated_normal",
        "filters.truncation",
        "filters.smoother_step",
        "filters.gaussian.moments_for_derivatives",
        "filters.gaussian.moment_transforms",
        "filters.gaussian.young_scalars",
        "filters.gaussian.signal_moments",
        "filters.gaussian.uncertain_channel_bounds",
        "filters.gaussian.uncertain_channel_updates",
    ],
    ["linear", "relays", "h_infinity"],
    ["filters"],
    ["smoothing"],
    ["fusion"],
    ["simulation"],
    ["forecasting"],
    ["live", "export"],
    ["learning", "planning"],
    ["testing"],
    ["files"],
    ["report"],
    ["campaign"],
    ["serving"],
    ["cli"],
    ["__main__"],
]
RANK = {name: rank for rank, names in enumerate(ORDER) for name in names}


def rank(module: str) -> int | None:
    """Rank of the longest listed prefix of a dotted module name."""
    parts = module.split(".")
    for length in range(len(parts), 0, -1):
        if ".".join(parts[:length]) in RANK:
            return RANK[".".join(parts[:length])]
    return None


def imports(path: Path) -> set[str]:
    taken = [(m.removeprefix("heliograph."), name) for m, name in names_taken_by(path) if m.startswith("heliograph.")]
    return {f"{module}.{name}" if rank(f"{module}.{name}") is not None else module for module, name in taken}


FILES = [p for p in SOURCE.rglob("*.py") if p != SOURCE / "__init__.py"]


def test_imports_flow_with_the_data():
    wrong = []
    for path in FILES:
        local = str(path.relative_to(SOURCE).with_suffix("")).replace("/", ".").removesuffix(".__init__")
        if rank(local) is None:
            wrong.append(f"{local}: give it a place in ORDER")
        else:
            later = [other for other in imports(path) if rank(other) > rank(local)]
            wrong += [f"{local} imports {other}, which comes later" for other in later]
    assert FILES and not wrong, "\n".join(wrong)


def import_graph() -> dict[str, set[str]]:
    """Return the modules that each module of the library imports, for type checkers and inside functions too."""
    named = {".".join(path.relative_to(SOURCE.parent).with_suffix("").parts): path for path in FILES}
    return {name: {module for module, _ in names_taken_by(path)} & set(named) for name, path in named.items()}


def test_imports_never_go_round():
    """The error names the circle."""
    graph = import_graph()
    assert "heliograph.filters.rows.run_over_data" in graph["heliograph.filters.base"]  # it sees what there is
    TopologicalSorter(graph).prepare()


def _raises(function) -> bool:
    """Whether a function's own body has a `raise`; what it calls says so itself."""
    body = ast.parse(textwrap.dedent(inspect.getsource(function)))
    return any(isinstance(node, ast.Raise) for node in ast.walk(body))


HALL = [name for name in heliograph.__all__ if not inspect.ismodule(getattr(heliograph, name))]
ROOMS = sorted(stub.parent.name for stub in SOURCE.glob("*/__init__.pyi") if stub.parent.name not in BORDERS)
PUBLIC = [("heliograph", name) for name in HALL] + [
    (f"heliograph.{room}", name) for room in ROOMS for name in import_module(f"heliograph.{room}").__all__
]


def test_public_names_exist_and_are_documented():
    wrong = [f"{place}.{name}: expected {what}" for place, name in PUBLIC for what in lacking(place, name)]
    assert PUBLIC and not wrong, "\n".join(wrong)


def lacking(place: str, name: str) -> list[str]:
    """What is expected of a public name and its docstring, and is not there."""
    item = getattr(import_module(place), name)
    text = inspect.getdoc(item) or ""
    right = {"no module of this name beside it": not inspect.ismodule(item)}
    right["a first line that says what it is"] = bool(text) and "\n" not in text.split(".")[0]
    if inspect.isfunction(item):
        right["no word of errors where there are none"] = not re.search(r"Raises:\s*nothing", text)
        right["what it raises"] = "Raises:" in text or not _raises(item)
        is_filter = name.endswith("_filter") and place != "heliograph.testing"
        has_source = is_filter or item.__module__ == "heliograph.fusion.rules"
        right["where it comes from"] = "Source:" in text or not has_source
    return [what for what, is_right in right.items() if not is_right]


def test_every_public_name_stands_in_the_list_of_names():
    page = (SOURCE.parents[1] / "docs" / "names.md").read_text()
    missing = [f"{place}.{name}" for place, name in PUBLIC if f"| `{name}` |" not in page]
    assert not missing, f"docs/names.md lacks {missing}"


def test_a_name_has_one_home_and_the_hall_is_small():
    names = [name for _, name in PUBLIC]
    assert len(set(names)) == len(names)
    assert len(heliograph.__all__) <= 83, "the first hour needs no more names than these"
    assert len([p for p in SOURCE.glob("*.py") if p.name != "__init__.py"]) <= 6


def test_every_room_says_what_it_is():
    for room in (p for p in SOURCE.iterdir() if (p / "__init__.py").exists()):
        lines = (room / "README.md").read_text().splitlines()
        first = lines[:3]
        assert len(first) == 3 and all(line.startswith("**") for line in first), f"{room.name}: expected three lines"
        assert len(lines) == 3 or lines[3] == "", f"{room.name}: expected what follows them apart"


def test_no_public_function_is_without_a_docstring():
    for path in FILES:
        for node in parsed(path).body:
            if isinstance(node, ast.FunctionDef | ast.ClassDef) and not node.name.startswith("_"):
                if any(isinstance(d, ast.Name) and d.id == "overload" for d in node.decorator_list):
                    continue  # the function itself says it
                assert ast.get_docstring(node), f"{path.name}: {node.name} has no docstring"
                members = node.body if isinstance(node, ast.ClassDef) else []
                for member in members:
                    public = isinstance(member, ast.FunctionDef) and not member.name.startswith("_")
                    assert not public or ast.get_docstring(member), f"{path.name}: {node.name}.{member.name}"


def test_no_file_is_longer_than_four_hundred_lines():
    """One idea a file: what is longer has two."""
    lengths = {path: len(path.read_text().splitlines()) for package in PACKAGES for path in package.rglob("*.py")}
    assert lengths and not {str(path): length for path, length in lengths.items() if length > 400}


def test_no_folder_has_more_than_twenty_files():
    """What is in a folder is seen at a glance; more than that has groups, which are folders."""
    counts = Counter(path.parent for package in PACKAGES for path in package.rglob("*.py"))
    assert counts and not {str(folder): count for folder, count in counts.items() if count > 20}


def test_the_library_knows_no_study():
    for path in SOURCE.rglob("*.py"):
        assert "heliograph_studies" not in path.read_text(), path.name


def test_eigenvalues_of_a_batch_are_taken_one_after_another():
    """A batch at once is dealt out to threads by calls that wait on them: two filters side by side wait for ever."""
    direct = [p.relative_to(SOURCE).as_posix() for p in SOURCE.rglob("*.py") if "jnp.linalg.eigh(" in p.read_text()]
    assert direct == ["numerics/lapack.py"]


def test_no_function_has_forty_lines():
    """Counted without signature and docstring: a longer one has steps that have names."""
    lengths = {}
    for path in (path for package in PACKAGES for path in package.rglob("*.py")):
        for node in statements(parsed(path)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                start = node.body[0].end_lineno if ast.get_docstring(node) else node.body[0].lineno - 1
                lengths[f"{path}: {node.name}"] = node.end_lineno - start
    assert lengths and not {name: length for name, length in lengths.items() if length >= 40}
