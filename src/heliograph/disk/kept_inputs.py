"""Files that a command reads, and those that it writes, are neither replaced nor removed by what else it writes."""

from collections.abc import Iterable
from pathlib import Path

from heliograph.numerics.check import fail


def refuse_replacing(read: Iterable[object], written: Iterable[object], folder: Path | None = None) -> None:
    """Raise ValueError if a command would overwrite a file that it reads or has just written.

    Paths are compared as they resolve, links followed. The error names the file that would be lost.

    Args:
        read: files and folders that the command reads; anything but a path is ignored.
        written: files that the command writes; anything but a path is ignored.
        folder: the folder that the command replaces as a whole; None if there is none.
    """
    sources = [path for path in read if isinstance(path, Path)]
    files = [path for path in written if isinstance(path, Path)]
    for file in files:
        if any(file.resolve() == source.resolve() for source in sources):
            raise fail(f"output file {file}", "another file than the measurements", "the same")
    if folder is None:
        return
    replaced = folder.resolve()
    # A path in the folder would be lost with it. A file that was read but is gone by now cannot be.
    for path in [*sources, *files]:
        if replaced in (path.resolve(), *path.resolve().parents) and (path in files or path.exists()):
            raise fail(f"output folder {folder}", f"one without {path.name}, which would be lost with it", str(path))


def find_network_file(reference: str) -> Path:
    """Return the file in a reference to a network, such as my_network.py in "my_network.py:name".

    Of a reference without a file ("module:name") the path that is returned names no file that exists.
    """
    stem, _, _ = reference.rpartition(".py")
    return Path(f"{stem}.py")
