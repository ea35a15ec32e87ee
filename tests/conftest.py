"""Compiled programs are shared by the test processes of one session, in a folder that goes with it."""

import os
import shutil
import tempfile

FOLDER = "JAX_COMPILATION_CACHE_DIR"


def pytest_configure(config):
    """The first process makes the folder; workers and the commands that tests start find it in their environment."""
    if FOLDER not in os.environ:
        os.environ[FOLDER] = config.compilations = tempfile.mkdtemp(prefix="heliograph-tests-")
        os.environ["JAX_PERSISTENT_CACHE_MIN_COMPILE_TIME_SECS"] = "0.5"


def pytest_unconfigure(config):
    """Remove it."""
    if hasattr(config, "compilations"):
        shutil.rmtree(config.compilations, ignore_errors=True)
