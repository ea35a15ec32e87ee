"""Public names: short signatures, words of the glossary, and where to find what bears another name now."""

import inspect
import operator
import re
from importlib import import_module
from pathlib import Path

import heliograph
from tests.test_structure import PUBLIC, SOURCE, import_graph

ROOT = Path(__file__).parents[1]
GLOSSARY = ROOT / "docs" / "notation.md"
LONGEST = 300  # characters of a signature in `help()`
ENDINGS = ("s", "es", "d", "ed", "ing", "ings", "ion", "ions", "er", "ly", "ability", "able", "ness")


def test_signatures_are_short_enough_to_read():
    shown = {}
    for place, name in PUBLIC:
        try:
            signature = str(inspect.signature(getattr(import_module(place), name)))
        except (TypeError, ValueError):  # no callable, or one of another library without a signature
            continue
        shown[f"{place}.{name}"] = signature.replace("pathlib._local.", "pathlib.")  # so Python 3.13 alone
    assert len(shown) > 200
    long = {name: len(text) for name, text in shown.items() if len(text) >= LONGEST}
    assert not long, "\n".join(f"{name}: {size}" for name, size in sorted(long.items()))


def test_every_public_name_uses_words_of_the_glossary():
    """`GainAndNoise`, `gpb1_filter`: each part between underscores, capitals and digits, but for its ending."""
    known = glossary()
    names = [name for _, name in PUBLIC if name.lower() not in known]
    unknown = {name: lacking for name in names if (lacking := [w for w in words(name) if not stems(w) & known])}
    assert not unknown, "\n".join(f"{name}: {', '.join(lacking)}" for name, lacking in unknown.items())
    assert "foretold" not in known and not stems("tape") & known  # it can fail


def glossary() -> set[str]:
    """Stems of the second column of every table of the glossary, and of its list of plain words."""
    page = GLOSSARY.read_text()
    rows = [re.split(r"(?<!\\)\|", row)[1:-1] for row in page.splitlines() if row.startswith("| ")]
    columns = [row[1] for row in rows if len(row) == 5]
    plain = page.split("Plain words", 1)[1].split(":", 1)[1]
    listed = re.findall(r"[a-z]+", " ".join([*columns, plain]).lower())
    return set().union(*map(stems, listed))


def words(name: str) -> list[str]:
    """Parts of a name in small letters."""
    return [part.lower() for part in re.findall(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+", name)]


def stems(word: str) -> set[str]:
    """The word itself, and it without an ending of plurals, verbs and adjectives."""
    return {word} | {word.removesuffix(end) for end in ENDINGS if len(word) - len(end) >= 3 and word.endswith(end)}


def test_what_has_another_name_now_is_there_under_it():
    """Names of heliograph in the second column of the table exist."""
    page = (ROOT / "CONTRIBUTING.md").read_text().split("\n## What has another name now")[1]
    rows = [row.strip("|").split(" | ") for row in page.splitlines() if row.startswith("| `")]
    names = [name for row in rows for name in re.findall(r"`hg((?:\.\w+)+)`", row[1])]
    assert len(names) > 10
    for name in names:
        operator.attrgetter(name[1:])(heliograph)


def test_the_files_that_a_newcomer_is_led_to_are_there():
    page = (ROOT / "CONTRIBUTING.md").read_text().split("\n## Find the file")[1].split("\n## ")[0]
    rows = [row for row in page.splitlines() if row.startswith("| ") and "`" in row]
    files = [name for row in rows for name in re.findall(r"`([\w/]+\.py)`", row)]
    assert len(files) > 16 and not [name for name in files if not (SOURCE / name).exists()]
    # Where a row names a function too, it is in the row's first file.
    for row in rows:
        for function in re.findall(r"`(\w+)` (?:of|in) ", row):
            text = (SOURCE / re.findall(r"`([\w/]+\.py)`", row)[0]).read_text()
            assert re.search(rf"^ *(def {function}\(|{function}[:,])|[(,] ?{function}: ", text, re.M), row


def test_each_file_of_a_walk_imports_an_earlier_one_or_is_imported_by_it():
    """Directly or through others: else the walk through the library leads where its calls do not go."""
    graph = import_graph()
    walks = re.split(r"\n\d\. ", (SOURCE / "README.md").read_text().split("\nThree walks")[1].split("\n<!--")[0])[1:]
    assert len(walks) == 3
    for walk in walks:
        files = [f"heliograph.{name}".replace("/", ".") for name in re.findall(r"`([\w/]+)\.py`", walk)]
        reached = {name: reachable(graph, name) for name in files}
        for i, name in enumerate(files[1:], start=1):
            assert any(name in reached[other] or other in reached[name] for other in files[:i]), name


def reachable(graph: dict[str, set[str]], start: str) -> set[str]:
    """Return all that `start` leads to, itself too."""
    found, left = {start}, [start]
    while left:
        new = graph[left.pop()] - found
        found |= new
        left += new
    return found
