"""Lines of CSV in which nothing but numbers and empty cells stands, all at once."""

import msgspec
import numpy as np

from heliograph.numerics.types import Float

NUMBERS = b"0123456789+-.eE"  # all that such cells are made of


def parse_numeric_lines(lines: bytes, columns: int) -> Float[np.ndarray, "rows columns"] | None:
    """Return the numbers of whole CSV lines, NaN for empty cells; None if any cell is not a plain number.

    The lines are made one list of JSON, whose decoder takes a fifteenth of the time of reading cell by cell. Lines that
    JSON does not take, with .5 or 007 or too few cells, are left to the slower reader of rows, which says why. NUMBERS
    are the characters of plain numbers: digits, signs, point and e.
    """
    body = lines.replace(b"\r\n", b"\n")
    if not body.endswith(b"\n"):
        body += b"\n"
    # Without its numbers each line is the commas between its cells.
    empty_line = b"," * (columns - 1) + b"\n"
    rows = body.count(b"\n")
    if body.translate(None, NUMBERS) != empty_line * rows:
        return None
    # Leave to the slower reader a line without any number, and -0, whose sign JSON would lose.
    if b"\n" + empty_line in b"\n" + body or b"-0," in body or b"-0\n" in body:
        return None
    # Write null into empty cells: between two commas (twice, since matches do not overlap), and at the ends of lines.
    body = body.replace(b",,", b",null,").replace(b",,", b",null,")
    body = body.replace(b",\n", b",null\n").replace(b"\n,", b"\nnull,")
    if body.startswith(b","):
        body = b"null" + body
    # One list for all lines, since a list for each line would cost the garbage collector more time than all the rest.
    try:
        cells = msgspec.json.decode(b"[" + body[:-1].replace(b"\n", b",") + b"]", type=list[float | None])
    except msgspec.DecodeError:
        return None
    return np.array(cells, dtype=np.float64).reshape(rows, columns)
