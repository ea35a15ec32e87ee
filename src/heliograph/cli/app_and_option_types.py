"""The application that holds the commands, the types of their options, and completion in a shell."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter, Token

import heliograph

if TYPE_CHECKING:
    from heliograph.files.stores.store_address import StoreAddress

app = App(
    name="heliograph",
    help="State estimation over relay networks.",
    version=heliograph.__version__,
    help_format="restructuredtext",
)


def integer_option(text: str) -> Parameter:
    """Return the declaration of an option that is an integer, with the text of its help."""
    return Parameter(help=text, converter=_convert_to_int)


def path_option(text: str = "") -> Parameter:
    """Return the declaration of an option that is the path of a file or folder, with the text of its help."""
    return Parameter(help=text, converter=_convert_to_path)


MEASURED = (
    "CSV or Parquet: rows or events; messages in lines of JSON; a folder of these; a bag; influx:// or "
    "postgresql://...?query=."
)


def measured_option(text: str = MEASURED) -> Parameter:
    """Return the declaration of an option that is measured data, a file or the URL of a store, with its help."""
    return Parameter(help=text, converter=_convert_to_path_or_store, accepts_keys=False, n_tokens=1)


def estimates_option() -> Parameter:
    """Return the declaration of an option that is where estimates go: a file, or the URL of a store.

    Cyclopts, which parses the command line, reads it: the option takes one word (`n_tokens`), has no parts such as
    --estimates.key (`accepts_keys`), and the converter makes of the word a `Path`, or the address of a store if it is a
    store's URL.
    """
    return Parameter(
        help="CSV, Parquet or MCAP to write, or influx:// or postgresql://...?table=: estimates with their claims.",
        converter=_convert_to_path_or_store,
        accepts_keys=False,
        n_tokens=1,
    )


def choose_results_folder(command: str, out: Path | None, name: str) -> Path:
    """Return the folder in which the results folder `name` is made: `--out`, or its parent if `--out` has that name.

    Raises:
        ValueError: there is no `--out`, or the folder cannot be written.
    """
    from heliograph.disk.atomic_files import check_folder_writable
    from heliograph.numerics.check import fail

    if out is None:
        raise fail(command, "a folder for the results (--out DIR)", "none")
    check_folder_writable(out)
    return out.parent if out.name == name else out


def _convert_to_int(_: type, tokens: Sequence[Token]) -> int:
    """Return an option's text as an integer; fractions, and underscores between digits, raise ValueError."""
    text = tokens[0].value
    if not re.fullmatch(r"[+-]?[0-9]+", text, re.ASCII):
        raise ValueError(f"expected a whole number, got {text!r}")
    return int(text)


def _convert_to_path(_: type, tokens: Sequence[Token]) -> Path:
    """Return an option's text as a path; an empty text, or one with a NUL, raises ValueError."""
    text = tokens[0].value
    if not text or "\0" in text:
        raise ValueError(f"expected a path, got {text!r}")
    return Path(text)


def _convert_to_path_or_store(kind: type, tokens: Sequence[Token]) -> "Path | StoreAddress":
    """Return an option's text as the address of a store if it is a store's URL, or else as a path."""
    from heliograph.files.stores.store_address import is_store, parse_store

    text = tokens[0].value
    return parse_store(text) if is_store(text) else _convert_to_path(kind, tokens)


def completion(
    shell: Annotated[Literal["bash", "zsh", "fish", "powershell"], Parameter(help="Which shell.")], /
) -> None:
    """Print a shell's completion script; in bash: eval "$(heliograph completion bash)"."""
    print(app.generate_completion(prog_name="heliograph", shell=shell))
