"""A file that appears whole or not at all."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from glob import escape as glob_escape
from pathlib import Path

from heliograph.disk.durable import naming, replace


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A temporary file beside `path` that takes its place at the end and is removed after an error or interrupt."""
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    for left in path.parent.glob(f".{glob_escape(path.name)}.*.partial"):
        if not _lives(left.name.split(".")[-2]):
            left.unlink(missing_ok=True)
    try:
        with naming(path):
            yield partial
            replace(partial, path)
    except BaseException:
        partial.unlink(missing_ok=True)
        raise


def _lives(process: str) -> bool:
    """Whether a process of this number runs; what others left is theirs where that cannot be told."""
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return False
    except (ValueError, OSError):
        return True
    return True
