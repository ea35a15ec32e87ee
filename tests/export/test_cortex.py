"""The files compiled for a processor without double precision, a Cortex-M4, where that compiler is installed."""

import shutil
import subprocess

import pytest

import heliograph as hg
from tests.export.device import FLAGS
from tests.export.test_apart import MAKERS, SENSOR, VEHICLE

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
    hg.export_c(MAKERS[name](VEHICLE, SENSOR), tmp_path / "step.c", "float", apart=True)
    flags = [*FLAGS[:-1], *CORTEX, "-Wdouble-promotion"]
    subprocess.run([f"{CROSS}-gcc", *flags, "-c", "step.c", "-o", "step.o"], cwd=tmp_path, check=True)
    listed = subprocess.run([f"{CROSS}-nm", "-u", "step.o"], cwd=tmp_path, capture_output=True, text=True, check=True)
    called = set(listed.stdout.split()) - {"U"}
    assert called <= {"sinf", "cosf", "sqrtf", "hypotf", "nearbyintf", "memcpy", "memset"}, called
