"""Files of text: their kind by name, packed or not, in which Unicode they are, and what in them is no text."""

import codecs
import gzip
import re
import zlib
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from itertools import islice
from pathlib import Path
from typing import TextIO, TypeVar

from heliograph.numerics.check import InputError, fail

T = TypeVar("T")
PACKED = ".gz"
GZIP = b"\x1f\x8b"  # the first bytes of what is packed
WIDE = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
NO_TEXT = re.compile("[\x00\udc80-\udcff\ufffd]")  # bytes that are no text, as they are escaped


class CutOffError(InputError):
    """A text that ends before its end, or is damaged from somewhere on; what came before may be used."""


def kind_of(path: Path) -> str:
    """Return the extension of a file in small letters: before .gz where it is packed, ".csv" of a table in a .txt."""
    kind = (path.with_suffix("") if path.suffix.lower() == PACKED else path).suffix.lower()
    return ".csv" if kind == ".txt" and path.is_file() and _begins_as_table(path) else kind


def _begins_as_table(path: Path) -> bool:
    """Return whether the first line of a text names columns, and the second has as many cells, one of them a value."""
    try:
        with open_text(path) as text:
            header, *rows = islice((line.strip() for line in text if line.strip()), 2)
    except (OSError, ValueError):
        return False
    names = header.split(",")
    if header.startswith("#"):  # a comment, of which the reader of tables says what to do
        return len(names) > 1
    words = all(re.fullmatch(r"[^\W\d][^{}\[\]:]*", name.strip().strip('"')) for name in names)
    return len(names) > 1 and words and all(len(row.split(",")) == len(names) for row in rows)


def guess_encoding(start: bytes) -> str:
    """Return the encoding of a text by its first two bytes: UTF-16 by its mark or by a NUL beside a letter."""
    if start.startswith(WIDE):
        return "utf-16"
    low, high = (*start[:2], 1, 1)[:2]
    if 0 in (low, high) and low != high:
        return "utf-16-be" if low == 0 else "utf-16-le"
    return "utf-8-sig"


def is_text(line: str) -> bool:
    """Return whether a line was text, and not bytes that had to be escaped."""
    return (line.isascii() and "\0" not in line) or NO_TEXT.search(line) is None


@contextmanager
def open_text(path: Path) -> Iterator[TextIO]:
    """Open a file of text in UTF-8 or UTF-16, packed or not; bytes that are no text are escaped.

    Raises:
        CutOffError: a packed file that is damaged or cut off, from there on.
    """
    with path.open("rb") as file:
        packed = file.read(len(GZIP)) == GZIP
    try:
        with gzip.open(path, "rb") if packed else path.open("rb") as file:
            encoding = guess_encoding(file.read(len(WIDE[0])))
        errors = "surrogateescape" if encoding == "utf-8-sig" else "replace"
        if packed:
            with gzip.open(path, "rt", newline="", encoding=encoding, errors=errors) as text:
                yield text
        else:
            with path.open(newline="", encoding=encoding, errors=errors) as text:
                yield text
    except (gzip.BadGzipFile, EOFError, zlib.error) as error:
        raise CutOffError(str(fail(str(path), "a packed file without damage", _shorten(error)))) from None


def yield_until_cut_off(parts: Iterable[T]) -> Iterator[T | CutOffError]:
    """Yield parts of a text, and at last why they end before its end, if they do.

    Raises:
        CutOffError: nothing came before.
    """
    some = False
    try:
        for part in parts:
            some = True
            yield part
    except CutOffError as error:
        if not some:
            raise
        yield error


def _shorten(error: Exception) -> str:
    """Return in words what is wrong with a packed file."""
    return "one that was cut off" if isinstance(error, EOFError) else str(error)
