"""Outdoor ranges: both layouts are read alike, and the example keeps its errors and claims on drives made up here."""

import csv
import json

import numpy as np
import pytest

from heliograph_studies import uwb
from heliograph_studies.uwb.drives import drives
from heliograph_studies.uwb.learning import followed, learn, padded, slots
from heliograph_studies.uwb.setting import STARTS

ANCHORS = np.array([[2.5, 0.9, 2.0], [2.5, -0.9, 2.0], [-2.5, -0.9, 0.5], [-0.7, 0.9, 0.5]])
NAMES = (3, 5, 9, 12)
LATE = 0.17


def write(path, header, rows):
    path.parent.mkdir(parents=True, exist_ok=True)
    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(header)
        writer.writerows(rows)


def made(seed, seconds=60.0):
    """A round walk, and ranges with a bias of each anchor, quick errors, losses, and outliers that are too short."""
    rng = np.random.default_rng(seed)
    time = np.arange(0, seconds, 0.1)

    def place(t):
        return np.stack([8 * np.cos(0.12 * t), 8 * np.sin(0.12 * t), 0 * t], axis=-1)

    radio = np.random.default_rng(seed + 1000)  # received power falls with the logarithm of the distance, to 1 dB
    bias, quick, rows = 0.05 + 0.04 * rng.standard_normal(4), np.zeros(4), []
    for t in time:
        quick = 0.93 * quick + 0.37 * 0.04 * rng.standard_normal(4)
        tag = place(t - LATE) + np.array([0, 0, 1.0])
        distance = np.linalg.norm(tag - ANCHORS, axis=1)
        power = -70.0 - 6.0 * np.log10(distance) + radio.standard_normal(4)
        value = distance + bias + quick + 0.02 * rng.standard_normal(4)
        value -= np.where(rng.random(4) < 0.01, 5.0, 0.0)
        rows += [(t + 0.001 * i, NAMES[i], value[i], power[i]) for i in range(4) if rng.random() > 0.08]
    reference = np.arange(0, seconds, 0.125)
    return np.array(rows), np.column_stack([reference, place(reference)])


def as_tables(folder, rows, truth):
    write(
        folder / "ranges.csv", ["time", "anchor", "range", "rssi", "first_path_rssi"], [[*row, -81.0] for row in rows]
    )
    write(folder / "anchors.csv", ["anchor", "x", "y", "z"], [[n, *a] for n, a in zip(NAMES, ANCHORS, strict=True)])
    write(folder / "truth.csv", ["time", "x", "y", "z", "heading"], [[*row, 0.0] for row in truth])


def as_original(folder, rows, truth):
    begin = 1_700_000_000_000_000_000
    write(folder / "trajectory.csv", ["timestamp", "x", "y", "z"], [[begin + int(t * 1e9), *x] for t, *x in truth])
    header = [f"field.{name}" for name in ("stamp", "id", "distanceFromTag", "rssi", "x", "y", "z")]
    for name, anchor in zip(NAMES, ANCHORS, strict=True):
        of_anchor = [[begin + int(t * 1e9), n, d, p, *anchor] for t, n, d, p in rows if n == name]
        write(folder / f"A{name}.csv", header, of_anchor)


def test_both_layouts_are_read_alike(tmp_path):
    rows, truth = made(0, 20.0)
    as_tables(tmp_path / "cut" / "los_b1", rows, truth)
    as_original(tmp_path / "set" / "Dynamic_measurements" / "LOS" / "Trajectory_B" / "Case_1", rows, truth)
    (cut,), (other,) = drives(tmp_path / "cut"), drives(tmp_path / "set")
    assert cut.name == other.name == "los_b1"
    np.testing.assert_allclose(other.time, cut.time, atol=1e-6)  # stamps are whole nanoseconds
    np.testing.assert_array_equal(other.distance, cut.distance)
    np.testing.assert_array_equal(other.places, cut.places)
    read = slots(cut)
    assert np.isfinite(read.ranges).sum() == len(rows) and len(read.time) <= 200


def altered(folder):
    """The reference of a drive that is written into the folder, to be made bad."""
    as_tables(folder / "nlos_a9", *made(0, 10.0))
    return folder / "nlos_a9" / "truth.csv"


@pytest.mark.parametrize(("write_bad", "message"), [
    (lambda folder: None, "--recording: expected a folder with drives"),
    (lambda folder: write(folder / "x" / "ranges.csv", ["time"], [[0]]), "ranges.csv: expected columns time, anchor"),
    (lambda folder: altered(folder).unlink(), "truth.csv: expected a table of the recording, got no such file"),
    (lambda folder: write(altered(folder), ["time", "x", "y", "z"], [[0, 0, 0, 1], [9, 1, 1, 1]]),
     "reference of drive nlos_a9: expected rows within 0.5 m of the height of its first, got none"),
    (lambda folder: write(altered(folder).parents[1] / "drives.csv", ["drive", "window_start", "window_end"],
                          [["nlos_a9", 500, 600]]),
     "window of drive nlos_a9: expected seconds in which there are ranges, got 500 to 600"),
])  # fmt: skip
def test_what_is_no_recording_is_refused_in_one_line(tmp_path, write_bad, message):
    write_bad(tmp_path)
    with pytest.raises(ValueError, match=message) as caught:
        drives(tmp_path)
    assert "\n" not in str(caught.value)


@pytest.mark.slow
def test_drives_with_other_anchors_teach_each_other(tmp_path):
    """One drive lacks an anchor in its tables: it is read, and its rows are those that it has alone."""
    rows, truth = made(0, 20.0)
    as_tables(tmp_path / "nlos_a9", rows, truth)
    few = rows[rows[:, 1] != NAMES[2]]
    as_tables(tmp_path / "los_c2", few, truth)
    write(tmp_path / "los_c2" / "anchors.csv", ["anchor", "x", "y", "z"],
          [[n, *a] for n, a in zip(NAMES, ANCHORS, strict=True) if n != NAMES[2]])  # fmt: skip
    both = drives(tmp_path)
    assert [len(drive.places) for drive in both] == [3, 4]
    numbers = [STARTS["huber"]] * 2
    together = followed("huber", numbers, padded(both))
    alone = followed("huber", numbers[:1], padded(both[:1]))
    np.testing.assert_allclose(together.place[0], alone.place[0], rtol=1e-12)
    assert learn("gate", [], 6) == STARTS["gate"]  # a drive alone


@pytest.mark.slow
def test_the_example_writes_errors_claims_and_who_is_to_blame(tmp_path):
    """Two drives that teach each other; errors of 0.3 m and a NEES within a factor of four are far from both limits."""
    for seed, name in enumerate(("los_b1", "los_b2")):
        as_tables(tmp_path / "in" / name, *made(seed))
    uwb.run(uwb.Setting(str(tmp_path / "in"), iterations=1), tmp_path / "out")
    summary = json.loads((tmp_path / "out" / "uwb" / "summary.json").read_text())
    for drive in summary["drives"].values():
        assert drive["published"] == {"ls": None, "eskf": None}
        best, plain = drive["rules"]["memory"], drive["rules"]["plain"]
        assert best["rmse"] < 0.3 and 0.25 < best["nees"] < 4
        assert best["rmse"] < plain["rmse"] and drive["rules"].keys() == STARTS.keys()
        assert 0.05 < drive["losses"]["loss"] < 0.12
    page = (tmp_path / "out" / "uwb" / "report.html").read_text()
    assert "down-weighted" in page and "los_b2" in page
