"""An exported step, compiled and called from Python; what is compiled is compiled as strictly as is promised."""

import ctypes
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from heliograph.export.c_files import export_c

COMPILER, FLAGS = "cc", ("-std=c99", "-pedantic", "-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror", "-O2")

needs_compiler = pytest.mark.skipif(
    shutil.which(COMPILER) is None, reason=f"no C compiler: the command {COMPILER!r} is not there"
)


class Device:
    """One filter as it runs on a device; `state` is its memory."""

    def __init__(
        self,
        filter_,
        folder: Path,
        name="step",
        precision="double",
        of=None,
        node=None,
        apart=False,
        size=False,
        window=None,
        compiler=COMPILER,
    ):
        self.exported = export_c(filter_, folder / f"{name}.c", precision, of, node, apart, size, window)
        library = folder / f"{name}_{precision}.so"
        command = [compiler, *FLAGS, "-shared", "-fPIC", self.exported.source.name, "-o", library.name, "-lm"]
        subprocess.run(command, cwd=folder, check=True)
        self.library, self.name = ctypes.CDLL(str(library)), name
        self.real = ctypes.c_double if precision == "double" else ctypes.c_float
        self.size = len(filter_.states)
        for part in ("mean", "covariance"):
            self._function(part).restype = ctypes.POINTER(self.real)
        self.begin = self._function("start" if window is None else "window_start")
        self.start()

    def start(self) -> None:
        """Begin, or begin again, in memory that held anything before."""
        self.state = np.full(self.exported.state_bytes // 4, -1, dtype=np.int32)
        self.begin(self._pointer(self.state))

    def step(self, z, u=()) -> int:
        """Advance; 0 unless refused."""
        return self.call("step", z, u)

    def call(self, function, *numbers) -> int:
        """Call a function of the state with arrays of numbers; arrays that are of the device's numbers it may fill."""
        arrays = [np.ascontiguousarray(a, dtype=self.real) for a in numbers]
        return self._function(function)(*map(self._pointer, (self.state, *arrays)))

    def mean(self) -> np.ndarray:
        """The estimate's mean."""
        return self._read("mean", (self.size,))

    def covariance(self) -> np.ndarray:
        """And covariance."""
        return self._read("covariance", (self.size, self.size))

    def follow(self, z, u):
        """Mean and covariance after each step."""
        means, covariances = [], []
        for row, given in zip(z, u, strict=True):
            assert self.step(row, given) == 0
            means.append(self.mean())
            covariances.append(self.covariance())
        return np.stack(means), np.stack(covariances)

    def _read(self, part, shape):
        pointer = self._function(part)(self._pointer(self.state))
        return np.ctypeslib.as_array(pointer, shape).astype(float)

    def _function(self, part):
        return getattr(self.library, f"{self.name}_{part}")

    @staticmethod
    def _pointer(array):
        return ctypes.c_void_p(array.ctypes.data)
