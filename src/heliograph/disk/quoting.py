"""Text of a user's, quoted for where it lands: no name breaks a table, a figure or a file, or acts in it."""

import re

FORMULA = ("=", "+", "-", "@", "\t", "\r")  # a cell that begins so is computed by a spreadsheet


def visible(text: str) -> str:
    """For a terminal, and for XML: characters that the one acts on and the other does not know, as their codes."""
    return "".join(c if c.isprintable() or c == " " else repr(c)[1:-1] for c in text)


def in_figure(text: str) -> str:
    """For matplotlib: a dollar is a dollar, and a leading underscore hides nothing from the legend."""
    shown = visible(text).replace("$", r"\$")
    return f"\u200b{shown}" if shown.startswith("_") else shown


def in_cell(text: str) -> str:
    """For a spreadsheet: what it would compute begins with an apostrophe, which it does not show."""
    shown = visible(text)
    return f"'{shown}" if shown.lstrip("'").startswith(FORMULA) else shown


def from_cell(cell: str) -> str:
    """What `in_cell` was given, but for characters that cannot be seen."""
    return cell[1:] if cell.startswith("'") and cell.lstrip("'").startswith(FORMULA) else cell


def in_file(text: str) -> str:
    """For a file of arrays: what cannot be seen, and the backslash, as Python writes it, so that `from_file` has it."""
    return "".join(c if c.isprintable() and c != "\\" else c.encode("unicode_escape").decode() for c in text)


def from_file(text: str) -> str:
    """What `in_file` was given."""
    code = r"\\(?:[\\nrt]|x[0-9a-f]{2}|u[0-9a-f]{4}|U[0-9a-f]{8})"
    return re.sub(code, lambda result: result[0].encode().decode("unicode_escape"), text)
