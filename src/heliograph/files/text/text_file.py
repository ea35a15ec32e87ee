"""Files of text: their kind by name, packed or not, in which Unicode they are, and what in them is no text."""

import codecs
import gzip
import re
import zlib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from io import BufferedReader, StringIO, TextIOWrapper
from itertools import islice
from pathlib import Path
from typing import BinaryIO, TextIO, TypeAlias, TypeVar, cast

from heliograph.numerics.check import InputError, fail

T = TypeVar("T")
Progress: TypeAlias = Callable[[int, int], None]  # called with how much is done, and how much there is
PACKED = ".gz"
CANDUMP = ".candump"  # the kind of a .log of frames, as `candump -L` and `candump -l` write it
FRAME = re.compile(r"\(\d+\.\d+\) \S+ [0-9A-Fa-f]{3,8}#")  # how each of its lines begins
GZIP = b"\x1f\x8b"  # the first bytes of what is packed
OTHER_KINDS = {  # what files begin with that are no text: what they are
    b"PAR1": "a Parquet file",
    b"\x89MCAP": "a bag",
    b"SQLite format 3": "a bag",
    b"#ROSBAG": "a bag",
    b"PK\x03\x04": "a file of zip",
    b"BZh91AY&SY": "a file of bzip2",
    b"\xfd7zXZ": "a file of xz",
    b"\x28\xb5\x2f\xfd": "a file of zstd",
    b"7z\xbc\xaf": "a file of 7z",
}
WIDE = (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)
DAMAGE = (gzip.BadGzipFile, EOFError, zlib.error)  # of a packed file
NO_TEXT = re.compile("[\x00\udc80-\udcff\ufffd]")  # bytes that are no text, as they are escaped


class CutOffError(InputError):
    """A text that ends before its end, or is damaged from somewhere on; what came before may be used."""


def find_extension(path: Path) -> str:
    """Return the extension of a file in small letters; where the name does not tell, what the file's text begins like.

    It is that before .gz of a packed file, ".csv" of a table in a .txt, and CANDUMP of frames of a CAN bus in a .log.
    PACKED is .gz.
    """
    if path.suffix.lower() == ".log" and path.is_file() and _begins_as_frames(path):
        return CANDUMP
    kind = (path.with_suffix("") if path.suffix.lower() == PACKED else path).suffix.lower()
    return ".csv" if kind == ".txt" and path.is_file() and _begins_as_table(path) else kind


def _begins_as_table(path: Path) -> bool:
    """Return whether a text begins like a table: the first line names columns, and the second has as many cells."""
    try:
        with open_text(path) as text:
            header, *rows = islice((line.strip() for line in text if line.strip()), 2)
    except (OSError, ValueError):
        return False
    names = header.split(",")
    if header.startswith("#"):  # a comment; the reader of tables will say what to do
        return len(names) > 1
    are_words = all(re.fullmatch(r"[^\W\d][^{}\[\]:]*", name.strip().strip('"')) for name in names)
    return len(names) > 1 and are_words and all(len(row.split(",")) == len(names) for row in rows)


def _begins_as_frames(path: Path) -> bool:
    """Return whether the first line of a text is a frame of a CAN bus: "(1790000000.020000) can0 1A0#100E0100".

    FRAME is the pattern of how such a line begins.
    """
    try:
        with open_text(path) as text:
            return FRAME.match(next((line.strip() for line in text if line.strip()), "")) is not None
    except (OSError, ValueError):
        return False


def guess_encoding(start: bytes) -> str:
    """Return the encoding of a text by its first two bytes: UTF-16 by its mark or by a NUL beside a letter.

    WIDE are the two marks of UTF-16; "utf-8-sig" is UTF-8, with its mark or without.
    """
    if start.startswith(WIDE):
        return "utf-16"
    first_byte, second_byte = (*start[:2], 1, 1)[:2]  # a shorter text is filled up with 1, which is not NUL
    if 0 in (first_byte, second_byte) and first_byte != second_byte:
        return "utf-16-be" if first_byte == 0 else "utf-16-le"
    return "utf-8-sig"


def is_valid_text(line: str) -> bool:
    """Return whether a line is text, without NUL and without bytes that had to be escaped or replaced in decoding."""
    return (line.isascii() and "\0" not in line) or NO_TEXT.search(line) is None


@contextmanager
def open_text(path: Path) -> Iterator[TextIO]:
    """Open a text file in UTF-8 or UTF-16, packed or not; bytes that are no valid text are escaped or replaced.

    DAMAGE are the errors of a damaged packed file; WIDE are the marks of UTF-16, by which the encoding is guessed.

    Raises:
        CutOffError: a packed file is damaged or was cut off; raised when reading reaches this place.
    """
    try:
        with path.open("rb") as file, _open_unpacked(file) as unpacked:
            encoding = guess_encoding(unpacked.peek(len(WIDE[0])))  # look at as many bytes as UTF-16's mark has
            errors = "surrogateescape" if encoding == "utf-8-sig" else "replace"
            with TextIOWrapper(unpacked, newline="", encoding=encoding, errors=errors) as text:
                yield text
    except DAMAGE as error:
        raise _describe_damage(path, error) from None


def read_line_blocks(path: Path, size: int, progress: Progress | None = None) -> Iterator[bytes]:
    """Yield the lines of a text file, converted to UTF-8, in blocks of whole lines of about `size` bytes.

    Bytes that are no valid text stay as they are; in a file in UTF-16 they become U+FFFD.

    Args:
        path: the file, packed by gzip or not.
        size: bytes of a block, before conversion.
        progress: called with how many bytes of the file are read, and of how many (default none).

    Raises:
        CutOffError: a packed file that is damaged or cut off; raised after the lines before the damage were yielded.
    """
    total = path.stat().st_size
    rest = b""  # beginning of a line whose end is in the next block
    ended, damage = False, None
    with path.open("rb") as file, _open_unpacked(file) as unpacked:
        try:
            decode = _make_decoder_to_utf8(unpacked)
        except DAMAGE as error:
            raise _describe_damage(path, error) from None
        while not ended:
            part, ended, damage = _read_bytes_of_part(unpacked, size)
            is_last = ended and damage is None
            text = rest + decode(part, is_last)
            # Whole lines end at the last line feed; the last line of an undamaged file needs none.
            end = len(text) if is_last else text.rfind(b"\n") + 1
            if progress is not None:
                progress(file.tell(), total)
            if end:
                yield text[:end]
            rest = text[end:]
    if damage is not None:
        raise _describe_damage(path, damage)


def _read_bytes_of_part(file: "gzip.GzipFile | BufferedReader", size: int) -> tuple[bytes, bool, Exception | None]:
    """Return (bytes, whether the file ends with them, error): at most `size` bytes, `size` unless the file ends.

    The error is None, or one of DAMAGE, which unpacking raises if the file is damaged or was cut off.
    """
    parts, length = list[bytes](), 0
    try:
        while length < size and (part := file.read1(size - length)):
            parts.append(part)
            length += len(part)
    except DAMAGE as error:
        return b"".join(parts), True, error
    return b"".join(parts), length < size, None


def _open_unpacked(file: BinaryIO) -> "gzip.GzipFile | BufferedReader":
    """Return a file to read the text from: the file itself, or one that unpacks it if it is packed by gzip.

    GZIP are the first bytes of a packed file. OTHER_KINDS maps those of other files to what they are; `peek` looks at
    bytes without taking them.

    Raises:
        ValueError: the file's first bytes are those of another kind (OTHER_KINDS).
    """
    buffered = cast(BufferedReader, file)
    start = buffered.peek(max(map(len, OTHER_KINDS)))
    for mark, kind in OTHER_KINDS.items():
        if start.startswith(mark):
            raise fail(str(buffered.name), "a text, as it is or packed by gzip", kind)
    return gzip.GzipFile(fileobj=file) if buffered.peek(len(GZIP)).startswith(GZIP) else buffered


def _make_decoder_to_utf8(text: "gzip.GzipFile | BufferedReader") -> Callable[[bytes, bool], bytes]:
    """Return a function (bytes, whether they are the last) -> bytes that converts a text to UTF-8 part by part.

    UTF-16 is converted. Any other text is passed on as it is, without UTF-8's byte order mark.
    """
    encoding = guess_encoding(text.peek(len(WIDE[0])))
    if encoding != "utf-8-sig":
        wide = codecs.getincrementaldecoder(encoding)("replace")
        return lambda part, ended: wide.decode(part, ended).encode()
    if text.peek(len(codecs.BOM_UTF8)).startswith(codecs.BOM_UTF8):
        text.read(len(codecs.BOM_UTF8))
    return lambda part, ended: part


def split_lines(text: bytes) -> list[str]:
    """Return the lines of a text in UTF-8, each with its end; bytes that are no text are escaped."""
    return list(StringIO(text.decode("utf-8", "surrogateescape"), newline=""))


def yield_until_cut_off(parts: Iterable[T]) -> Iterator[T | CutOffError]:
    """Yield parts of a text; if the text was cut off, yield the error as the last item.

    Raises:
        CutOffError: the text was cut off before its first part.
    """
    has_yielded = False
    try:
        for part in parts:
            has_yielded = True
            yield part
    except CutOffError as error:
        if not has_yielded:
            raise
        yield error


def _describe_damage(path: Path, error: Exception) -> CutOffError:
    """Return the error that names a packed file and says whether it was cut off or how it is damaged."""
    came = "one that was cut off" if isinstance(error, EOFError) else str(error)
    return CutOffError(str(fail(str(path), "a packed file without damage", came)))
