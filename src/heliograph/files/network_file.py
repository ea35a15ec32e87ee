"""Networks from a user's own Python modules."""

import importlib
import os
import sys
import traceback
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from difflib import get_close_matches
from functools import wraps
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path
from types import ModuleType
from typing import TypeVar

from heliograph.numerics.check import fail, file_path
from heliograph.simulation.network import Network

T = TypeVar("T")


def load_network(reference: str) -> Network:
    """Load a network from "my_network.py", "my_network.py:name" or "package.module:name".

    Without a name the module must have exactly one network; the name may also be that of a function without arguments
    that returns one. A file finds other modules in its own folder, as a script does.

    Args:
        reference: path of the file or name of the module, optionally with a colon and the name of the network.

    Raises:
        ValueError: no such module, an error inside it (with its type, message and line), no network, or several and no
            name. One line that names the module.
    """
    network, _names_of_module = load_module(reference)
    return network


def load_module(reference: str) -> tuple[Network, Mapping[str, object]]:
    """Load a network as `load_network` does; return it and {name: value} of its module, such as `sources`, `pose`.

    `_call_user_code` makes an error of the user's code one line with its place. `_run_source` runs a file as a module,
    `_find_network` takes the network out of it.
    """
    file_path("network", reference)
    source_name, _, name = str(reference).rpartition(":")
    if not source_name or not name.isidentifier():  # no name, or the colon of a drive letter
        source_name, name = reference, ""
    # A file, by its path.
    if source_name.endswith(".py") or os.sep in source_name or Path(source_name).is_file():
        path = Path(source_name)
        if not path.is_file():
            got = "a folder" if path.is_dir() else "nothing of that name"
            raise fail(f"network {source_name}", "a Python file", got)
        with _allow_imports_from(path.parent):
            module = _call_user_code(lambda: _run_source(path, path.read_bytes()), source_name, path)
            return _find_network(module, name, source_name, path), vars(module)
    # A module, by its name.
    with _allow_imports_from(Path.cwd()):
        source = _call_user_code(lambda: _find_source_file(source_name), source_name, path=None)
        module = _call_user_code(lambda: importlib.import_module(source_name), source_name, source)
        return _find_network(module, name, source_name, source), vars(module)


def load_function(path: Path, source: str, name: str) -> Callable[..., Network]:
    """Load a function that returns a network from Python source, which need not be the file's present one.

    A campaign keeps the source with which it was started, so the text may be older than the file. Modules that it
    imports are found in the file's folder, both when the source is run and when the function is called.

    Args:
        path: path of the file from which the source was read.
        source: its text.
        name: name of the function in it.

    Returns:
        The user's function, wrapped: it takes the same arguments, and its result is checked to be a network.

    Raises:
        ValueError: as `load_network`; calling the function raises the same.
    """
    reference = f"{path.name}:{name}"
    # Run the source as a module, and find the function in it.
    with _allow_imports_from(path.parent):
        module = _call_user_code(lambda: _run_source(path, source), path.name, path)
    function = getattr(module, name, None)
    if not callable(function):
        got = "an unknown name" if function is None else type(function).__name__
        raise fail(f"network {reference}", "a function that returns a heliograph.Network", got)

    # Each call may import more modules of the folder, and may fail in the user's code.
    @wraps(function)
    def build(*args: object, **kwargs: object) -> Network:
        """Return the network that the user's `function` returns; raise ValueError if it is something else."""
        with _allow_imports_from(path.parent):
            network = _call_user_code(lambda: function(*args, **kwargs), reference, path)
        if not isinstance(network, Network):
            raise fail(f"network {reference}", "a heliograph.Network", type(network).__name__)
        return network

    return build


def _find_network(module: ModuleType, name: str, file: str, path: Path | None) -> Network:
    """Return the network called `name` in a module, or its only network if `name` is "".

    Args:
        module: the user's module, after it was run.
        name: name of a network in it, or of a function that returns one; or "".
        file: the module's file or name, for errors.
        path: its file, in which the line of an error is looked for; None if it has none.
    """
    networks = {key: value for key, value in vars(module).items() if isinstance(value, Network)}
    if name:
        return _read_named_network(module, name, file, path, networks)
    if len({id(network) for network in networks.values()}) == 1:
        return next(iter(networks.values()))
    if networks:
        choices = " or ".join(f"{file}:{key}" for key in networks)
        raise fail(f"network {file}", f"a name, as {choices}", f"none, and {len(networks)} networks")
    raise fail(f"network {file}", f"a heliograph.Network (or {file}:FUNCTION that returns one)", "none in the module")


def _read_named_network(
    module: ModuleType, name: str, file: str, path: Path | None, networks: dict[str, Network]
) -> Network:
    """Return the network that a name of a module stands for, or that the function of this name returns.

    `networks`: those of the module by name, for errors. `file` and `path`: the module's file or name for errors, and
    the file in which the line of an error is looked for.
    """
    if not hasattr(module, name):
        close = get_close_matches(name, [key for key in vars(module) if not key.startswith("_")], 1)
        holds = ", ".join(networks) or "no networks"
        hint = f" (closest: {close[0]!r})" if close else ""
        raise fail(f"network {file}:{name}", f"a name in the module, which holds {holds}", f"an unknown name{hint}")
    value = getattr(module, name)
    if callable(value) and not isinstance(value, Network):
        value = _call_user_code(value, f"{file}:{name}", path)
    if not isinstance(value, Network):
        raise fail(f"network {file}:{name}", "a heliograph.Network", type(value).__name__)
    return value


def _find_source_file(module: str) -> Path | None:
    """Return the source file of an importable module, or None if it has none; raise if there is no such module."""
    spec = find_spec(module)
    if spec is None:
        raise ModuleNotFoundError(f"No module named {module!r}")
    return Path(spec.origin) if spec.origin else None


def _run_source(path: Path, source: str | bytes) -> ModuleType:
    """Run a file's source as a module and return it; unlike an import, this writes no cache beside the file."""
    name = f"heliograph_network_{path.stem}"
    spec = spec_from_file_location(name, path)
    if spec is None:
        raise ImportError(f"{path} is no Python source")
    module = module_from_spec(spec)
    sys.modules[name] = module  # dataclasses look their module up while it runs
    try:
        exec(compile(source, str(path), "exec"), vars(module))
    except BaseException:
        del sys.modules[name]
        raise
    return module


def _call_user_code(call: Callable[[], T], name: str, path: Path | None) -> T:
    """Return what the user's code returns; an error in it becomes one line with its type, message and line number.

    `name` is the network's reference, for errors. `path` is the user's file, None if it is not known.
    """
    try:
        return call()
    except (Exception, SystemExit) as error:
        came = f"{type(error).__name__}{_find_error_line(error, path)}: {error}"
        raise fail(f"network {name}", "Python that runs", " ".join(came.split())) from error


def _find_error_line(error: BaseException, path: Path | None) -> str:
    """Return " in line N", the innermost line of the user's file in an error's traceback; "" if there is none."""
    if isinstance(error, SyntaxError):
        return f" in line {error.lineno}"
    if path is None:
        return ""
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(path)]
    return f" in line {lines[-1]}" if lines else ""


@contextmanager
def _allow_imports_from(folder: Path) -> Iterator[None]:
    """Within this context, let imports find modules in `folder` before all others."""
    entry = str(folder.resolve())
    sys.path.insert(0, entry)
    try:
        yield
    finally:
        if entry in sys.path:  # the user's module may have changed the path itself
            sys.path.remove(entry)
