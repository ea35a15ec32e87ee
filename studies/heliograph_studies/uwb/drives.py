"""The drives in a folder: in the recording's own layout, or as tables of ranges, anchors and truth."""

import csv
import re
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from heliograph.numerics.check import fail

LAYOUT = (
    "folders CONDITION/Trajectory_T/Case_C with A3.csv, ... and trajectory.csv, "
    "or folders with ranges.csv, anchors.csv and truth.csv"
)
FLAT = 0.5  # m: rows of the reference that are further from its first height are no reference
WINDOWS = {"a": ((49.3, -5.0), (12.0, 3.4)), "b": ((8.6, -7.0), (8.6, -7.0))}


@dataclass(frozen=True)
class Drive:
    """Ranges in order of time, and the reference.

    time (rows,) in s after the first row of the reference; anchor (rows,) number of the anchor in `places`; distance
    (rows,) in m; power (rows,) RSSI in dBm. names and places (anchors, 3). truth_time (points,), truth (points, 3).
    window: from where to where errors count (s). published: RMSE in the plane (m) of least squares and of the
    error-state filter with inertial data, None where nobody published them.
    """

    name: str
    time: np.ndarray
    anchor: np.ndarray
    distance: np.ndarray
    power: np.ndarray
    names: tuple[str, ...]
    places: np.ndarray
    truth_time: np.ndarray
    truth: np.ndarray
    window: tuple[float, float]
    published: tuple[float | None, float | None]


PUBLISHED = {"los_a1": (51.625, 191.375, 1.0384, 1.1158), "los_b3": (56.875, 149.625, 0.5217, 0.6003),
             "nlos_a1": (54.25, 223.5, 0.9775, 0.9375), "nlos_b4": (47.75, 142.375, 0.5008, 0.5078)}  # fmt: skip


def drives(folder: Path) -> list[Drive]:
    """All drives in a folder and below it, each once, in order of name.

    Raises:
        ValueError: no folder, no drive in it, a file that cannot be read or lacks a column.
    """
    if not str(folder) or not folder.is_dir():
        raise fail("--recording", f"a folder of the recording ({LAYOUT})", str(folder) or "none")
    there: dict[str, Drive] = {}
    listed = _listed(folder)
    for path in sorted(folder.rglob("ranges.csv")):
        there.setdefault(path.parent.name, _cut(path.parent, listed))
    for path in sorted(folder.rglob("trajectory.csv")):
        name = original_name(path.parent)
        if name not in there:
            there[name] = _original(path.parent, name, listed)
    if not there:
        raise fail("--recording", f"a folder with drives ({LAYOUT})", f"none in {folder}")
    return [there[name] for name in sorted(there)]


def original_name(folder: Path) -> str:
    """Such as los_a1, of .../LOS/Trajectory_A/Case_1."""
    condition, trajectory, case = folder.parts[-3:] if len(folder.parts) >= 3 else ("", "", "")
    if not re.fullmatch(r"Trajectory_\w+", trajectory) or not re.fullmatch(r"Case_\w+", case):
        return folder.name
    return f"{condition}_{trajectory.split('_', 1)[1]}{case.split('_', 1)[1]}".lower()


def _listed(folder: Path) -> dict[str, tuple[float, float, float | None, float | None]]:
    """Window and published errors by drive: those of `drives.csv`, of the four drives that are known else."""
    results: dict[str, tuple[float, float, float | None, float | None]] = dict(PUBLISHED)
    for path in [folder.parent / "drives.csv", *sorted(folder.rglob("drives.csv"))]:
        if path.is_file():
            for row in _rows(path, ("drive", "window_start", "window_end")):
                errors = [_number(row.get(name)) for name in ("ls_rmse_2d", "eskf_rmse_2d")]
                start, end = _number(row["window_start"]), _number(row["window_end"])
                if start is not None and end is not None:
                    results[row["drive"]] = (start, end, errors[0], errors[1])
    return results


def _number(text: str | None) -> float | None:
    try:
        return float(text) if text else None
    except ValueError:
        return None


def _cut(folder: Path, listed: dict[str, tuple[float, float, float | None, float | None]]) -> Drive:
    ranges = table(folder / "ranges.csv", ("time", "anchor", "range", "rssi"))
    anchors = table(folder / "anchors.csv", ("anchor", "x", "y", "z"))
    truth = table(folder / "truth.csv", ("time", "x", "y", "z"))
    return _drive(folder.name, ranges, anchors, truth, listed)


def _original(folder: Path, name: str, listed: dict[str, tuple[float, float, float | None, float | None]]) -> Drive:
    reference = table(folder / "trajectory.csv", ("timestamp", "x", "y", "z"))
    start = reference[0, 0]
    truth = np.column_stack([(reference[:, 0] - start) * 1e-9, reference[:, 1:]])
    columns = ("field.stamp", "field.id", "field.distanceFromTag", "field.rssi", "field.x", "field.y", "field.z")
    rows = np.concatenate([table(path, columns) for path in sorted(folder.glob("A*.csv"))] or [np.zeros((0, 7))])
    rows = rows[rows[:, 0] >= start]
    if not len(rows):
        raise fail(f"drive {folder}", "ranges in A3.csv, ... after the reference's first row", "none")
    anchors = np.array(sorted({tuple(row) for row in rows[:, [1, 4, 5, 6]]}))
    ranges = np.column_stack([(rows[:, 0] - start) * 1e-9, rows[:, 1:4]])
    return _drive(name, ranges, anchors, truth, listed)


def _drive(
    name: str, ranges: np.ndarray, anchors: np.ndarray, truth: np.ndarray,
    listed: dict[str, tuple[float, float, float | None, float | None]],
) -> Drive:  # fmt: skip
    ranges = ranges[np.argsort(ranges[:, 0], kind="stable")]
    ranges = ranges[ranges[:, 0] >= 0]
    number = {value: i for i, value in enumerate(anchors[:, 0])}
    unknown = sorted(set(ranges[:, 1]) - set(number))
    if unknown:
        raise fail(f"ranges of drive {name}", "anchors of anchors.csv", unknown)
    truth = truth[np.abs(truth[:, 3]) < FLAT]
    if not len(truth):
        raise fail(f"reference of drive {name}", f"rows within {FLAT:g} m of the height of its first", "none")
    known = listed.get(name)
    window = known[:2] if known else turning_points(name, truth)
    if not np.any((ranges[:, 0] >= window[0]) & (ranges[:, 0] <= window[1])):
        raise fail(f"window of drive {name}", "seconds in which there are ranges", f"{window[0]:g} to {window[1]:g}")
    return Drive(
        name, ranges[:, 0], np.array([number[a] for a in ranges[:, 1]]), ranges[:, 2], ranges[:, 3],
        tuple(f"{a:g}" for a in anchors[:, 0]), anchors[:, 1:], truth[:, 0], truth[:, 1:], window,
        known[2:] if known else (None, None),
    )  # fmt: skip


def turning_points(name: str, truth: np.ndarray) -> tuple[float, float]:
    """From the far end to the return, as published: A from x > 49.3, y > -5 to x <= 12, y > 3.4; B within x and y."""
    time, x, y = truth[:, 0], truth[:, 1], truth[:, 2]
    (far, low), (near, high) = WINDOWS.get(name.rsplit("_", 1)[-1][:1], WINDOWS["b"])
    if far > near:
        starts, ends = np.flatnonzero((x > far) & (y > low)), np.flatnonzero((x <= near) & (y > high))
    else:
        starts, ends = np.flatnonzero((x < far) & (y < low)), np.flatnonzero((x > near) & (y < high))
    if len(starts) and len(ends[ends > starts[0]]):
        return float(time[starts[0]]), float(time[ends[ends > starts[0]][0]])
    return float(time[0]), float(time[-1])


def table(path: Path, columns: tuple[str, ...]) -> np.ndarray:
    """Numbers of these columns, (rows, columns).

    Raises:
        ValueError: a file that cannot be read, a column that is missing, what is no number.
    """
    rows = list(_rows(path, columns))
    try:
        result = np.array([[float(row[name]) for name in columns] for row in rows]).reshape(-1, len(columns))
    except (TypeError, ValueError) as error:
        raise fail(str(path), "numbers", str(error)[:60]) from None
    if not len(result) or not np.all(np.isfinite(result)):
        raise fail(str(path), "rows of finite numbers", f"{len(result)} rows")
    return result


def _rows(path: Path, columns: tuple[str, ...]) -> Iterator[dict[str, str]]:
    try:
        with path.open(encoding="utf-8", newline="") as file:
            reader = csv.DictReader(file)
            names = [name.strip() for name in reader.fieldnames or ()]
            missing = [name for name in columns if name not in names]
            if missing:
                raise fail(str(path), f"columns {', '.join(columns)}", f"no {', '.join(missing)}")
            reader.fieldnames = names
            yield from reader
    except OSError as error:
        raise fail(str(path), "a table of the recording", (error.strerror or "an error").lower()) from None
    except UnicodeDecodeError as error:
        raise fail(str(path), "a table of the recording", str(error)[:80]) from None
