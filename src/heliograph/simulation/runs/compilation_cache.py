"""Cache of compiled programs on disk, so that a second process does not compile them again."""

import os
import sys
from pathlib import Path

FOLDER = "JAX_COMPILATION_CACHE_DIR"
SHORTEST = "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"
PRIVATE, OTHERS_WRITE = 0o700, 0o022
SECONDS = 0.1  # what compiles faster than this is not worth a file


def keep_compilations(folder: str | Path | None = None) -> Path:
    """Store compiled programs in `folder` from now on, in this process and those it starts; return the folder.

    Without `folder`: heliograph/compilations in the user's cache folder. The command line does this by itself; a
    library changes no settings unless asked. Where JAX_COMPILATION_CACHE_DIR is set, that folder is used and nothing is
    changed. Stored programs are executed: the folder is made for its user alone, and closed to others where it was
    open.

    Args:
        folder: for the programs (default: heliograph/compilations in the user's cache folder).

    Raises:
        ValueError: a folder that cannot be made, or that belongs to another user; no folder, and no home.
    """
    if os.environ.get(FOLDER):
        return Path(os.environ[FOLDER])
    path = _find_default_folder() if folder is None else Path(folder)
    _make_private(path)
    # Settings for JAX, read from the environment or changed where it is loaded already.
    os.environ[FOLDER] = str(path)
    shortest = float(os.environ.setdefault(SHORTEST, str(SECONDS)))
    if "jax" in sys.modules:  # it has read the environment already
        import jax

        jax.config.update(FOLDER.lower(), str(path))  # type: ignore[no-untyped-call]
        jax.config.update(SHORTEST.lower(), shortest)  # type: ignore[no-untyped-call]
    return path


def _find_default_folder() -> Path:
    """Return the user's folder for compiled programs, in $XDG_CACHE_HOME or in ~/.cache.

    It raises ValueError if neither is known.
    """
    if os.environ.get("XDG_CACHE_HOME"):
        return Path(os.environ["XDG_CACHE_HOME"]) / "heliograph" / "compilations"
    try:
        return Path.home() / ".cache" / "heliograph" / "compilations"
    except RuntimeError:
        raise _make_error("folder for compiled programs", "one, or a home folder to make it in", "neither") from None


def _make_private(path: Path) -> None:
    """Make a folder to which only its owner can write; raise ValueError if it belongs to another user than root.

    PRIVATE: mode bits of a folder for its owner alone. OTHERS_WRITE: bits that let others write. Root is user 0.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        path.mkdir(mode=PRIVATE, exist_ok=True)
        status = path.stat()
        if hasattr(os, "getuid") and status.st_uid == os.getuid() and status.st_mode & OTHERS_WRITE:
            path.chmod(PRIVATE)  # an earlier release made folders to which others could write
            status = path.stat()
    except OSError as error:
        raise _make_error(f"folder {path}", "one that can be made", error.strerror) from None
    if hasattr(os, "getuid") and status.st_uid not in (os.getuid(), 0):
        raise _make_error(f"folder {path}", "the user's own", f"that of user {status.st_uid}")


def _make_error(name: str, expected: str, got: object) -> ValueError:
    """Return the error that the library's `fail` makes, importing it only now."""
    from heliograph.numerics.check import fail  # it loads NumPy and JAX, for which --help need not wait

    return fail(name, expected, got)
