"""One process at a time: a file or folder held by a lock that the system takes back when its process ends, however."""

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
    """Hold what is there at `path`, if nobody else does; says whether it is held."""
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
    """Hold a folder by a file in it, which goes with the lock; a folder that was made for it and stayed empty goes too.

    A process that is killed leaves the file, which then holds nothing.
    """
    made = [place for place in (folder, *folder.parents) if not place.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / LOCK
    try:
        while True:
            handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
            if not _lock(handle):
                os.close(handle)
                yield False
                return
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
