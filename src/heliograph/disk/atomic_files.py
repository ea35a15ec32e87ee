"""Files and folders that appear whole or not at all, also after a power failure, and locks on them."""

import json
import os
import re
import shutil
import tempfile
import warnings
import zlib
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from glob import escape as glob_escape
from pathlib import Path

from heliograph.numerics.check import fail
from heliograph.numerics.process.stop_signals import hold_signals

try:
    import fcntl
except ImportError:  # no such system call: then nothing is held, and what others left is never cleared
    fcntl = None  # type: ignore[assignment]

LOCK = ".lock"
LISTING = ".written.json"  # in a folder of results: {path of a file: its checksum}, of all that were written
LEFT_BY_OTHERS = {LOCK, ".DS_Store", "Thumbs.db", "desktop.ini"}  # which no user made


@contextmanager
def try_lock(path: Path) -> Iterator[bool]:
    """Try to lock the file or folder at `path` for the `with` block; yield whether the lock was obtained."""
    try:
        handle = os.open(path, os.O_RDONLY)
    except FileNotFoundError:  # the holder of the lock has just removed the file
        yield False
        return
    try:
        yield _lock_handle(handle)
    finally:
        os.close(handle)


@contextmanager
def lock_folder(folder: Path) -> Iterator[bool]:
    """Lock a folder by a lock file in it; yields whether the lock was obtained.

    The lock file is removed with the lock, and so are folders that were made for it and stayed empty. A killed process
    leaves the file, which then locks nothing.
    """
    made = [missing for missing in (folder, *folder.parents) if not missing.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / LOCK
    try:
        handle = _open_locked(path)
        if handle is None:
            yield False
            return
        try:
            yield True
        finally:
            path.unlink(missing_ok=True)
            os.close(handle)
    finally:
        for missing in made:
            with suppress(OSError):  # something is in it
                missing.rmdir()


def _open_locked(path: Path) -> int | None:
    """Return the handle of the lock file at `path` after making and locking it; None if another holds the lock."""
    while True:
        handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o600)
        if not _lock_handle(handle):
            os.close(handle)
            return None
        # The previous holder may have removed the file that we opened. Then the path no longer names it: try again.
        if _is_path_of_handle(path, handle):
            return handle
        os.close(handle)


def _is_path_of_handle(path: Path, handle: int) -> bool:
    """Return whether a path still names the open file `handle`; False if the path no longer exists."""
    try:
        handle_of_path = os.open(path, os.O_RDONLY)
    except FileNotFoundError:
        return False
    is_same = os.path.sameopenfile(handle, handle_of_path)
    os.close(handle_of_path)
    return is_same


def _lock_handle(handle: int) -> bool:
    """Take the lock of an open file without waiting; return whether it was free (True on systems without locks)."""
    if fcntl is None:
        return True
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        return False
    return True


def sync(path: Path) -> None:
    """Flush a file or folder to the disk."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def flush_tree_to_disk(folder: Path) -> None:
    """Flush a folder with all its contents to the disk."""
    for path in (*folder.rglob("*"), folder):
        sync(path)


def replace(partial: Path, path: Path) -> None:
    """Move a complete file to `path`, atomically, over an existing file if there is one."""
    sync(partial)
    os.replace(partial, path)
    sync(path.parent)


@contextmanager
def name_path_in_errors(path: Path | str) -> Iterator[None]:
    """Within this context, add the path to errors of the system that lack one, such as that of a full disk."""
    try:
        yield
    except OSError as error:
        if error.errno is not None and error.filename is None:
            error.filename = str(path)
        raise


@contextmanager
def whole_file(path: Path) -> Iterator[Path]:
    """Yield a temporary file next to `path` that replaces it at the end; removed after an error or interrupt."""
    with whole_files([path]) as (partial,):
        yield partial


@contextmanager
def whole_files(paths: Sequence[Path]) -> Iterator[list[Path]]:
    """Yield a temporary file for each of `paths`; at the end they replace `paths` together, or none after an error.

    The earlier contents are held in memory meanwhile, so the files should be small.

    A temporary file is hidden beside its path, and has the number of this process in its name; what killed processes
    left is removed first. Signals such as Ctrl-C wait (`hold_signals`) while files are replaced.
    """
    partials = [path.with_name(f".{path.name}.{os.getpid()}.partial") for path in paths]
    for path in paths:
        _remove_leftover_files(path)
    replaced: list[tuple[Path, bytes | None]] = []  # (path, its earlier contents; None if the file is new)
    try:
        with name_path_in_errors(paths[0]):
            yield partials
        # Once the last is replaced nothing is undone, so that its earlier content need not be kept.
        with hold_signals():
            for partial, path in zip(partials, paths, strict=True):
                before = path.read_bytes() if path != paths[-1] and path.exists() else None
                with name_path_in_errors(path):
                    replace(partial, path)
                replaced.append((path, before))
    except BaseException:
        # Remove temporary files, and undo: files that are new go, others get their earlier contents.
        with hold_signals():
            for partial in partials:
                partial.unlink(missing_ok=True)
            to_undo = replaced if len(replaced) < len(paths) else []
            for path, before in to_undo:
                if before is None:
                    path.unlink()
                else:
                    path.write_bytes(before)
        raise


def _remove_leftover_files(path: Path) -> None:
    """Remove the temporary files next to `path`, named .NAME.PROCESS.*.partial, of processes that no longer run."""
    for temporary in path.parent.glob(f".{glob_escape(path.name)}.*.partial"):
        process = temporary.name.split(".")[-2]
        if not _is_running(process):
            temporary.unlink(missing_ok=True)


def _is_running(process: str) -> bool:
    """Return whether the process with this number (a text, from a file's name) runs; True if that is unknown."""
    # Signal 0 sends nothing, but the call fails if there is no such process.
    try:
        os.kill(int(process), 0)
    except ProcessLookupError:
        return False
    except (ValueError, OSError):
        return True
    return True


FORMATS = (".csv", ".parquet")


def check_writable(path: str | Path, formats: Sequence[str] = FORMATS) -> None:
    """Raise the error that writing the file would raise, before the work starts.

    Args:
        path: file to be written.
        formats: extensions that are allowed.
    """
    path = Path(path)
    if format_of(path, formats) == ".parquet":
        import pyarrow.parquet  # noqa: F401
    if path.is_dir():
        raise fail(f"output file {path}", "a file", "a folder")
    if not path.parent.exists():
        raise fail(f"output folder {path.parent}", "an existing folder", "nothing of that name")
    check_folder_writable(path.parent)


def check_folder_writable(folder: str | Path) -> None:
    """Raise ValueError unless files can be written in the folder, or in the folder in which it would be made."""
    folder = Path(folder)
    existing = next(parent for parent in (folder, *folder.absolute().parents) if parent.exists())
    name = f"output folder {folder}"
    if not existing.is_dir():
        raise fail(name, "a folder", "a file" if existing == folder else f"a file {existing} on its path")
    try:
        tempfile.TemporaryFile(dir=existing).close()
    except OSError as error:
        raise fail(name, "a folder that can be written", error.strerror) from None


def format_of(path: Path, formats: Sequence[str] = FORMATS) -> str:
    """Return the extension of a file name in lower case; raise ValueError if it is no known format."""
    kind = path.suffix.lower()
    if kind not in formats:
        raise fail(str(path), f"a name that ends in {' or '.join(formats)}", repr(path.suffix))
    return kind


def check_only_results(target: Path, mark: str) -> None:
    """Raise ValueError unless the folder `target` can be written, and is new, empty or holds the file `mark`.

    The file shows earlier results, which are added to. A lock file (LOCK) does not count.
    """
    check_folder_writable(target)
    names = {path.name for path in target.iterdir()} - {LOCK} if target.is_dir() else set()
    if names and not (target / mark).is_file():
        raise fail(f"output folder {target}", f"a new or empty folder, or one with {mark} to go on with", "other files")


def check_replaceable(target: Path) -> None:
    """Raise ValueError unless the folder `target` can be written, and holds nothing but what `whole_folder` wrote.

    A file that the user added, or changed, is named. Folders that killed processes left beside it are removed first.
    """
    check_folder_writable(target)
    remove_leftover_folders(target)
    foreign = find_foreign_files(target)
    if foreign:
        others = f" and {len(foreign) - 1} others" if len(foreign) > 1 else ""
        expected = "a new or empty folder, or one with nothing but earlier results, as they were written"
        raise fail(f"output folder {target}", expected, f"{foreign[0]}{others}, which would be lost with it")


def find_foreign_files(folder: Path) -> list[str]:
    """Return the paths in a folder, relative to it and sorted, of files that `whole_folder` did not write as they are.

    LISTING holds the checksums of the files that it wrote. What file managers and Python leave behind does not count.
    `_find_files` returns {relative path: path}.
    """
    listing = folder / LISTING
    try:
        written = json.loads(listing.read_text(encoding="utf-8")) if listing.is_file() else {}
    except ValueError:  # somebody else's file
        written = {}
    kept = {name: path for name, path in _find_files(folder).items() if path.name not in LEFT_BY_OTHERS}
    known = written if isinstance(written, dict) else {}
    own = {LISTING} if known else set()
    return sorted(name for name, path in kept.items() if name not in own and _compute_checksum(path) != known.get(name))


def _find_files(folder: Path) -> dict[str, Path]:
    """Return all files in a folder, and links, by their paths relative to it with slashes; none in caches of Python."""
    found = dict[str, Path]()
    for parent, folders, files in os.walk(folder):
        links = [name for name in folders if (Path(parent) / name).is_symlink()]
        folders[:] = [name for name in folders if name != "__pycache__"]
        for name in (*files, *links):
            path = Path(parent) / name
            found[path.relative_to(folder).as_posix()] = path
    return found


def _compute_checksum(path: Path) -> int | None:
    """Return the CRC-32 of a file's bytes; None of anything but a plain file."""
    if path.is_symlink() or not path.is_file():
        return None
    checksum = 0
    with path.open("rb") as file:
        while part := file.read(1 << 20):
            checksum = zlib.crc32(part, checksum)
    return checksum


def _write_listing(folder: Path) -> None:
    """Write LISTING into a folder: the checksum of each file in it, by which `find_foreign_files` knows it again."""
    checksums = {name: _compute_checksum(path) for name, path in sorted(_find_files(folder).items())}
    (folder / LISTING).write_text(json.dumps(checksums, indent=0), encoding="utf-8")


@contextmanager
def whole_folder(target: Path) -> Iterator[Path]:
    """Yield an empty folder that replaces `target` at the end; after an error or interrupt `target` is unchanged.

    The new folder is filled under another name and renamed at the end, so that a reader never sees half of it. Remains
    of killed processes that wrote the same folder are cleared first, and earlier results that such a process had moved
    aside are restored. If somebody else's files came into the old folder meanwhile, it is kept beside the new one, and
    a warning names it.

    The folder that is filled is "new" in a hidden temporary folder beside `target`. `_write_listing` writes the
    checksums of its files, by which a later run knows them as its own; `_replace_folder` moves the old `target` aside
    and the new one to its place; `_restore_old_folder` puts the old one back.
    """
    remove_leftover_folders(target)
    made = [folder for folder in target.parents if not folder.exists()]
    temporary: Path | None = None  # a folder in the same file system; a lock on it says that we run
    lock = ExitStack()
    try:
        # Ctrl-C waits while the temporary folder is made, so that it is known and can be removed.
        with hold_signals():
            target.parent.mkdir(parents=True, exist_ok=True)
            temporary = Path(tempfile.mkdtemp(prefix=f".{target.name}-", dir=target.parent))
            (temporary / "new").mkdir()
            lock.enter_context(try_lock(temporary))
        # The caller fills the folder. The lock is released before the folder is renamed.
        with lock, name_path_in_errors(target):
            yield temporary / "new"
            _write_listing(temporary / "new")
            flush_tree_to_disk(temporary / "new")
        with hold_signals():
            _replace_folder(temporary, target)
    except BaseException:
        # Undo everything: the temporary folder, the old results, and parents that were made above.
        with hold_signals():
            lock.close()
            if temporary is not None:
                _restore_old_folder(temporary, target)
            for folder in made:
                with suppress(OSError):  # somebody else's files came into it meanwhile
                    folder.rmdir()
        raise


def _restore_old_folder(temporary: Path, target: Path) -> None:
    """Put earlier results, moved aside into `temporary`/old, back in place of `target`; remove the temporary folder."""
    if (temporary / "old").exists() and not target.exists():
        (temporary / "old").rename(target)
    shutil.rmtree(temporary, ignore_errors=True)


def _replace_folder(partial: Path, target: Path) -> None:
    """Put `partial`/new in place of `target` by two renames; the old `target` is removed.

    If somebody else's files are in the old folder, it is not removed but kept under another name, with a warning.
    """
    if target.exists() and find_foreign_files(target):
        kept = Path(tempfile.mkdtemp(prefix=f"{target.name}-kept-", dir=target.parent))
        target.rename(kept)
        warnings.warn(
            f"{target}: what was in it is in {kept}, since it had files that were not written by a run", stacklevel=2
        )
    elif target.exists():
        target.rename(partial / "old")
    (partial / "new").rename(target)
    sync(target.parent)
    shutil.rmtree(partial)


def remove_leftover_folders(target: Path) -> None:
    """Remove the temporary folders next to `target` that killed processes of `whole_folder` left.

    Such a folder is named .TARGET-xxxxxxxx and holds at most the folders "new" (unfinished results) and "old" (earlier
    results, which are put back if `target` is missing). A running process holds a lock on its folder, which stays. A
    folder with other contents is not ours, and stays too.
    """
    if not target.parent.is_dir():
        return
    for folder in target.parent.glob(f".{glob_escape(target.name)}-*"):
        ending = folder.name.removeprefix(f".{target.name}")
        if not re.fullmatch(r"-[a-z0-9_]{8}", ending) or not folder.is_dir():
            continue
        with try_lock(folder) as is_locked:
            if not is_locked or {path.name for path in folder.iterdir()} - {"new", "old"}:
                continue
            if (folder / "old").exists() and not target.exists():
                (folder / "old").rename(target)
            shutil.rmtree(folder)
