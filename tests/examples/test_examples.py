"""An example is one file in the folder: nothing else has to know it."""

import pytest

from heliograph import examples

HELLO = """\"\"\"Says hello.

More of it.
\"\"\"

import jax


def example(out, seed):
    (out / "hello").mkdir()
    (out / "hello" / "summary.json").write_text(str(seed))
"""


def test_a_file_is_an_example(tmp_path, monkeypatch):
    folder = tmp_path / "examples"
    folder.mkdir()
    (folder / "say_hello.py").write_text(HELLO)
    monkeypatch.setattr(examples, "__path__", [str(folder)])
    assert examples.examples() == {"say-hello": "Says hello."}
    examples.load_example("say-hello")(tmp_path, 3)
    assert (tmp_path / "hello" / "summary.json").read_text() == "3"


def test_every_example_says_what_it_shows():
    found = examples.examples()
    assert "demo" in found and list(found) == sorted(found)
    assert all(len(text) > 20 and text.endswith(".") for text in found.values())
    with pytest.raises(ValueError, match=r"example: expected one of .*demo, .*, got 'nothing'"):
        examples.load_example("nothing")
