"""Exclusive use of a file or folder by one process, through a lock that the system releases when the process ends."""

import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

try:
    import fcntl
except ImportError:  # no such system call: then nothing is held, and what others left is never cleared
    fcntl = None  # type: ignore[assignment]

LOCK = ".lock"


@contextmanager
def held(path: Path) -> Iterator[bool]:
    """Try to lock the file or folder at `path`; yields whether the lock was obtained."""
    try:
        handle = os.open(path, os.O_RDONLY)
    except FileNotFoundError:  # its holder has just removed it
        yield False
        return
    try:
        yield _lock(handle)
    finally:
        os.close(handle)


@contextmanager
def only_here(folder: Path) -> Iterator[bool]:
    """Lock a folder by a lock file in it; yields whether the lock was obtained.

    The lock file is removed with the lock, and so are folders that were made for it and stayed empty. A killed process
    leaves the file, which then locks nothing.
    """
    made = [place for place in (folder, *folder.parents) if not place.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / LOCK
    try:
        while True:
            # Lock the file that is opened.
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
            if not _lock(handle):
                os.close(handle)
                yield False
                return
            # The path must still name the locked file: another process may have removed it.
            with suppress(FileNotFoundError):
                if os.path.sameopenfile(handle, other := os.open(path, os.O_RDONLY)):
                    os.close(other)
                    break
                os.close(other)
            os.close(handle)  # a holder before us has removed the file that we opened
        try:
            yield True
        finally:
            path.unlink(missing_ok=True)
            os.close(handle)
    finally:
        for place in made:
            with suppress(OSError):  # something is in it
                place.rmdir()


def _lock(handle: int) -> bool:
    if fcntl is None:
        return True
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True
