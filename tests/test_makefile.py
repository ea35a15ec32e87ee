"""The environment of `make demo` says where tests run."""

import re
import subprocess
from pathlib import Path

ROOT = Path(__file__).parents[1]


def test_pytest_after_make_demo_names_make_test(tmp_path):
    """The recipe's line, with a Python that has no pytest, and with one that has."""
    lines = re.search(r"\t@(\$\(BIN\)/python -c 'import pytest'.*\\\n.*)\n", (ROOT / "Makefile").read_text())[1]
    shell = lines.replace("$(BIN)", str(tmp_path)).replace("\\\n", "")
    for status, there in ((0, False), (1, True)):
        (tmp_path / "python").write_text(f"#!/bin/sh\nexit {status}\n")
        (tmp_path / "python").chmod(0o755)
        subprocess.run(["sh", "-c", shell], check=True)
        assert (tmp_path / "pytest").exists() is there
    result = subprocess.run([tmp_path / "pytest", "tests"], capture_output=True, text=True)
    assert result.returncode == 2 and "run make test" in result.stderr
