"""The map of the library, made from its code: `python -m tests.map` writes it into the READMEs of the source.

A room is a folder of `heliograph`. What it imports is read from its files, what it is from the first line of its
README, and its floor from the order in which imports may go (tests/test_structure.py). What crosses the border of a
folder that is no public room is listed in its `__init__.pyi`, written by the same command.
"""

import ast
import re
from collections import defaultdict
from collections.abc import Iterator
from functools import cache
from pathlib import Path

from heliograph.numerics import pause_collector

SOURCE = Path(__file__).parents[1] / "src" / "heliograph"
# Parts of the library, from the description of a world to the programs that people run, and what each is for.
PARTS = {
    "ground": "knows no sensor and no estimate",
    "description": "the world as a user writes it down",
    "estimation": "from measurements to estimates, alone and in a network; and checks of all that",
    "design": "numbers from data, or for a purpose",
    "application": "what people run: files, services, pages, commands",
}
ROOMS = {
    "ground": ["numerics", "engine", "disk", "factors"],
    "description": ["random_affine", "model", "models"],
    "estimation": [
        "linear",
        "relays",
        "h_infinity",
        "filters",
        "smoothing",
        "fusion",
        "simulation",
        "forecasting",
        "testing",
    ],
    "design": ["learning", "planning"],
    "application": ["live", "export", "files", "report", "campaign", "serving", "cli"],
}
BESIDE = "straightline"  # a package of its own in the same wheel, which knows nothing of heliograph
# Folders with a border of their own, which users do not see: other folders, and tests, take what it lists.
BORDERS = [
    "numerics",
    "disk",
    "factors",
    "random_affine/moments",
    "random_affine/noises",
    "learning/likelihood",
    "live/stored",
    "filters/event",
    "filters/modes",
    "filters/particles",
    "filters/words",
    "filters/wrappers",
    "fusion/mesh",
    "simulation/centres",
    "simulation/mesh",
    "planning/multihop_paths",
    "simulation/runs",
    "files/bags",
    "files/sources",
    "serving/brokers",
    "serving/storage",
    "serving/observation",
]
BEGIN, END = "<!-- made by python -m tests.map -->", "<!-- end -->"


@cache
@pause_collector()
def parsed(path: Path) -> ast.Module:
    """A file, read once for all tests of a process; a tree holds no garbage."""
    return ast.parse(path.read_text())


def statements(tree: ast.AST) -> Iterator[ast.stmt]:
    """All statements of a file or a part of it, whatever they stand in: one of ten nodes is one."""
    for field in ("body", "orelse", "finalbody", "handlers", "cases"):
        for node in getattr(tree, field, ()):
            if isinstance(node, ast.stmt):
                yield node
            yield from statements(node)


@cache
def names_taken_by(path: Path) -> list[tuple[str, str]]:
    """What a file imports, module and name; also where it asks a folder for a name, which is loaded only then.

    The latter is `import heliograph.filters.modes as modes`, and somewhere `modes.modal_filter`.
    """
    nodes = list(statements(parsed(path)))
    imports = [node for node in nodes if isinstance(node, ast.ImportFrom) and node.module]
    asked = {
        alias.asname: alias.name
        for node in nodes
        if isinstance(node, ast.Import)
        for alias in node.names
        if alias.asname and alias.name.startswith("heliograph.")
    }
    attributes = [node for node in ast.walk(parsed(path)) if isinstance(node, ast.Attribute)] if asked else []
    named = {
        (asked[node.value.id], node.attr)
        for node in attributes
        if isinstance(node.value, ast.Name) and node.value.id in asked
    }
    return [(node.module, alias.name) for node in imports for alias in node.names] + [
        (home_of(folder, name), name) for folder, name in sorted(named)
    ]


def home_of(folder: str, name: str) -> str:
    """The module of a folder, written with dots, that defines a name."""
    for path in (SOURCE.parent / folder.replace(".", "/")).glob("*.py"):
        if any(getattr(node, "name", None) == name for node in parsed(path).body):
            return f"{folder}.{path.stem}"
    raise ValueError(f"{folder}: expected a function or class {name}")


@cache
def imported_names() -> list[tuple[Path, str, str]]:
    """Every import of the library: the file, the module and the name."""
    return [(path, module, name) for path in SOURCE.rglob("*.py") for module, name in names_taken_by(path)]


@cache
def taken() -> dict[tuple[str, str], set[str]]:
    """Names that one room imports from another: {(who, of whom): {module.name}}."""
    names = defaultdict(set)
    for path, module, name in imported_names():
        room, *inside = path.relative_to(SOURCE).parts
        package, _, rest = module.partition(".")
        other = rest.partition(".")[0] if package == "heliograph" else package
        if inside and package in ("heliograph", BESIDE) and other != room:
            names[room, other].add(f"{module}.{name}")
    return names


def crossing(above: list[str], below: list[str]) -> set[str]:
    """Names of the rooms `below` that the rooms `above` import."""
    return {name for (who, whom), names in taken().items() if who in above and whom in below for name in names}


def imports_of(room: str) -> list[str]:
    """Rooms that a room imports from, in the order of the floors, after the package beside the library."""
    return [other for rooms in ([BESIDE], *ROOMS.values()) for other in rooms if (room, other) in taken()]


def sentence_of(room: str) -> str:
    """What a room is: the first sentence of its README."""
    first = (SOURCE / room / "README.md").read_text().splitlines()[0].removeprefix("**What it is.** ")
    return re.split(r"(?<=[^.])\. ", first)[0].rstrip(".") + "."


def picture() -> str:
    """The floors, with the rooms on each."""
    width = max(map(len, PARTS))
    lines = [f"    {part:<{width}}   {'  '.join(rooms)}" for part, rooms in ROOMS.items()]
    return "\n".join(f"{line}\n    {'':<{width}}     | {PARTS[part]}" for part, line in zip(PARTS, lines, strict=True))


def map_of_rooms() -> str:
    """The picture and a row for each room."""
    rows = ["| room | what it is | imports |", "|---|---|---|"]
    for rooms in ROOMS.values():
        for room in rooms:
            others = ", ".join(f"`{other}`" for other in imports_of(room)) or "nothing"
            rows.append(f"| [`{room}`]({room}/README.md) | {sentence_of(room)} | {others} |")
    return "\n".join([BEGIN, "", picture(), "", *rows, "", END])


def imports_line(room: str) -> str:
    """The line of a room's README that says what it imports."""
    return f"**Imports:** {', '.join(f'`{other}`' for other in imports_of(room)) or 'no other room'}."


def border_of(folder: str) -> str:
    """The stub of a folder: by file, the names that the library takes from outside it.

    A name that is that of a file beside it is taken from the file: the folder's attribute would be either.
    """
    here, package = SOURCE / folder, f"heliograph.{folder.replace('/', '.')}"
    names = defaultdict(set)
    for path, module, name in imported_names():
        if not path.is_relative_to(here) and module.startswith(f"{package}."):
            names[module.removeprefix(package)].add(name)
    lines = ['"""Names that other folders take; the package loads them when first used."""', ""]
    for module in sorted(names):
        for name in sorted(names[module]):
            if not (here / f"{name}.py").exists() and not (here / module.lstrip(".") / f"{name}.py").exists():
                lines.append(f"from {module} import {name} as {name}")
    return "\n".join(lines) + "\n"


def at_borders() -> set[str]:
    """Names that stand at a border, as `heliograph.factors.Gaussian`."""
    return {
        f"heliograph.{folder.replace('/', '.')}.{alias.name}"
        for folder in BORDERS
        for node in parsed(SOURCE / folder / "__init__.pyi").body
        if isinstance(node, ast.ImportFrom)
        for alias in node.names
    }


def write() -> None:
    """Write the map, what each room imports, and what crosses the borders of folders."""
    for folder in BORDERS:
        (SOURCE / folder / "__init__.pyi").write_text(border_of(folder))
    page = SOURCE / "README.md"
    text = page.read_text()
    page.write_text(text[: text.index(BEGIN)] + map_of_rooms() + text[text.index(END) + len(END) :])
    for room in (room for rooms in ROOMS.values() for room in rooms):
        page = SOURCE / room / "README.md"
        lines = page.read_text().split("\n")
        page.write_text("\n".join([lines[0], imports_line(room), *lines[2:]]))


if __name__ == "__main__":
    write()
