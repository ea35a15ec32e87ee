"""The stages of a study: named on the progress bar, kept on disk as they are done, and not done again."""

import pickle
import re
import shutil
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TypeVar

from heliograph.disk.atomic_files import whole_file
from heliograph.numerics.check import InputError, error_text, fail
from heliograph.report.progress import Advance

T = TypeVar("T")


class Stages:
    """Called with the name of each stage and its work, returns what the work gives, or gave when it was kept.

    What a stage returns is kept in `folder`, so it must be made of numbers, arrays, dataclasses and the like, not of
    functions; the next run of the same study with the same `key` finds it there. Without a folder or a key nothing is
    kept.
    """

    def __init__(self, study: str, advance: Advance, folder: Path | None = None, key: str | None = None) -> None:
        self.study, self.advance, self.key = study, advance, key
        self.folder = None if key is None else folder
        self.stage = "starting"

    def __call__(self, name: str, work: Callable[[], T], done: int = 0, total: int = 0) -> T:
        """Do the work, or read what it gave; `done` of `total` pieces of a stage that is done piece by piece."""
        self.stage = name
        self.advance(name, done, total)
        path = None if self.folder is None else self.folder / f"{re.sub('[^a-z0-9]+', '-', name.lower())}.{done}.pickle"
        if path is not None and path.is_file():
            stored = self._read(path, (self.key, name, done))
            if stored is not None:
                return stored[0]  # type: ignore[return-value]
        result = work()
        if path is not None:
            path.parent.mkdir(parents=True, exist_ok=True)
            with whole_file(path) as partial:
                partial.write_bytes(pickle.dumps((self.key, name, done)) + pickle.dumps(result))
        return result

    @contextmanager
    def failing_in_a_line(self) -> Iterator[None]:
        """Have an error within say in one line what was being done, and where the stages before it are.

        Raises:
            ValueError: instead of any error but those that say so themselves.
        """
        try:
            yield
        except (InputError, OSError, ModuleNotFoundError):
            raise
        except Exception as error:
            stored = self.folder is not None and self.folder.is_dir()
            where = f"; what was done before is kept in {self.folder}" if stored else ""
            raise fail(f"{self.study}, {self.stage}", "to be worked out", f"{error_text(error)}{where}") from error

    def progress(self, done: int, total: int) -> None:
        """Show how much of the present stage is done."""
        self.advance(self.stage, done, total)

    def clear(self) -> None:
        """Remove what is kept: all is done."""
        if self.folder is not None:
            shutil.rmtree(self.folder, ignore_errors=True)

    def _read(self, path: Path, label: tuple[str | None, str, int]) -> tuple[object] | None:
        """What is kept there, if it is that stage's of this study with this setting."""
        try:
            with path.open("rb") as file:
                return (pickle.load(file),) if pickle.load(file) == label else None
        except (OSError, EOFError, pickle.UnpicklingError, AttributeError, ImportError, ValueError, IndexError):
            return None
