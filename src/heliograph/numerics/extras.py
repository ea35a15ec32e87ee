"""Packages that the core does without, and the command that brings them."""

import sys
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
}


def how_to_install(extra: str) -> str:
    """A command that brings an extra to this Python, also from a clone, whose name no index knows."""
    clone = Path(heliograph.__file__).parents[2]
    package = clone if (clone / "pyproject.toml").is_file() else "heliograph"
    return f'{sys.executable} -m pip install "{package}[{extra}]"'
