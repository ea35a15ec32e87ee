"""Docstrings and comments: a first line that stands alone, every parameter of what is public, and the field's words."""

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path

import pytest

import heliograph
import heliograph_studies

SOURCE = Path(heliograph.__file__).parent
FIRST = {
    "what", "which", "where", "how", "whether", "those", "it", "its", "that", "this", "these", "there", "if",
    "when", "who", "whom", "whose", "as", "of", "in", "with", "without", "for", "from", "to", "by", "at", "on",
    "before", "after", "behind", "beyond", "and", "or", "but", "not", "so", "than", "then", "thus", "too",
    "because", "while", "until", "unless", "such", "among", "above", "below", "during", "since",
}  # no noun and no verb begins with these  # fmt: skip
PRIVATE = re.compile(
    r"\b(told|heard|hears|hearing|foretell\w*|foretold|mould|tape|ears|antenna\w*|shadows?|nowhere|revealed|retain\w*|"
    r"surprise\w*|purchases?|beside|settles?|settled)\b",
    re.IGNORECASE,
)
ARRAY = re.compile(r"\b(np\.ndarray|jax\.Array|ArrayLike|Array)\b")
SHAPED = re.compile(r"(Float|Int|Bool|Shaped|Num|Real|Inexact)\[[^\[\]]*\]")
DEFAULT = re.compile(
    r"default|None|unless|if not|else|without|empty|by itself|omitted|otherwise"
)  # said of a parameter
LONG = 15  # lines of a function that needs a comment above its steps
STEP = 14  # statements of a step
SHARE = 0.95  # of public array annotations that carry a shape: others take numbers of any
Function = ast.FunctionDef | ast.AsyncFunctionDef
PATHS = sorted(SOURCE.rglob("*.py"))
ROOTS = (Path(heliograph_studies.__file__).parent, Path(__file__).parent)
OTHERS = sorted(path for root in ROOTS for path in root.rglob("*.py"))


@cache
def parsed(path: Path) -> ast.Module:
    """A file, read once for all tests."""
    return ast.parse(path.read_text())


@cache
def definitions(path: Path) -> list[Function | ast.ClassDef]:
    """Every function and class of a file."""
    nodes = ast.walk(parsed(path))
    return [node for node in nodes if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef)]


def names_of(room: Path) -> set[str]:
    """The public names of a room."""
    stub = room / "__init__.pyi"
    return set(re.findall(r"\w+ as (\w+)", stub.read_text())) if stub.exists() else set()


def public() -> Iterator[tuple[Path, Function | ast.ClassDef]]:
    """Public functions and classes, by the file that defines them."""
    for path in PATHS:
        names = names_of(SOURCE / path.relative_to(SOURCE).parts[0]) if path.parent != SOURCE else set()
        for node in parsed(path).body:
            if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef) or node.name not in names:
                continue
            if not any(ast.unparse(decorator) == "overload" for decorator in node.decorator_list):
                yield path, node


def maker(node: Function | ast.ClassDef) -> Function | None:
    """The function whose parameters a caller gives."""
    if not isinstance(node, ast.ClassDef):
        return node
    return next((m for m in node.body if isinstance(m, ast.FunctionDef) and m.name == "__init__"), None)


def parameters(node: Function | ast.ClassDef) -> list[str]:
    """Names that a caller gives: of a function, of a class's constructor, or of the fields of a record."""
    made = maker(node)
    if made is None:
        assert isinstance(node, ast.ClassDef)
        fields = (part.target for part in node.body if isinstance(part, ast.AnnAssign))
        return [field.id for field in fields if isinstance(field, ast.Name) and not field.id.startswith("_")]
    every = made.args.posonlyargs + made.args.args + made.args.kwonlyargs
    return [a.arg for a in every if a.arg not in ("self", "cls")]


@pytest.mark.slow
def test_docstrings_begin_with_a_noun_or_a_verb_and_have_no_private_word():
    wrong = []
    for path, node in ((file, node) for file in PATHS for node in (parsed(file), *definitions(file))):
        text = ast.get_docstring(node) or ""
        first = re.match(r"[\W_]*([\w']+)", text)
        if (first and first[1].lower() in FIRST) or PRIVATE.search(text):
            where = f"{path.relative_to(SOURCE)}: {getattr(node, 'name', 'module')}"
            wrong.append(f"{where}: {text.splitlines()[0]}")
    assert not wrong, "\n".join(wrong)


@pytest.mark.slow
def test_docstrings_of_studies_and_tests_have_no_private_word():
    """But "beside" for a place: "figures, and what the page says beside the numbers"."""
    wrong = {
        f"{path}: {getattr(node, 'name', 'module')}: {used[0]}"
        for path in OTHERS
        for node in [parsed(path), *definitions(path)]
        if (used := [word for word in PRIVATE.findall(ast.get_docstring(node) or "") if word.lower() != "beside"])
    }
    assert not wrong, "\n".join(sorted(wrong))


def longest_step(node: Function, lines: list[str]) -> int:
    """Number of statements that follow each other without a comment, at most; 0 of a function that needs none."""
    inside = node.body[bool(ast.get_docstring(node)) :]
    if not inside or node.end_lineno - inside[0].lineno + 1 <= LONG:
        return 0
    docstrings = {n.body[0].lineno for n in ast.walk(node) if isinstance(n, Function) and ast.get_docstring(n)}
    starts = sorted(n.lineno for n in ast.walk(node) if isinstance(n, ast.stmt) and n is not node)
    above = node.body[0].end_lineno if inside[0] is not node.body[0] else node.lineno  # a comment may stand first
    longest = count = 0
    for start in (line for line in starts if line not in docstrings):
        steps = any(re.search(r"^ *#|  # ", line) for line in lines[above:start])
        count, above = 1 if steps else count + 1, max(above, start)
        longest = max(longest, count)
    return longest


@pytest.mark.slow
def test_a_long_function_has_a_comment_above_its_steps():
    """A step is at most STEP statements, so that no comment stands for half a page."""
    wrong = []
    for path in PATHS:
        lines = path.read_text().splitlines()
        functions = [node for node in definitions(path) if not isinstance(node, ast.ClassDef)]
        long = [f"{node.name}: {count}" for node in functions if (count := longest_step(node, lines)) > STEP]
        wrong += [f"{path.relative_to(SOURCE)}: {name}" for name in long]
    assert not wrong, "\n".join(wrong)


def test_every_parameter_of_what_is_public_is_in_its_docstring():
    wrong = []
    for path, node in public():
        made = maker(node)
        text = (ast.get_docstring(node) or "") + ((ast.get_docstring(made) or "") if made else "")
        missing = [name for name in parameters(node) if not re.search(rf"\b{re.escape(name)}\b", text)]
        wrong += [f"{path.relative_to(SOURCE)}: {node.name}: {', '.join(missing)}"] if missing else []
    assert not wrong, "\n".join(wrong)


def test_arrays_of_public_functions_carry_shapes():
    shaped, bare = 0, []
    for path, node in public():
        made = maker(node)
        for a in made.args.posonlyargs + made.args.args + made.args.kwonlyargs if made else []:
            text = ast.unparse(a.annotation) if a.annotation else ""
            if ARRAY.search(SHAPED.sub("", text)):
                bare.append(f"{path.relative_to(SOURCE)}: {node.name}: {a.arg}: {text}")
            elif ARRAY.search(text):
                shaped += 1
    assert shaped >= SHARE * (shaped + len(bare)), "\n".join(bare)


def entries(text: str) -> dict[str, str]:
    """Descriptions under `Args:` by parameter."""
    block = text.split("Args:\n", 1)[1].split("\n\n")[0] if "Args:\n" in text else ""
    return {name: " ".join(words.split()) for name, words in re.findall(r"^ {4}(\w+): ((?:.|\n {5,})*)", block, re.M)}


def test_parameters_of_public_functions_have_an_entry_each_that_says_the_default():
    wrong = []
    for path, node in public():
        if isinstance(node, ast.ClassDef):
            continue
        described, args = entries(ast.get_docstring(node) or ""), node.args
        positional = args.posonlyargs + args.args
        optional = [*positional[len(positional) - len(args.defaults) :]]
        optional += [a for a, default in zip(args.kwonlyargs, args.kw_defaults, strict=True) if default is not None]
        lacking = [name for name in parameters(node) if name not in described]
        unsaid = [a.arg for a in optional if not DEFAULT.search(described.get(a.arg, ""))]
        wrong += [f"{path.relative_to(SOURCE)}: {node.name}: {', '.join(lacking + unsaid)}"] if lacking + unsaid else []
    assert not wrong, "\n".join(wrong)
