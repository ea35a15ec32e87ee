"""Pieces of a long computation, kept one by one, so that a run that was stopped goes on where it was."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

from heliograph.disk.whole_file import whole_file

T = TypeVar("T")


def stored(path: Path, work: Callable[[], T]) -> T:
    """What was found before, or is now; JSON holds all of it."""
    if path.exists():
        before: T = json.loads(path.read_text(encoding="utf-8"))
        return before
    result = work()
    with whole_file(path) as partial_file:
        partial_file.write_text(json.dumps(result), encoding="utf-8")
    return result
