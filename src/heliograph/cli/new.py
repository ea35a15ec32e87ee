"""`heliograph new`: a network to begin with, as a commented file that runs."""

from importlib.resources import files
from pathlib import Path
from typing import Annotated

from heliograph.cli.app_and_option_types import path_option

TEMPLATE = "my_network.py.txt"  # no module of ours


def new(file: Annotated[Path, path_option("Python file to write; it must not be there yet.")], /) -> None:
    """Write a commented network to begin with: a file that runs, and simulates data for itself."""
    from heliograph.disk.atomic_files import check_writable, whole_file
    from heliograph.disk.quoted_text import visible
    from heliograph.numerics.check import fail

    check_writable(file, (".py",))
    if file.exists():
        raise fail(f"file {file}", "a new name", "a file that is there")
    text = files("heliograph.cli").joinpath(TEMPLATE).read_text(encoding="utf-8")
    with whole_file(file) as partial:
        partial.write_text(text.replace("my_network.py", file.name), encoding="utf-8")
    print(visible(f"{file}: next, python {file}"))
