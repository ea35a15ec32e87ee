"""The reference: a page for each room, made of its list of public names; docstrings and signatures as written.

Docstrings of this package are plain text with formulas, `names` in backticks, and the sections Raises and Source; here
they become reStructuredText. Signatures are taken from the source, since evaluated types of arrays fill half a page.
"""

import ast
import inspect
import re
import textwrap
from collections.abc import Iterator
from importlib import import_module
from pathlib import Path

from docutils import nodes

import heliograph

SPECIAL = re.compile(r"([\\*|_])")
OPENING, CLOSING = "'\"([{<-/:", " \n'\")]}>-/:.,;!?"  # what may stand before and after marked-up text


def rooms() -> Iterator[tuple[str, str, list[str]]]:
    """Each room's full name, what it is, and its public names in the order of its list; the hall comes first."""
    folder = Path(heliograph.__file__).parent
    modules = [name for name in heliograph.__all__ if inspect.ismodule(getattr(heliograph, name))]
    ordered = sorted(modules, key=lambda name: listed(folder / "__init__.pyi").index(name))
    local = sorted(
        {stub.parent.name for stub in folder.glob("*/__init__.pyi")} - set(ordered)
    )  # imported by their names
    yield "heliograph", summary(heliograph), [n for n in listed(folder / "__init__.pyi") if n not in modules]
    for name in [*ordered, *local]:
        names = listed(folder / name / "__init__.pyi")
        if names:
            yield f"heliograph.{name}", summary(import_module(f"heliograph.{name}")), names


def listed(stub: Path) -> list[str]:
    """The names that a stub exports, in its order."""
    imports = [node for node in ast.parse(stub.read_text()).body if isinstance(node, ast.ImportFrom)]
    return [alias.asname or alias.name for node in imports for alias in node.names]


def summary(module: object) -> str:
    """The first line of a module's docstring."""
    return (inspect.getdoc(module) or "").splitlines()[0]


def write_pages(folder: Path) -> None:
    """Write the pages and their index; a page that has not changed keeps its time, so that it is not read again."""
    folder.mkdir(parents=True, exist_ok=True)
    expected = {"index.rst": index()}
    for room, what, names in rooms():
        expected[f"{short(room)}.rst"] = page(room, what, names)
    for path in set(folder.glob("*.rst")) - {folder / name for name in expected}:
        path.unlink()
    for name, text in expected.items():
        path = folder / name
        if not path.exists() or path.read_text() != text:
            path.write_text(text)


def short(room: str) -> str:
    """The name of a room's page."""
    return room.removeprefix("heliograph.") if "." in room else "hall"


def index() -> str:
    """The list of rooms."""
    rows = "".join(
        f"   * - :doc:`{room} <{short(room)}>`\n     - {escaped(what)}\n     - {len(names)}\n"
        for room, what, names in rooms()
    )
    entries = "".join(f"   {room} <{short(room)}>\n" for room, _, _ in rooms())
    return f"""Reference
=========

Every public name, at the one place it is imported from. What the first hour needs stands in ``heliograph`` itself
(``import heliograph as hg``); everything else is reached through its room, as ``hg.filters.imm_filter``. What keeps
filters running needs the extra ``live`` and is imported, as ``from heliograph.serving import Service``. A list of all
names on one page: :doc:`/names`. Words and letters: :doc:`/notation`. Names, and words of other packages, in one
alphabet: :ref:`genindex`.

.. list-table::
   :header-rows: 1
   :widths: 25 65 10

   * - room
     - what it is
     - names
{rows}

.. toctree::
   :hidden:

{entries}"""


def page(room: str, what: str, names: list[str]) -> str:
    """The page of a room: its names in a list, then each with its signature and docstring."""
    module = import_module(room)
    kinds = {name: "autoclass" if inspect.isclass(getattr(module, name)) else "autofunction" for name in names}
    title = f"{room}\n{'=' * len(room)}\n\n.. py:module:: {room}\n   :no-index:\n\n{escaped(what)}\n\n"
    rows = "".join(
        f"   * - :py:obj:`~{room}.{name}`\n     - {escaped(first_line(getattr(module, name)))}\n" for name in names
    )
    table = f".. list-table::\n   :widths: 30 70\n   :class: names\n\n{rows}\n"
    return title + table + "".join(f".. {kind}:: {room}.{name}\n\n" for name, kind in kinds.items())


def first_line(item: object) -> str:
    """The first line of a docstring."""
    return (inspect.getdoc(item) or "").splitlines()[0]


PLACES = {name: f"{room}.{name}" for room, _, names in rooms() for name in names}


def escaped(text: str) -> str:
    """Plain text as reStructuredText: `names` become links where they are public, code where they are not."""
    parts = re.split(r"`([^`]+)`", text)
    result = ""
    for place, part in enumerate(parts):
        if place % 2 == 0:
            result += SPECIAL.sub(r"\\\1", part)
            continue
        name = part.removesuffix("()").rsplit(".", 1)[-1]
        known = PLACES.get(name) if re.fullmatch(r"[\w.]+(\(\))?", part) else None
        role = f":py:obj:`{part} <{known}>`" if known else f"``{part}``"
        before = "\\ " if result[-1:] and not result[-1].isspace() and result[-1] not in OPENING else ""
        after = "\\ " if parts[place + 1][:1].strip(CLOSING) else ""
        result += before + role + after
    return result


def restructured(lines: list[str]) -> list[str]:
    """A docstring as reStructuredText: paragraphs, indented formulas as they stand, fields for Raises and Source."""
    results: list[str] = []
    for block in re.split(r"\n\s*\n", inspect.cleandoc("\n".join(lines))):
        for part in re.split(r"^(?=(?:Raises|Source):)", block, flags=re.MULTILINE):
            if part.strip():
                results += [*_part(part.strip("\n")), ""]
    return results


def _part(text: str) -> list[str]:
    head, _, rest = text.partition(":")
    if head == "Raises":
        entries = re.split(r"\n(?=\w+: )", textwrap.dedent(rest.strip("\n")))
        return [_field(f"raises {kind}", what) for kind, what in (entry.split(":", 1) for entry in entries)]
    if head == "Source":
        return [_field("Source", rest)]
    lines = text.split("\n")
    if all(line.startswith(" ") for line in lines) or any(line.startswith("    ") for line in lines):
        formula = textwrap.dedent("\n".join(line for line in lines if line.startswith(" "))).split("\n")
        before = [line for line in lines if not line.startswith(" ")]
        return [escaped(" ".join(before)), "", "::", "", *(f"    {line}" for line in formula)]
    if any(re.match(r"[-*] ", line) for line in lines):
        return [f"| {escaped(line)}" for line in lines]
    return [escaped(" ".join(line.strip() for line in lines))]


def _field(name: str, text: str) -> str:
    return f":{name}: {escaped(' '.join(text.split()))}"


def signature(item: object) -> tuple[str, str] | None:
    """Arguments and result in the source's own words."""
    if inspect.isclass(item):
        local = item.__dict__.get("__init__")
        written = next((c.__init__ for c in item.__mro__ if _written(c.__dict__.get("__init__"))), None)
        function = written if _written(local) or not getattr(item, "__dataclass_fields__", None) else None
        return _of_fields(item) if function is None else (_of_function(function)[0], "")
    return _of_function(inspect.unwrap(item))


def _written(function: object) -> bool:
    """Whether it stands in a file of this package, rather than being made by a decorator or another package."""
    folder = str(Path(heliograph.__file__).parent)
    return inspect.isfunction(function) and function.__code__.co_filename.startswith(folder)


def _of_function(function: object) -> tuple[str, str]:
    node = ast.parse(textwrap.dedent(inspect.getsource(function))).body[0]
    arguments = [*node.args.posonlyargs, *node.args.args]
    if arguments and arguments[0].arg in ("self", "cls"):
        node.args.args = node.args.args[1:]
    result = ast.unparse(node.returns).strip("'") if node.returns else ""
    return f"({ast.unparse(node.args)})", result


def _of_fields(item: type) -> tuple[str, str]:
    """The arguments of a class whose `__init__` is made of its fields."""
    written: dict[str, str] = {}
    for single in reversed([c for c in item.__mro__ if c.__module__.startswith("heliograph")]):
        body = ast.parse(textwrap.dedent(inspect.getsource(single))).body[0].body
        written |= {n.target.id: ast.unparse(n.annotation) for n in body if isinstance(n, ast.AnnAssign)}
    try:
        known = inspect.signature(item).parameters
    except (TypeError, ValueError):
        return "()", ""
    return f"({', '.join(_argument(p, written.get(name)) for name, p in known.items() if name != 'self')})", ""


def _argument(parameter: inspect.Parameter, kind: str | None) -> str:
    text = parameter.name if kind is None else f"{parameter.name}: {kind}"
    if parameter.default is inspect.Parameter.empty:
        return text
    plain = isinstance(parameter.default, int | float | str | tuple | None)
    return f"{text} = {parameter.default!r}" if plain else f"{text} = ..."


def link_names(app, doctree, page):
    """Make a link of every public name in the pages' code type: `hg.ROOM.NAME`, or a NAME that is no plain word."""
    objects = app.env.get_domain("py").objects
    for node in [n for n in doctree.findall(nodes.literal) if not isinstance(n.parent, nodes.reference)]:
        text = node.astext().split("(")[0]
        name = text.rsplit(".", 1)[-1]
        known = objects.get(PLACES.get(name, ""))
        root = text.split(".")[0]
        # Another package's or object's, such as kf.rts_smoother.
        foreign = "." in text and root not in ("hg", "heliograph") and root[:1].islower()
        plain = not text.startswith("hg.") and name.islower() and "_" not in name
        if known and not plain and not foreign and known.docname != page and re.fullmatch(r"[\w.]+", text):
            address = f"{app.builder.get_relative_uri(page, known.docname)}#{known.node_id}"
            node.replace_self(nodes.reference("", "", node.deepcopy(), internal=True, refuri=address))


def connect(app: object) -> None:
    """Let autodoc use these signatures and docstrings, and pages link to them."""
    app.connect("doctree-read", index_words)
    app.connect("doctree-resolved", link_names)
    app.connect("autodoc-process-signature", _on_signature)
    app.connect("autodoc-process-docstring", _on_docstring)


def index_words(app, doctree):
    """Put each word of the first page's table of words into the site's index, at its row."""
    if app.env.docname != "index":
        return
    words = next(section for section in doctree.findall(nodes.section) if "words" in section["ids"])
    for number, row in enumerate(next(words.findall(nodes.tbody)).children):
        cell = row.children[0]
        anchor = f"words-{number}"
        cell.insert(0, nodes.target("", "", ids=[anchor]))
        entries = [("single", word, anchor, "", None) for word in cell.astext().strip().split(", ")]
        app.env.get_domain("index").entries["index"] += entries


def _on_signature(app, what, name, item, options, arguments, result):
    try:
        return signature(item) if what in ("class", "function", "method") else None
    except (OSError, TypeError, IndentationError):  # no source: what a decorator made
        return None


def _on_docstring(app, what, name, item, options, lines):
    lines[:] = restructured(lines)
