"""Packages that the core does without, and the command that brings them."""

import sys
from collections.abc import Iterable
from importlib.util import find_spec
from pathlib import Path

import heliograph

EXTRAS = {  # the extra that brings a package which the core does without
    "pyarrow": "tables",
    "matplotlib": "report",
    "jinja2": "report",
    "markdown_it": "report",
    "gtsam": "recordings",
    "cvxpy": "lmi",
    "clarabel": "lmi",
    "scs": "lmi",
    "xarray": "results",
    "h5netcdf": "results",
    "h5py": "results",
    "pandas": "results",
    "arviz": "arviz",
    "zarr": "sweep",
    "bokeh": "explore",
    "dask": "cluster",
    "distributed": "cluster",
    "pydantic": "live",
    "pydantic_core": "live",
    "sqlalchemy": "live",
    "prometheus_client": "live",
    "starlette": "live",
    "uvicorn": "live",
    "paho": "live",
    "nats": "live",
    "psycopg": "postgres",
    "rosbags": "bags",
    "asyncua": "opcua",
    "can": "can",
    "cantools": "can",
    "asammdf": "mdf",
    "pyulog": "ulog",
}


def how_to_install(extra: str) -> str:
    """Return a command that installs an extra (a set of optional packages) for this Python.

    From a clone of the repository, it installs from the clone's folder, since no index may have the package.
    """
    clone = Path(heliograph.__file__).parents[2]
    package = clone if (clone / "pyproject.toml").is_file() else "heliograph"
    return f'{sys.executable} -m pip install "{package}[{extra}]"'


class MissingPackagesError(ModuleNotFoundError):
    """Packages of extras that are not installed: one line with all of them, and one command that brings them."""


def check_installed(packages: Iterable[str]) -> None:
    """Raise MissingPackagesError, with the command to install them, if some of these packages are not installed.

    EXTRAS: for each optional package of heliograph, the extra that brings it.
    """
    missing = [name for name in dict.fromkeys(packages) if find_spec(name) is None]
    if missing:
        extras = ",".join(sorted({EXTRAS[name] for name in missing if name in EXTRAS}))
        others = " ".join(name for name in missing if name not in EXTRAS)  # of studies of other packages
        command = how_to_install(extras) if extras else f"{sys.executable} -m pip install"
        what = "package" if len(missing) == 1 else "packages"
        text = f"{', '.join(missing)}: expected to be installed, got no such {what}: {command} {others}"
        raise MissingPackagesError(text.rstrip(), name=missing[0])
