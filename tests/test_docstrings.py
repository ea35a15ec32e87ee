"""Docstrings: a first line that stands alone, every parameter of what is public."""

import ast
import re
from collections.abc import Iterator
from pathlib import Path

import heliograph
from tests.map import BORDERS, parsed

SOURCE = Path(heliograph.__file__).parent
ARRAY = re.compile(r"\b(np\.ndarray|jax\.Array|ArrayLike|Array)\b")
SHAPED = re.compile(r"(Float|Int|Bool|Shaped|Num|Real|Inexact)\[[^\[\]]*\]")
# Said of a parameter.
DEFAULT = re.compile(r"default|None|unless|if not|else|without|empty|by itself|omitted|otherwise")
SHARE = 0.95  # of public array annotations that carry a shape: others take numbers of any
Function = ast.FunctionDef | ast.AsyncFunctionDef
PATHS = sorted(SOURCE.rglob("*.py"))


def names_of(room: Path) -> set[str]:
    """The public names of a room; none of one that users do not see."""
    stub = room / "__init__.pyi"
    seen = stub.exists() and room.name not in BORDERS
    return set(re.findall(r"\w+ as (\w+)", stub.read_text())) if seen else set()


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
