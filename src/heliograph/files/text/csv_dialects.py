"""Tables in dialects of CSV that are not read: how they are recognised, and the pandas call that rewrites them.

Such a table has names in comments, other separators than commas, or columns of the same name.
"""

import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from heliograph.files.text.text_file import is_valid_text, open_text
from heliograph.numerics.check import fail, show_value

SEPARATORS = {";": "semicolons", "\t": "tabs", "|": "bars"}
COMMENTS = ("#", "%")
# What programs write for no value: C's and C++'s words for no number, and those of spreadsheets and databases.
NO_VALUE = re.compile(
    r"[-+]?nan(?:\([a-z0-9]*\))?|[-+]?1\.#(?:q?nan|snan|ind)\d*|#?n/?a|null|none|nil|nat|-+|\?", re.IGNORECASE
)
FLAGS = {"true": True, "false": False}  # as pandas and others write them, in letters of any size
DAY_FIRST = re.compile(r"(\d{1,2})([./-])(\d{1,2})[./-]\d{2,4}(?:\D.*)?")
SEEN = 10_000  # characters in which a decimal comma is looked for


def check_distinct(source: object, header: Sequence[object]) -> None:
    """Raise ValueError if two columns have the same name."""
    twice = [name for name, count in Counter(header).items() if count > 1]
    if twice:
        raise fail(f"{source}, header", "distinct columns", f"{twice[0]!r} more than once")


def check_header(source: str, header: Sequence[str], path: Path | None, marked: bool) -> None:
    """Raise ValueError if the first line of a table does not name columns; the error says how to rewrite the table.

    Args:
        source: the name of the table, for errors.
        header: the fields of its first line.
        path: the file, if it can be read again: then the error says how to rewrite it. None else.
        marked: whether the first of several names may begin with a mark of comments, "#" or "%".
    """
    # Bytes that are no text, a comment, names with another separator, names twice, or numbers alone.
    line = ",".join(header)
    if not is_valid_text(line):
        raise fail(
            f"{source}, header", "a text in UTF-8 or UTF-16", f"{show_value(line)}{suggest_recoding(path, line)}"
        )
    if line.startswith(COMMENTS) and not (marked and len(header) > 1):
        remedy = "" if path is None else f": {_suggest_without_comments(path)}"
        raise fail(f"{source}, header", "names of columns", f"a comment, {show_value(line)}{remedy}")
    mark = find_separator(header)
    if mark is not None:
        remedy = "" if path is None else f": {_suggest_separator(path, mark)}"
        came = f"{SEPARATORS[mark]} in {show_value(line)}{remedy}"
        raise fail(f"{source}, header", "names separated by commas", came)
    check_distinct(source, [name for name in header if name])
    if len(header) > 1 and all(re.fullmatch(r"[-+]?\d*\.?\d+(?:e[-+]?\d+)?", name, re.IGNORECASE) for name in header):
        example = "" if path is None else f": {suggest_rewrite(path, header=None, names=['time', '...'])}"
        raise fail(f"{source}, header", "names of columns", f"numbers alone, {show_value(line)}{example}")


def find_separator(header: Sequence[str]) -> str | None:
    """Return the separator (of SEPARATORS) in a header that was read as a single name; None if there is none."""
    return next((mark for mark in SEPARATORS if len(header) == 1 and mark in header[0]), None)


def guess_names_in_header(line: str) -> set[str]:
    """Return the column names that the first line of a table may hold, whatever separates them.

    COMMENTS holds the marks of a comment, # and %. In a comment, blanks may also separate names.
    """
    separators = r"[,;\t|\s]" if line.startswith(COMMENTS) else r"[,;\t|]"
    words = re.split(separators, line.lstrip("".join(COMMENTS) + " "))
    return {word.strip().strip('"').strip() for word in words} - {""}


def suggest_rewrite(path: Path, **how: object) -> str:
    """Return the pandas call that rewrites a table of another dialect, which is read with the arguments `how`."""
    given = "".join(f", {name}={value!r}" for name, value in how.items())
    return f"pandas.read_csv({str(path)!r}{given}).to_csv({str(path)!r}, index=False) rewrites it"


def suggest_recoding(path: Path | None, line: str) -> str:
    """Return the call that rewrites a table of another encoding, which is guessed from one line.

    Without a path the table cannot be read again, and the answer is "".
    """
    if path is None:
        return ""
    encoding = "utf-16-le" if "\0" in line else "latin-1"
    if line.startswith(COMMENTS):
        return f": {_suggest_without_comments(path, encoding)}"
    return f": {suggest_rewrite(path, encoding=encoding)}"


def guess_meaning_of_cell(cell: str, name: str, path: Path | None) -> str:
    """Return what a cell that is not a number probably means, and the call that rewrites the table; "" if unknown.

    DAY_FIRST matches such a date: day or month, separator, the other. `name`: of its column. `path`: the table's file,
    None if it cannot be rewritten.
    """
    # In 21.11.2026 and 11/21/2026, the day comes first if it cannot be a month, or if full stops separate the parts.
    if day := DAY_FIRST.fullmatch(cell):
        first = int(day[1]) > 12 or (day[2] == "." and int(day[3]) <= 12)
        remedy = "" if path is None else f": {suggest_rewrite(path, parse_dates=[name], dayfirst=first)}"
        return f": dates begin with the year; if this has the {'day' if first else 'month'} first{remedy or ' ...'}"
    if re.fullmatch(r"[-+.\de]+(?: +[-+.\de]+)+", cell):
        return ": several numbers" + ("" if path is None else f": {suggest_rewrite(path, sep=chr(92) + 's+')}")
    if re.fullmatch(r"[+-]?\d{1,3}(,\d{3})+(\.\d*)?", cell):
        return ": thousands have no comma" + ("" if path is None else f": {suggest_rewrite(path, thousands=',')}")
    if re.fullmatch(r"[+-]?\d+,\d+", cell):
        return ": numbers have a decimal point" + ("" if path is None else f": {suggest_rewrite(path, decimal=',')}")
    return ""


def _suggest_separator(path: Path, mark: str) -> str:
    """Return the call that rewrites a table whose separator is `mark`.

    If the file's first SEEN characters have a comma between digits, it is a decimal comma.
    """
    with open_text(path) as file:
        start = file.read(SEEN)
    if start.lstrip().startswith(COMMENTS):
        return _suggest_without_comments(path)
    commas = re.search(r"\d,\d", start)
    return suggest_rewrite(path, sep=mark, decimal=",") if commas else suggest_rewrite(path, sep=mark)


def _suggest_without_comments(path: Path, encoding: str = "") -> str:
    """Return the pandas call that converts a table whose first lines are comments, the last maybe its header.

    COMMENTS are the marks # and %, SEPARATORS those between cells besides the comma.
    """
    with open_text(path) as file:
        lines = [line.strip() for line in file.read(100_000).splitlines() if line.strip()]
    # The first line that is no comment tells the separator.
    comments = next((i for i, line in enumerate(lines) if not line.startswith(COMMENTS)), len(lines))
    following = lines[comments] if comments < len(lines) else "0"
    mark = next((mark for mark in (",", *SEPARATORS) if mark in following), r"\s+")
    pattern = mark if mark == r"\s+" else re.escape(mark)
    how = ({} if mark == "," else {"sep": mark}) | ({"encoding": encoding} if encoding else {})
    # If it begins with no number, it has the names; else the last comment does.
    first_cell = re.split(pattern, following)[0]
    if not re.match(r"[-+.\d]", first_cell):
        return suggest_rewrite(path, comment=lines[0][0], **how)
    title = lines[comments - 1].lstrip("".join(COMMENTS) + " ")
    names = [part.strip() for part in re.split(pattern, title) if part.strip()]
    return suggest_rewrite(path, skiprows=comments, names=names, **how)
