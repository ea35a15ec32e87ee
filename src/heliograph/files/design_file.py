"""Design problem in a TOML file: network, free powers, budget or target error, and further results."""

import tomllib
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np

from heliograph.files.network_file import load_function, load_network
from heliograph.numerics.check import array, check_count, check_seed, fail, scalar
from heliograph.planning.design_problem import DesignProblem
from heliograph.planning.error_objective import Error
from heliograph.planning.power_budget import Budget
from heliograph.simulation.network import Network

KEYS = ("network", "free", "budget", "target_error", "error", "starts", "seed", "front", "path_loss_exponent", "map")
TABLES = {
    "budget": ("total", "per_transmitter", "peak"),
    "error": ("weight", "worst", "horizon", "at_end", "period"),
    "map": ("network", "x", "y", "points"),
}


@dataclass(frozen=True)
class MapPlaces:
    """Places over which the error of a design is mapped: a grid of x and y, and a network for each place.

    Attributes:
        build: function of the user's Python file that returns the network for a place (x, y).
        x, y: coordinates of the grid, in the units of this function.
    """

    build: Callable[[float, float], Network]
    x: np.ndarray
    y: np.ndarray


@dataclass(frozen=True)
class DesignFile:
    """A design file as read: the network, the design problem, and further results that are asked for."""

    reference: str  # FILE or FILE:NAME of the network
    source: str  # content of that Python file
    network: Network
    problem: DesignProblem
    front: tuple[float, ...] | None  # total powers, for each of which the least error is wanted
    exponent: float | None  # of the path loss: received power falls as distance to minus this power
    map: MapPlaces | None


def read_design(path: Path) -> DesignFile:
    """Read a design file; names of Python files in it are relative to its folder.

    Raises:
        ValueError: no TOML, unknown keys or values, a network that cannot be loaded; one line with the key.
    """
    table = _read_toml(path)
    file, name = _find_python_file(path, table.get("network"), "network")
    # What is designed, and the further results that are asked for: front, exponent of the path loss, map.
    free = _read_free_transmitters(path, table)
    network = load_network(f"{file}:{name}" if name else str(file))
    problem = _read_design_problem(path, table, network, free)
    front = table.get("front")
    return DesignFile(
        reference=f"{file.name}:{name}" if name else file.name,
        source=file.read_text(encoding="utf-8"),
        network=network,
        problem=problem,
        front=None if front is None else tuple(array(f"{path.name}, front", front, (None,)).tolist()),
        exponent=_read_number(path, table, "path_loss_exponent"),
        map=_read_map_places(path, table) if "map" in table else None,
    )


def _read_toml(path: Path) -> dict[str, Any]:
    """Return the content of a design file after checking its keys, at the top and in its tables.

    KEYS holds the known keys at the top, and TABLES the known keys of each table. Values are not checked here.
    """
    if not path.is_file():
        raise fail(f"design {path}", "a TOML file", "a folder" if path.is_dir() else "no file of that name")
    try:
        table = tomllib.loads(path.read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise fail(f"design {path.name}", "TOML", str(error)) from None
    _check_keys(path.name, table, KEYS)
    for key, known in TABLES.items():
        if isinstance(table.get(key), dict):
            _check_keys(f"{path.name}, {key}", table[key], known)
    return table


def _read_free_transmitters(path: Path, table: Mapping[str, Any]) -> tuple[str, ...] | None:
    """Return the names of the transmitters whose powers are free, or None if the design file does not say it."""
    free = table.get("free")
    if free is None:
        return None
    if not isinstance(free, list) or not all(isinstance(name, str) for name in free):
        raise fail(f"{path.name}, free", "a list of names", repr(free))
    return tuple(free)


def _read_design_problem(
    path: Path, table: Mapping[str, Any], network: Network, free: tuple[str, ...] | None
) -> DesignProblem:
    """Return the design problem of a network as the content `table` of the design file `path` states it.

    `free`: transmitters whose powers are free, None for all.
    """
    return DesignProblem(
        network=network,
        free=free,
        error=Error(**_read_table(path, table, "error")) if "error" in table else None,
        budget=_read_budget(path, table),
        target_error=_read_number(path, table, "target_error"),
        starts=check_count(f"{path.name}, starts", table.get("starts", 64)),
        seed=check_seed(f"{path.name}, seed", table.get("seed", 0)),
    )


def _read_number(path: Path, table: Mapping[str, Any], key: str) -> float | None:
    """Return the number under a key, which is not negative; None if it is not there."""
    return float(scalar(f"{path.name}, {key}", table[key], 0.0)) if key in table else None


def _read_budget(path: Path, table: Mapping[str, Any]) -> Budget | None:
    """Return the budget of powers, or None if the file has none; a plain number limits the total power.

    `table`: the content of the design file `path`.
    """
    value = table.get("budget")
    if value is None:
        return None
    return Budget(**value) if isinstance(value, dict) else Budget(scalar(f"{path.name}, budget", value, 0.0))


def _read_map_places(path: Path, table: Mapping[str, object]) -> MapPlaces:
    """Return the places of the map that a design file asks for: the network's function of x and y, and the grid.

    The map shows the error of the network that this function returns for each place of the grid. `values`: the keys
    network, points, x and y of the table; x and y are the ends of the axes.
    """
    values = _read_table(path, table, "map")
    file, name = _find_python_file(path, values.get("network"), "map.network")
    if not name:
        raise fail(f"{path.name}, map.network", 'a file and a function of x and y, as "my_network.py:at"', file.name)
    points = check_count(f"{path.name}, map.points", values.get("points", 11), 2)
    ends = [array(f"{path.name}, map.{key}", values.get(key, "none"), (2,)) for key in ("x", "y")]
    build = load_function(file, file.read_text(encoding="utf-8"), name)
    x, y = (np.linspace(low, high, points) for low, high in ends)
    return MapPlaces(build, x, y)


def _find_python_file(path: Path, value: object, key: str) -> tuple[Path, str]:
    """Return the Python file that a value FILE or FILE:NAME names, and NAME, or "" if there is no name.

    FILE is relative to the folder of the design file. `key`: where the value stands in the design file `path`, for
    errors.
    """
    if not isinstance(value, str):
        raise fail(f"{path.name}, {key}", 'a Python file, as "my_network.py" or "my_network.py:name"', repr(value))
    # What follows the last colon is a name only if it can be one: paths, as "C:/net.py", have colons too.
    file_name, colon, name = value.rpartition(":")
    file_name, name = (file_name, name) if colon and name.isidentifier() else (value, "")
    file = path.parent / file_name
    if not file.is_file():
        raise fail(f"{path.name}, {key}", "a Python file in its folder", repr(value))
    return file, name


def _read_table(path: Path, table: Mapping[str, object], key: str) -> dict[str, Any]:
    """Return the table under a key that the design file has; raise ValueError if something else stands there.

    Its keys were checked when the file was read. TABLES, the known keys of each table, serves the error's text.
    """
    value = table[key]
    if not isinstance(value, dict):
        raise fail(f"{path.name}, {key}", f"a table of {', '.join(TABLES[key])}", repr(value))
    return value


def _check_keys(where: str, table: Mapping[str, object], known: tuple[str, ...]) -> None:
    """Raise ValueError if a key is not known; the error names the known key most like it."""
    for key in table:
        if key not in known:
            close = get_close_matches(key, known, 1)
            hint = f" (closest: {close[0]!r})" if close else ""
            raise fail(f"{where}, key {key!r}", f"one of {', '.join(known)}", f"an unknown key{hint}")


def make_designed_source(file: DesignFile, source: str, powers: Mapping[str, np.ndarray]) -> str:
    """Return Python source of a designed network, which loads the original from a file in its own folder.

    Args:
        file: the design file: its problem, whose criterion has horizon and period, and the reference "FILE.py:NAME" of
            the network that it was made for.
        source: name of the file with the original network.
        powers: the designed powers by transmitter, (steps,) each: of a period or the horizon.
    """
    error = file.problem.criterion
    _, colon, name = file.reference.rpartition(":")
    # The original is loaded relative to the file, so that the folder can be moved.
    reference = f'str(Path(__file__).with_name("{source}"))' + (f' + ":{name}"' if colon else "")
    return "\n".join([
        '"""A network with designed powers, and the best linear filters for them."""',
        "",
        "from pathlib import Path",
        "",
        "import heliograph as hg",
        "",
        "POWERS = {  # by transmitter, of each step of a period or horizon",
        *(f"    {transmitter!r}: {np.asarray(power).tolist()}," for transmitter, power in powers.items()),
        "}",
        "network = hg.planning.designed_network(",
        f"    hg.files.load_network({reference}),",
        "    POWERS,",
        f"    hg.planning.Error(horizon={error.horizon}, period={error.period}),",
        ")",
        "",
    ])  # fmt: skip
