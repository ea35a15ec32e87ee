"""The words of identifiers: the field's standard terms, and no private ones."""

import re
import tokenize
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
VAGUE = {"own", "found", "kept", "wanted", "asked", "one", "each", "many"}  # as a whole identifier
OTHERS = {"one", "retain"}  # attributes of another library's objects, used as theirs


def parts(name: str) -> set[str]:
    """The words of an identifier, in small letters; the name of a test is a sentence, in which "whose" is a pronoun."""
    words = {part.lower() for part in re.split(r"_|(?<=[a-z])(?=[A-Z])", name)}
    return words - {"whose"} if name.startswith("test_") else words


def identifiers(path: Path) -> set[tuple[str, bool]]:
    """Each identifier of a file, and whether it is a method or attribute of something."""
    with tokenize.open(path) as lines:
        tokens = list(tokenize.generate_tokens(lines.readline))
    return {
        (token.string, before.string == ".")
        for before, token in zip([tokens[0], *tokens], tokens, strict=False)
        if token.type == tokenize.NAME
    }


@pytest.mark.parametrize("root", ROOTS, ids=lambda root: root.name)
def test_no_identifier_is_a_private_word(root):
    wrong = {
        f"{path.relative_to(root)}: {name}"
        for path in [*root.rglob("*.py"), *root.rglob("*.pyi")]
        for name, of_another in identifiers(path)
        if not (of_another and name in OTHERS) and (parts(name) & PRIVATE or name.lower().strip("_") in VAGUE)
    }
    assert not wrong, "\n".join(sorted(wrong))
