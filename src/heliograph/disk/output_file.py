"""Check that a file can be written before the work starts."""

import tempfile
from collections.abc import Sequence
from pathlib import Path

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
