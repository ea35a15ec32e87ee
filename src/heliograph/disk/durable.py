"""Files that are there as a whole or not at all, also after the power went."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path


def sync(path: Path) -> None:
    """Have what is written to a file or folder on the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def sync_tree(folder: Path) -> None:
    """Have a folder with all that is in it on the disk."""
    for path in (*folder.rglob("*"), folder):
        sync(path)


def replace(partial: Path, path: Path) -> None:
    """Put a file that is whole in the place of another, or of none."""
    sync(partial)
    os.replace(partial, path)
    sync(path.parent)


@contextmanager
def naming(path: Path | str) -> Iterator[None]:
    """Have errors of the system name the file, folder or stream that they are about: a full disk does not."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(path)
        raise
