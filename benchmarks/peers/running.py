"""The driver's side of `timed`: a program in a process of its own, asked for one time after another."""

import json
import os
import subprocess
from pathlib import Path
from typing import Any

import numpy as np

HERE = Path(__file__).resolve().parent


def program_of(source: Path, file: str) -> Path:
    """Where a release, whose src folder this is, keeps its program of this name."""
    return source.resolve().parent / "benchmarks" / "peers" / f"{file}.py"


class Running:
    """A program in its own process, which has written its estimates and waits to be asked for times."""

    def __init__(self, file: str, python: Path, data: Path, source: Path | None = None):
        """`source` is the src folder of another release, whose own program of this name is run, on its own studies."""
        self.file, written = file, data.with_name(f"{file}{'' if source is None else '_old'}.npy")
        program = HERE / f"{file}.py" if source is None else program_of(source, file)
        folders = () if source is None else (str(source), str(source.resolve().parent / "studies"))
        environment = os.environ | ({"PYTHONPATH": os.pathsep.join(folders)} if folders else {})
        self.process = subprocess.Popen(
            [str(python), str(program), str(data), str(written)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
            env=environment,
        )
        self.about = self._read()
        self.means = np.load(written)
        self.times: list[float] = []
        self.processors: list[float] = []

    def _read(self) -> Any:
        assert self.process.stdout is not None
        line = self.process.stdout.readline()
        if not line:
            raise SystemExit(f"{self.file} failed: expected a line, got none (exit status {self.process.wait()})")
        return json.loads(line)

    def ask(self) -> None:
        """Time one pass."""
        assert self.process.stdin is not None
        print(file=self.process.stdin, flush=True)
        taken = self._read()
        by_clock, of_processors = taken if isinstance(taken, list) else (taken, float("nan"))  # an older release
        self.times.append(by_clock)
        self.processors.append(of_processors)

    def result(self) -> dict[str, Any]:
        """Nanoseconds per step and run."""
        best, median = round(min(self.times), 2), round(float(np.median(self.times)), 2)
        return {"best": best, "median": median, "processors": round(min(self.processors), 2), **self.about}

    def stop(self) -> None:
        """Let it end."""
        self.process.communicate()
