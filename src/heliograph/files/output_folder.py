"""A folder of results that appears whole or not at all."""

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from heliograph.files.table import check_output_folder
from heliograph.numerics.check import fail


def check_replaceable(target: Path, mark: str) -> None:
    """Raise ValueError unless `target` can be written and is new, empty, or holds a file `mark`: earlier results."""
    check_output_folder(target)
    if target.is_dir() and any(target.iterdir()) and not (target / mark).is_file():
        raise fail(f"output folder {target}", f"a new or empty folder, or one with {mark} to replace", "other files")


@contextmanager
def whole_folder(target: Path) -> Iterator[Path]:
    """An empty folder that takes the place of `target` at the end; after an error or interrupt all is as it was."""
    made = [folder for folder in target.parents if not folder.exists()]
    target.parent.mkdir(parents=True, exist_ok=True)
    partial = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
    new, old = partial / "new", partial / "old"
    try:
        new.mkdir()
        yield new
        if target.exists():
            target.rename(old)
        new.rename(target)
    except BaseException:
        if old.exists() and not target.exists():
            old.rename(target)
        shutil.rmtree(partial)
        for folder in made:
            with suppress(OSError):  # somebody else's files came into it meanwhile
                folder.rmdir()
        raise
    shutil.rmtree(partial)
