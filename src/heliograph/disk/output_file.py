"""Checks that results can be written before the work starts, and a folder that appears whole or not at all."""

import re
import shutil
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager, suppress
from glob import escape as glob_escape
from pathlib import Path

from heliograph.disk.holding import LOCK, held
from heliograph.disk.whole_file import naming, sync, sync_tree
from heliograph.numerics.check import fail

FORMATS = (".csv", ".parquet")


def check_output(path: str | Path, formats: Sequence[str] = FORMATS) -> None:
    """Raise the error that writing the file would raise, before the work starts.

    Args:
        path: file to be written.
        formats: extensions that are allowed.

    Raises:
        ValueError: another extension, a folder at `path`, a folder that is missing or cannot be written.
    """
    path = Path(path)
    if format_of(path, formats) == ".parquet":
        import pyarrow.parquet  # noqa: F401
    if path.is_dir():
        raise fail(f"output file {path}", "a file", "a folder")
    if not path.parent.exists():
        raise fail(f"output folder {path.parent}", "an existing folder", "nothing of that name")
    check_output_folder(path.parent)


def check_output_folder(folder: str | Path) -> None:
    """Raise ValueError unless files can be written in the folder, or it can be made."""
    folder = Path(folder)
    existing = next(place for place in (folder, *folder.absolute().parents) if place.exists())
    name = f"output folder {folder}"
    if not existing.is_dir():
        raise fail(name, "a folder", "a file" if existing == folder else f"a file {existing} on its path")
    try:
        tempfile.TemporaryFile(dir=existing).close()
    except OSError as error:
        raise fail(name, "a folder that can be written", error.strerror) from None


def format_of(path: Path, formats: Sequence[str] = FORMATS) -> str:
    """Return the extension of a file name in lower case, which determines the format.

    Raises:
        ValueError: an extension that is not among `formats`.
    """
    kind = path.suffix.lower()
    if kind not in formats:
        raise fail(str(path), f"a name that ends in {' or '.join(formats)}", repr(path.suffix))
    return kind


def check_replaceable(target: Path, mark: str) -> None:
    """Raise ValueError unless `target` can be written and is new, empty, or holds a file `mark`: earlier results."""
    check_output_folder(target)
    clear_left(target)
    if target.is_dir() and {p.name for p in target.iterdir()} - {LOCK} and not (target / mark).is_file():
        raise fail(f"output folder {target}", f"a new or empty folder, or one with {mark} to replace", "other files")


@contextmanager
def whole_folder(target: Path) -> Iterator[Path]:
    """Yield an empty folder that replaces `target` at the end; after an error or interrupt `target` is unchanged.

    Remains of killed processes that wrote the same folder are cleared first, and earlier results that one had moved
    aside are restored.
    """
    clear_left(target)
    made = [folder for folder in target.parents if not folder.exists()]
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
    # Write to a temporary folder in the same file system.
    new, old = partial / "new", partial / "old"
    try:
        new.mkdir()
        with held(partial), naming(target):
            yield new
            sync_tree(new)
        # Swap by two renames.
        if target.exists():
            target.rename(old)
        new.rename(target)
        sync(target.parent)
    except BaseException:
        # Undo: restore earlier results, remove everything that was made.
        if old.exists() and not target.exists():
            old.rename(target)
        shutil.rmtree(partial)
        for folder in made:
            with suppress(OSError):  # somebody else's files came into it meanwhile
                folder.rmdir()
        raise
    shutil.rmtree(partial)


def clear_left(target: Path) -> None:
    """Remove the temporary folders next to `target` that killed processes left, none that a running process uses."""
    for left in target.parent.glob(f".{glob_escape(target.name)}-*") if target.parent.is_dir() else ():
        if not re.fullmatch(r"-[a-z0-9_]{8}", left.name.removeprefix(f".{target.name}")) or not left.is_dir():
            continue
        with held(left) as ours:
            if not ours or {p.name for p in left.iterdir()} - {"new", "old"}:
                continue
            if (left / "old").exists() and not target.exists():
                (left / "old").rename(target)
            shutil.rmtree(left)
