"""Compiled programs kept on disk, so that a second process does not compile them again."""

import os
import sys
from pathlib import Path

FOLDER = "JAX_COMPILATION_CACHE_DIR"
SHORTEST = "JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"
SECONDS = 0.1  # what compiles faster than this is not worth a file


def keep_compilations(folder: str | Path | None = None) -> Path:
    """Keep compiled programs in `folder` from now on, in this process and those it starts; returns the folder.

    Without `folder`: heliograph/compilations in the user's cache folder. The command line does this by itself; a
    library changes no settings unless asked. Where JAX_COMPILATION_CACHE_DIR is set, that folder is used and nothing is
    changed.

    Raises:
        ValueError: a folder that cannot be made.
    """
    if os.environ.get(FOLDER):
        return Path(os.environ[FOLDER])
    place = _default() if folder is None else Path(folder)
    try:
        place.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        from heliograph.numerics.check import fail  # it loads NumPy and JAX, for which --help need not wait

        raise fail(f"folder {place}", "one that can be made", error.strerror) from None
    os.environ[FOLDER] = str(place)
    shortest = float(os.environ.setdefault(SHORTEST, str(SECONDS)))
    if "jax" in sys.modules:  # it has read the environment already
        import jax

        jax.config.update(FOLDER.lower(), str(place))  # type: ignore[no-untyped-call]
        jax.config.update(SHORTEST.lower(), shortest)  # type: ignore[no-untyped-call]
    return place


def _default() -> Path:
    base = os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache"
    return Path(base) / "heliograph" / "compilations"
