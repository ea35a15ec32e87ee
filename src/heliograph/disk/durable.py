"""Files that appear whole or not at all, also after a power failure."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
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
