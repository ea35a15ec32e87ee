"""The files compiled for a processor without double precision, a Cortex-M4, where that compiler is installed."""

import shutil
import subprocess
import warnings

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from tests.export.device import FLAGS
from tests.export.test_apart import MAKERS, SENSOR, VEHICLE
from tests.export.test_far_origin import CAR
from tests.export.test_late_measurement_window import ANGLES, TURN

CAR_SENSOR = hg.Sensor(lambda x: jnp.stack([x[0], x[1], x[2], x[4]]), np.diag([1.0, 1.0, 0.01, 1e-4]))
CROSS = "arm-none-eabi"
CORTEX = ("-mcpu=cortex-m4", "-mthumb", "-mfloat-abi=hard", "-mfpu=fpv4-sp-d16", "-Os")
needs_cross_compiler = pytest.mark.skipif(
    shutil.which(f"{CROSS}-gcc") is None, reason=f"no compiler for Cortex-M: the command {CROSS}-gcc is not there"
)


@pytest.mark.slow
@needs_cross_compiler
@pytest.mark.parametrize("name", ["extended", "gate"])
def test_single_precision_stays_single_on_a_device(name, tmp_path):
    """No warning, no number made double, and no call of the library that emulates doubles; no heap."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # noise for each step is not divided
        hg.export_c(MAKERS[name](VEHICLE, SENSOR), tmp_path / "step.c", "float", apart=True, window=20)
    flags = [*FLAGS[:-1], *CORTEX, "-Wdouble-promotion"]
    subprocess.run([f"{CROSS}-gcc", *flags, "-c", "step.c", "-o", "step.o"], cwd=tmp_path, check=True)
    listed = subprocess.run([f"{CROSS}-nm", "-u", "step.o"], cwd=tmp_path, capture_output=True, text=True, check=True)
    called = set(listed.stdout.split()) - {"U"}
    assert called <= {"sinf", "cosf", "sqrtf", "hypotf", "nearbyintf", "memcpy", "memset"}, called


@pytest.mark.slow
@needs_cross_compiler
@pytest.mark.filterwarnings("ignore:window")
def test_late_measurements_take_little_code(tmp_path):
    """Beside the step, which is there once: functions that hold rows and run them again."""
    for filter_, most in ((hg.extended_filter(TURN, ANGLES), 800), (MAKERS["extended"](VEHICLE, SENSOR), 1200)):
        sizes = [measure_code(tmp_path, filter_, window=window)[0] for window in (None, 20)]
        assert 0 < sizes[1] - sizes[0] < most


def measure_code(folder, filter_, **options):
    """Bytes of code and constants at -Os, and of the state."""
    written = hg.export_c(filter_, folder / "step.c", "float", size=True, **options)
    subprocess.run([f"{CROSS}-gcc", *FLAGS[:-1], *CORTEX, "-c", "step.c", "-o", "step.o"], cwd=folder, check=True)
    listed = subprocess.run([f"{CROSS}-size", "step.o"], cwd=folder, capture_output=True, text=True, check=True)
    code, data = listed.stdout.split()[6:8]
    return int(code) + int(data), written.state_bytes


@pytest.mark.slow
@needs_cross_compiler
@pytest.mark.parametrize(("name", "most"), [("extended", 10_500), ("cubature", 20_000)])
def test_a_car_fits(name, most, tmp_path):
    """Bytes of code and constants of one step of five states and four outputs, at -Os (31,000 unrolled)."""
    code, state = measure_code(tmp_path, MAKERS[name](CAR, CAR_SENSOR))
    assert code < most and state < 300
