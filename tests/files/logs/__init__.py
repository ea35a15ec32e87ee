"""The same short drive as vehicles record it: BLF, ASC and MDF4 by a database, MDF4 of signals, ULog."""

import datetime
import struct

import numpy as np
import pytest

import heliograph as hg

START = 1_790_000_000  # seconds since 1970: 2026-09-21T14:13:20Z, a Monday
COUNT = 40
TIME = np.arange(COUNT) / 10
SPEED = np.round(36.0 + 0.36 * np.arange(COUNT), 2)  # km/h
DBC = """VERSION ""
BU_: ECU
BO_ 416 WheelSpeeds: 8 ECU
 SG_ FrontLeft : 0|16@1+ (0.01,0) [0|655] "km/h" ECU
 SG_ Counter : 16|4@1+ (1,0) [0|15] "" ECU
BO_ 417 Imu: 4 ECU
 SG_ YawRate : 0|16@1- (0.01,0) [-327|327] "deg/s" ECU
"""


def car():
    """A car on a line, whose one wheel says its speed in m/s."""
    sensor = hg.LinearSensor([[1.0]], 0.01, outputs=["speed"])
    plant = hg.LinearPlant(
        lambda u: np.eye(1), lambda u: 0.1 * u[0] * np.eye(1), [10.0], 1.0, states=["v"], inputs=["dt"]
    )
    return hg.Network(plant, {"wheel": hg.Node(sensor, hg.perfect(), {"KF": hg.kalman_filter(plant, sensor)})})


def wheel(path="FrontLeft", **given):
    return hg.files.json_field(path, node="wheel", output="speed", scale=1 / 3.6, **given)


def database(folder, text=DBC):
    path = folder / "car.dbc"
    path.write_text(text)
    return path


def frame(k, data=None, **given):
    can = pytest.importorskip("can", reason="the extra `can`")
    data = struct.pack("<HBBI", round(100 * SPEED[k]), k % 16, 0, 0) if data is None else data
    given = {"arbitration_id": 416, "is_extended_id": False, "channel": 0} | given
    return can.Message(timestamp=START + TIME[k], data=data, **given)


def write_frames(path, frames=None):
    can = pytest.importorskip("can", reason="the extra `can`")
    pytest.importorskip("cantools", reason="the extra `can`")
    if path.suffix == ".mf4":
        pytest.importorskip("asammdf", reason="the extra `mdf`")
    with can.Logger(path) as log:
        for each in [frame(k) for k in range(COUNT)] if frames is None else frames:
            log.on_message_received(each)
    return path


def find_begin(path):
    """Return the seconds of a log's begin; that of python-can's MDF4 is when its writer was opened."""
    if path.suffix != ".mf4":
        return START
    import asammdf

    with asammdf.MDF(path) as file:
        return file.start_time.timestamp()


def write_mdf(path, invalid=(), rows=slice(None), unit="km/h"):
    asammdf = pytest.importorskip("asammdf", reason="the extra `mdf`")
    bits = np.isin(np.arange(COUNT), invalid)
    file = asammdf.MDF(version="4.10")
    file.start_time = datetime.datetime.fromtimestamp(START, datetime.UTC)
    marks = bits[rows] if len(invalid) else None
    speed = asammdf.Signal(SPEED[rows], TIME[rows], name="FrontLeft", unit=unit, invalidation_bits=marks)
    file.append([speed], acq_name="WheelSpeeds")
    file.append([asammdf.Signal(np.arange(5.0), np.arange(5) / 2, name="YawRate", unit="deg/s")])
    file.save(path, overwrite=True)
    return path


def write_ulog(path, date=True, boot=7_000_000, rows=slice(None)):
    """Write the topics by the description of the format; `boot` is in microseconds since the device began to run."""
    pytest.importorskip("pyulog", reason="the extra `ulog`")

    def record(kind, content):
        return struct.pack("<HB", len(content), ord(kind)) + content

    parts = [b"ULog\x01\x12\x35\x01" + struct.pack("<Q", boot), record("B", bytes(40))]
    parts.append(record("F", b"WheelSpeeds:uint64_t timestamp;float FrontLeft;"))
    parts.append(record("F", b"vehicle_gps_position:uint64_t timestamp;uint64_t time_utc_usec;"))
    parts.append(record("A", struct.pack("<BH", 0, 0) + b"WheelSpeeds"))
    parts.append(record("A", struct.pack("<BH", 0, 1) + b"vehicle_gps_position"))
    for k in range(COUNT)[rows]:
        parts.append(record("D", struct.pack("<HQf", 0, boot + k * 100_000, SPEED[k])))
    if date:
        parts.append(record("D", struct.pack("<HQQ", 1, boot + 500_000, START * 10**6 + 500_000)))
    path.write_bytes(b"".join(parts))
    return path
