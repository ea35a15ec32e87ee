"""A file that appears whole or not at all, and several that appear together."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from glob import escape as glob_escape
from pathlib import Path

from heliograph.disk.durable import naming, replace


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """A temporary file beside `path` that takes its place at the end and is removed after an error or interrupt."""
    with whole_files([path]) as (partial,):
        yield partial


@contextmanager
def whole_files(paths: Sequence[Path]) -> Iterator[list[Path]]:
    """Temporary files beside several small ones, which take their places together; after an error all is as it was."""
    partials = [path.with_name(f".{path.name}.{os.getpid()}.partial") for path in paths]
    for path in paths:
        _clear(path)
    replaced: list[tuple[Path, bytes | None]] = []
    try:
        with naming(paths[0]):
            yield partials
        for partial, path in zip(partials, paths, strict=True):
            before = path.read_bytes() if path != paths[-1] and path.exists() else None
            with naming(path):
                replace(partial, path)
            replaced.append((path, before))
    except BaseException:
        for partial in partials:
            partial.unlink(missing_ok=True)
        if len(replaced) < len(paths):
            for path, before in replaced:
                path.unlink() if before is None else path.write_bytes(before)
        raise


def _clear(path: Path) -> None:
    """Remove what processes left that do not live any more."""
    for left in path.parent.glob(f".{glob_escape(path.name)}.*.partial"):
        if not _lives(left.name.split(".")[-2]):
            left.unlink(missing_ok=True)


def _lives(process: str) -> bool:
    """Whether a process of this number runs; what others left is theirs where that cannot be told."""
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return False
    except (ValueError, OSError):
        return True
    return True
