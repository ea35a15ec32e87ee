"""Reader of a campaign's TOML file; every error is one line that names the key."""

import inspect
import math
import tomllib
from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from itertools import product
from pathlib import Path

from heliograph.campaign.definition import DIMENSIONS, Campaign, Setting, collect_versions, serialise_setting
from heliograph.engine.size_thresholds import BLOCK
from heliograph.numerics.check import check_count, check_seed, fail, file_path

KEYS = ("network", "horizon", "runs", "seed", "chunk", "keep", "inputs", "timeout", "grid", "settings")
KEEP = ("errors", "trajectories")
# Names that the store's variables and the table's columns have already.
VARIABLES = ("error", "variance", "nees_per_dimension", "truth", "measurement", "claim")
COLUMNS = ("rmse", "rmse_error", "nees_error", "runs", "finite_runs")
CHUNK = 256  # runs that are computed and stored at once, if the file does not say
TIMEOUT = 3600.0  # seconds, compiling included, if the file does not say


def load_campaign(path: str | Path) -> Campaign:
    """Read a campaign from a TOML file, and the source of the network it names.

    Keys: network = "my_network.py:build" (a function of the settings; the path counts from the campaign's folder),
    horizon, runs, and [grid] name = [values], whose product is taken, or [[settings]], one table for each. Optional:
    seed (0), chunk (runs computed and stored at once, 256; a multiple of 32), keep ("errors", or "trajectories" for
    truth and measurements too), [inputs] name = a number or one for each step, timeout (seconds that a worker may take
    to build a setting or compute a chunk, 3600).

    Args:
        path: of the TOML file.

    Raises:
        ValueError: no such file, no TOML, an unknown or missing key, a value that is none, settings that the
            network's function does not take.
    """
    path = file_path("campaign", path)
    if not path.is_file():
        raise fail(f"campaign {path}", "a TOML file", "a folder" if path.is_dir() else "nothing of that name")
    try:
        text = path.read_text(encoding="utf-8")
    except UnicodeDecodeError as error:
        raise fail(f"campaign {path}", "a TOML file in UTF-8", str(error)) from None
    table = _parse_toml(text, path.name)
    file = path.parent / _read_network(table, path.name).rpartition(":")[0]
    if not file.is_file():
        raise fail(f"{path.name}, network", f"a Python file in {path.parent}", f"{file.name}: nothing of that name")
    campaign = read_campaign(text, file.read_text(encoding="utf-8"), path)
    _check_arguments(campaign, path.name)
    return campaign


def read_campaign(text: str, source: str, path: Path) -> Campaign:
    """Return the campaign that the text of a TOML file describes.

    Args:
        text: the text of the file: network, horizon, runs, settings, and optional keys (`load_campaign` has all).
        source: Python source of the network's module.
        path: path of the file, named in errors.

    Raises:
        ValueError: as `load_campaign`, except for settings that the function does not take.
    """
    name = path.name
    table = _parse_toml(text, name)
    # An unknown key is most likely misspelt: name the closest one.
    for key in table:
        if key not in KEYS:
            close = get_close_matches(key, KEYS, 1)
            hint = f" (closest: {close[0]!r})" if close else ""
            raise fail(f"{name}, key {key!r}", f"one of {', '.join(KEYS)}", f"an unknown key{hint}")
    # Each reader checks its key and raises one line.
    runs, horizon = _read_positive_integer(table, "runs", name), _read_positive_integer(table, "horizon", name)
    # BLOCK runs are simulated side by side: a chunk has at most all runs, rounded up to a multiple of it.
    all_runs_rounded_up = BLOCK * math.ceil(runs / BLOCK)
    return Campaign(
        text=text,
        network=_read_network(table, name),
        source=source,
        path=str(path.absolute()),
        horizon=horizon,
        runs=runs,
        seed=check_seed(f"{name}, seed", table.get("seed", 0)),
        chunk=min(_read_chunk_size(table.get("chunk", CHUNK), name), all_runs_rounded_up),
        keep=_read_choice(table.get("keep", KEEP[0]), KEEP, f"{name}, keep"),
        inputs=_read_inputs(table.get("inputs", {}), horizon, name),
        settings=_read_settings(table, name),
        timeout=_read_timeout(table.get("timeout", TIMEOUT), name),
        versions=collect_versions(),
    )


def _parse_toml(text: str, name: str) -> dict[str, object]:
    """Return the table in a campaign's TOML text; `name` is that of its file, for errors."""
    try:
        return tomllib.loads(text)
    except tomllib.TOMLDecodeError as error:
        raise fail(f"campaign {name}", "TOML", str(error)) from None


def _read_network(table: Mapping[str, object], name: str) -> str:
    """Return the name of the function that makes the network, as FILE:FUNCTION.

    `table` is the campaign's file, and `name` its name, for errors.
    """
    value = table.get("network")
    file, _, function = value.rpartition(":") if isinstance(value, str) else ("", "", "")
    if not file.endswith(".py") or not function.isidentifier():
        expected = 'a file and a function in it, as "my_network.py:build"'
        raise fail(f"{name}, network", expected, _format_value_for_error(value))
    return str(value)


def _format_value_for_error(value: object) -> str:
    """Return a value as an error shows it; "none" where the key is missing."""
    return "none" if value is None else repr(value)


def _read_positive_integer(table: Mapping[str, object], key: str, name: str) -> int:
    """Return the value of a key, a whole number from 1; ValueError names the file (`name`) and the key."""
    return check_count(f"{name}, {key}", table.get(key, "none"))  # "none" is shown if the key is missing


def _read_chunk_size(value: object, name: str) -> int:
    """Return the number of runs of a chunk, a multiple of BLOCK, those simulated side by side; `name`: of the file."""
    count = check_count(f"{name}, chunk", value)
    if count % BLOCK:
        raise fail(f"{name}, chunk", f"a multiple of {BLOCK}, the runs simulated side by side", count)
    return count


def _read_timeout(value: object, name: str) -> float:
    """Return the seconds of a timeout, a positive number; ValueError names the file, `name`."""
    if not isinstance(value, int | float) or not _is_number(value) or value <= 0:
        raise fail(f"{name}, timeout", "a positive number of seconds", _format_value_for_error(value))
    return float(value)


def _read_choice(value: object, choices: Sequence[str], name: str) -> str:
    """Return a value if it is one of the choices, or raise ValueError, which calls it `name`."""
    if value not in choices:
        raise fail(name, " or ".join(map(repr, choices)), repr(value))
    return str(value)


def _read_inputs(table: object, horizon: int, name: str) -> dict[str, float | list[float]]:
    """Return the inputs of a campaign's file by name, each a number or a list with a number for each step.

    Args:
        table: the value of the key `inputs`.
        horizon: number of steps.
        name: name of the file, for errors.
    """
    if not isinstance(table, dict):
        raise fail(f"{name}, inputs", "a table of numbers by the input's name", repr(table))
    for key, value in table.items():
        values = value if isinstance(value, list) else [value] * horizon
        if len(values) != horizon or not all(_is_number(single) for single in values):
            got = f"{len(value)} values" if isinstance(value, list) else repr(value)
            raise fail(f"{name}, inputs.{key}", f"a number or one for each of {horizon} steps", got)
    return dict(table)


def _is_number(value: object) -> bool:
    """Return whether a value is a finite number."""
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)


def _read_settings(table: Mapping[str, object], name: str) -> list[Setting]:
    """Return the settings of a campaign's file, {parameter: value} each, from [grid] or [[settings]].

    `table`: the file; `name`: its name, for errors.

    Raises:
        ValueError: both or neither of the two, a parameter whose name the store has already, a value that JSON cannot
            hold, two settings that are the same.
    """
    if ("grid" in table) == ("settings" in table):
        raise fail(f"campaign {name}", "either [grid] or [[settings]]", "both" if "grid" in table else "neither")
    settings = _expand_grid(table["grid"], name) if "grid" in table else _read_listed_settings(table["settings"], name)
    _check_parameters(settings, name)
    _check_distinct(settings, name)
    return settings


def _check_parameters(settings: Sequence[Setting], name: str) -> None:
    """Raise ValueError unless each parameter can be a coordinate of the store: its name is free, its value plain.

    `name` is that of the campaign's file, for errors.
    """
    taken = {*DIMENSIONS, *VARIABLES, *COLUMNS}
    for i, setting in enumerate(settings):
        for key, value in setting.items():
            if not key.isidentifier() or key in taken:
                raise fail(f"{name}, parameter {key!r}", f"a Python name other than {', '.join(sorted(taken))}", key)
            _check_json_value(value, f"{name}, {key} of setting {i}")


def _check_distinct(settings: Sequence[Setting], name: str) -> None:
    """Raise ValueError if two settings are equal: they would have equal random keys, and so equal runs."""
    seen: dict[str, int] = {}  # {a setting as text: the number of the first such setting}
    for i, setting in enumerate(settings):
        first = seen.setdefault(serialise_setting(setting), i)
        if first != i:
            same = f"the same as setting {first}, {serialise_setting(setting)}"
            raise fail(f"{name}, setting {i}", "distinct settings", same)


def _expand_grid(grid: object, name: str) -> list[Setting]:
    """Return every combination of the values that the table [grid] lists for each parameter, one setting each."""
    if not isinstance(grid, dict) or not grid:
        raise fail(f"{name}, grid", "a table of lists of values by parameter", _format_value_for_error(grid))
    for key, values in grid.items():
        if not isinstance(values, list) or not values:
            raise fail(f"{name}, grid.{key}", "a list of values", repr(values))
    return [dict(zip(grid, values, strict=True)) for values in product(*grid.values())]


def _read_listed_settings(settings: object, name: str) -> list[Setting]:
    """Return the tables of [[settings]], at least one."""
    if not isinstance(settings, list) or not settings or not all(isinstance(s, dict) for s in settings):
        raise fail(f"{name}, settings", "tables [[settings]]", repr(settings))
    return settings


def _check_json_value(value: object, name: str) -> None:
    """Raise ValueError if JSON cannot represent a value without loss; `name` is the value's name, for errors."""
    if isinstance(value, dict | list):
        for entry in value.values() if isinstance(value, dict) else value:
            _check_json_value(entry, name)
    elif not isinstance(value, str | bool) and not _is_number(value):
        raise fail(name, "finite numbers, strings, booleans, lists or tables", repr(value))


def _check_arguments(campaign: Campaign, name: str) -> None:
    """Raise ValueError, before any computation, if the network's function does not take the settings as arguments."""
    signature = inspect.signature(campaign.function())
    for i, setting in enumerate(campaign.settings):
        try:
            signature.bind(**setting)
        except TypeError as error:
            raise fail(f"{name}, setting {i}", f"arguments of {campaign.network}{signature}", str(error)) from None
