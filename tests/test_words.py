"""The words of identifiers: the field's standard terms, and no private ones."""

import ast
import re
from functools import cache
from pathlib import Path

import pytest

import heliograph
import heliograph_studies

ROOTS = [Path(heliograph.__file__).parent, Path(heliograph_studies.__file__).parent, Path(__file__).parent]
PRIVATE = {
    "told", "heard", "hears", "hearing", "foretell", "foretelling", "foretold", "settled", "settling", "settle",
    "mould", "tape", "ears", "air", "antenna", "shadow", "shadows", "whose", "nowhere", "keeping", "beside", "purchase",
    "purchases", "revealed", "retain", "retains", "smoother_steps", "retaining", "surprise", "surprises",
}  # as a part of an identifier too  # fmt: skip
PARTS = {"own", "wanted", "asked", "kept", "found"}  # as a part of one
VAGUE = PARTS | {"one", "each", "many"}  # as a whole identifier
HIDING = {"item", "part", "result", "local", "place", "thing"}  # what a name holds has a word of the field
# Parts of the plants, of which a process serves some, are called so; and the outcome beside what a paper prints.
SHOWN = {"serving/brokers/mqtt.py", "serving/brokers/nats.py", "serving/brokers/transport.py", "serving/running.py",
         "report/page.py"}  # fmt: skip
LIBRARIES = {"ModuleNotFoundError", "FileNotFoundError", "NotFoundError"}  # names of others
OTHERS = {"one", "retain"}  # attributes of another library's objects, used as theirs
# A text, a comment, or an identifier with the dot before it; Python's own tokenizer takes five times as long.
TOKEN = re.compile(r'''(?s:"""(?:\\.|[^\\])*?""")|"(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])*'|#.*|(\.?)\b([^\W\d]\w*)''')


def parts(name: str) -> set[str]:
    """The words of an identifier, in small letters; the name of a test is a sentence, in which "whose" is a pronoun."""
    words = {part.lower() for part in re.split(r"_|(?<=[a-z])(?=[A-Z])", name)}
    return words - {"whose"} if name.startswith("test_") else words


@cache
def is_private(name: str) -> bool:
    """Test whether an identifier is private or vague, or has a vague word as a part (a test's name is a sentence)."""
    vague = set() if name.startswith("test_") else parts(name) & PARTS
    return bool(parts(name) & PRIVATE or vague or name.lower().strip("_") in VAGUE)


def identifiers(path: Path) -> set[tuple[str, bool]]:
    """Each identifier of a file, and whether it is a method or attribute of something."""
    return {(name, dot == ".") for dot, name in TOKEN.findall(path.read_text()) if name}


@pytest.mark.parametrize("root", ROOTS, ids=lambda root: root.name)
def test_no_identifier_is_a_private_word(root):
    wrong = {
        f"{path.relative_to(root)}: {name}"
        for path in [*root.rglob("*.py"), *root.rglob("*.pyi")]
        for name, of_another in identifiers(path)
        if name not in LIBRARIES and not (of_another and name in OTHERS) and is_private(name)
    }
    assert not wrong, "\n".join(sorted(wrong))


def bound(tree: ast.AST) -> set[str]:
    """Names that code binds: variables, parameters, functions, and what a pattern matches."""
    names = set()
    for node in ast.walk(tree):
        match node:
            case ast.Name(id=name, ctx=ast.Store()) | ast.arg(arg=name) | ast.FunctionDef(name=name):
                names.add(name)
            case ast.MatchAs(name=str(name)) | ast.MatchStar(name=str(name)):
                names.add(name)
    return names


@pytest.mark.slow
def test_a_name_says_what_it_holds():
    """Of the library: "filter", "moments", "row", where "item" and "result" would do for anything."""
    wrong = {
        f"{name}: {', '.join(sorted(hiding))}"
        for path in ROOTS[0].rglob("*.py")
        if (name := path.relative_to(ROOTS[0]).as_posix()) not in SHOWN
        and (hiding := bound(ast.parse(path.read_text())) & HIDING)
    }
    assert not wrong, "\n".join(sorted(wrong))
    assert bound(ast.parse("def f(x, *, item): result = [part for part in x]")) == {"f", "x", "item", "result", "part"}
