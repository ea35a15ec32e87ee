"""Quoting of a user's text for terminals, tables, figures and files, so that no name breaks them or acts in them."""

import re
from collections.abc import Mapping, Sequence

NAMED = 3  # how many of many names are said
FORMULA = ("=", "+", "-", "@", "\t", "\r")  # a cell that begins so is computed by a spreadsheet


def visible(text: str) -> str:
    """Replace characters that cannot be printed by their codes, for terminals and XML."""
    return "".join(c if c.isprintable() or c == " " else repr(c)[1:-1] for c in text)


def quote_for_figure(text: str) -> str:
    """Quote a text for matplotlib: no dollar sign starts a formula, no leading underscore hides it from the legend."""
    shown = visible(text).replace("$", r"\$")
    return f"\u200b{shown}" if shown.startswith("_") else shown


def quote_for_cell(text: str) -> str:
    """Quote a text for a spreadsheet: what it would compute begins with an apostrophe, which it does not show.

    A spreadsheet computes a cell that begins with =, +, -, @ or a tab (FORMULA).
    """
    shown = visible(text)
    return f"'{shown}" if shown.lstrip("'").startswith(FORMULA) else shown


def unquote_cell(cell: str) -> str:
    """Undo `quote_for_cell`, except that characters which cannot be printed stay replaced by their codes."""
    return cell[1:] if cell.startswith("'") and cell.lstrip("'").startswith(FORMULA) else cell


def quote_for_file(text: str) -> str:
    """Quote a text for a file of arrays: backslash and characters that cannot be printed as Python's escapes."""
    return "".join(c if c.isprintable() and c != "\\" else c.encode("unicode_escape").decode() for c in text)


def unquote_file(text: str) -> str:
    """Undo `quote_for_file`."""
    code = r"\\(?:[\\nrt]|x[0-9a-f]{2}|u[0-9a-f]{4}|U[0-9a-f]{8})"
    return re.sub(code, lambda match: match[0].encode().decode("unicode_escape"), text)


def join_names(names: Sequence[str]) -> str:
    """Return names joined by commas; of more than 6 names only the first 3, followed by how many there are."""
    if len(names) <= 2 * NAMED:
        return ", ".join(names)
    return f"{', '.join(names[:NAMED])} … ({len(names)})"


def label_with_unit(name: str, units: Mapping[str, str]) -> str:
    """Return the label of a state or of time for a figure, with its unit if it has one."""
    return quote_for_figure(f"{name} ({units[name]})" if name in units else name)
