"""A folder of results that appears whole or not at all."""

import re
import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from glob import escape as glob_escape
from pathlib import Path

from heliograph.disk.durable import naming, sync, sync_tree
from heliograph.disk.holding import LOCK, held
from heliograph.disk.output_file import check_output_folder
from heliograph.numerics.check import fail


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
