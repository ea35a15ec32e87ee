"""Files that appear whole or not at all, together if there are several, also after a power failure."""

import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from glob import escape as glob_escape
from pathlib import Path


def sync(path: Path) -> None:
    """Flush a file or folder to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sync_tree(folder: Path) -> None:
    """Flush a folder with all its contents to the disk."""
    for path in (*folder.rglob("*"), folder):
        sync(path)


def replace(partial: Path, path: Path) -> None:
    """Move a complete file to `path`, atomically, over an existing file if there is one."""
    sync(partial)
    os.replace(partial, path)
    sync(path.parent)


@contextmanager
def naming(path: Path | str) -> Iterator[None]:
    """Add the path to errors of the system that lack one, such as that of a full disk."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(path)
        raise


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary file next to `path` that replaces it at the end; removed after an error or interrupt."""
    with whole_files([path]) as (partial,):
        yield partial


@contextmanager
def whole_files(paths: Sequence[Path]) -> Iterator[list[Path]]:
    """Yield temporary files next to several small ones, which they replace together, or not at all after an error."""
    partials = [path.with_name(f".{path.name}.{os.getpid()}.partial") for path in paths]
    for path in paths:
        _clear(path)
    replaced: list[tuple[Path, bytes | None]] = []
    try:
        with naming(paths[0]):
            yield partials
        # Replace one by one, with the earlier contents of all but the last.
        for partial, path in zip(partials, paths, strict=True):
            before = path.read_bytes() if path != paths[-1] and path.exists() else None
            with naming(path):
                replace(partial, path)
            replaced.append((path, before))
    except BaseException:
        # Undo: remove temporary files, restore those that were replaced.
        for partial in partials:
            partial.unlink(missing_ok=True)
        if len(replaced) < len(paths):
            for path, before in replaced:
                path.unlink() if before is None else path.write_bytes(before)
        raise


def _clear(path: Path) -> None:
    """Remove temporary files of processes that no longer run."""
    for left in path.parent.glob(f".{glob_escape(path.name)}.*.partial"):
        if not _lives(left.name.split(".")[-2]):
            left.unlink(missing_ok=True)


def _lives(process: str) -> bool:
    """Return whether a process of this number runs; True where that is unknown."""
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return False
    except (ValueError, OSError):
        return True
    return True
