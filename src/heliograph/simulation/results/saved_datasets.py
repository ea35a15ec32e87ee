"""Datasets in files: NetCDF or Zarr, written whole or not at all, with names unchanged."""

import warnings
from collections.abc import Callable, Mapping
from copy import copy
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from heliograph.disk.atomic_files import check_replaceable, check_writable, whole_file, whole_folder
from heliograph.disk.quoted_text import quote_for_file, unquote_file
from heliograph.numerics.check import fail, file_path
from heliograph.simulation.results.labelled_datasets import select_given_units

if TYPE_CHECKING:  # an extra
    import xarray as xr

NETCDF, ZARR = ".nc", ".zarr"


class SavableResults:
    """Results that convert to and from a dataset, and so to and from a file with `save` and `open`."""

    states: tuple[str, ...]
    units: dict[str, str]
    smoothed: Self | None

    def with_units(self, units: Mapping[str, str]) -> Self:
        """Return the same results with units, by the state's name or "time", for files, tables and figures.

        Raises:
            ValueError: a name that is no state.
        """
        smoothed = None if self.smoothed is None else self.smoothed.with_units(units)
        changed = copy(self)
        vars(changed).update(units=select_given_units(units, self.states), smoothed=smoothed)  # fields are frozen
        return changed

    def to_xarray(self) -> "xr.Dataset":
        """Return the results as labelled arrays.

        Raises:
            ModuleNotFoundError: without xarray (extra "results").
        """
        raise NotImplementedError

    @classmethod
    def from_xarray(cls, dataset: "xr.Dataset") -> Self:
        """Return the results that labelled arrays hold.

        Raises:
            ValueError: no such dataset.
        """
        raise NotImplementedError

    def apart(self) -> list[str]:
        """Return the names of the parts that are not in the dataset, being results of their own."""
        return [] if self.smoothed is None else ["smoothed"]

    def save(self, path: str | Path) -> None:
        """Write these results to a NetCDF file (.nc) or a Zarr folder (.zarr), which `open` reads.

        A write that fails leaves an earlier file as it was. Parts that must be saved separately, such as `smoothed`,
        raise a warning.

        Raises:
            ValueError: another ending, or a place that cannot be written.
            ModuleNotFoundError: without the extra "results", or "sweep" for Zarr.
        """
        save(self.to_xarray(), path)
        for name in self.apart():
            warnings.warn(f"{path}: without `{name}`, which is saved apart", stacklevel=2)

    @classmethod
    def open(cls, path: str | Path) -> Self:
        """Read a file that `save` wrote.

        Raises:
            ValueError: no such file, or another one.
            ModuleNotFoundError: without the extra "results", or "sweep" for Zarr.
        """
        return cls.from_xarray(open_dataset(path))


def save(dataset: "xr.Dataset", path: str | Path) -> None:
    """Write a dataset to a NetCDF file or a Zarr folder, replacing an earlier one.

    The ending of `path` chooses the format. An earlier file is replaced only when the new one is complete.

    Raises:
        ValueError: another ending, a place that cannot be written or that holds something else.
        ModuleNotFoundError: an extra is not installed.
    """
    path = file_path("file of results", path)
    # The package that writes this format; raise now if it is not installed.
    package = _find_package(path)
    import_module(package)  # raises now if the extra is not installed
    # Names as text that any file can hold; floats without a fill value.
    plain = dataset.assign_coords(
        {name: (c.dims, _map_names(quote_for_file, c), c.attrs) for name, c in _list_names(dataset)}
    )
    encoding: Any = {name: {"_FillValue": None} for name in plain.variables if plain[name].dtype.kind == "f"}
    if dataset["time"].dtype.kind == "M":
        # Nanoseconds, so that no date is rounded.
        encoding["time"] = {"units": "nanoseconds since 1970-01-01", "dtype": "int64"}
    # A folder, or a file, that replaces an earlier one when it is complete.
    if package == "zarr":
        check_replaceable(path)
        with whole_folder(path) as folder, warnings.catch_warnings():
            warnings.simplefilter("ignore")  # that the format's text does not have strings or consolidation yet
            plain.to_zarr(folder, mode="w", encoding=encoding)
        return
    check_writable(path, (NETCDF,))
    with whole_file(path) as partial:
        plain.to_netcdf(partial, engine="h5netcdf", encoding=encoding)


def open_dataset(path: str | Path) -> "xr.Dataset":
    """Return the dataset of a NetCDF file or a Zarr folder, read into memory.

    Raises:
        ValueError: no such file, or one that is none.
        ModuleNotFoundError: an extra is not installed.
    """
    path = file_path("file of results", path)
    package = _find_package(path)
    import_module(package)  # raises now if the extra is not installed
    import xarray as xr

    if not path.exists():
        raise fail(str(path), "a file of results", "nothing of that name")
    try:
        with xr.open_dataset(path, engine=package, decode_timedelta=False) as stored:
            dataset = stored.load()
    except (OSError, ValueError, KeyError) as error:
        raise fail(str(path), "a file of results that can be read", f"{type(error).__name__}: {error}") from None
    return dataset.assign_coords(
        {name: (c.dims, _map_names(unquote_file, c), c.attrs) for name, c in _list_names(dataset)}
    )


def _find_package(path: Path) -> str:
    """Return the name of the package for files with this suffix; raise ValueError for an unknown suffix."""
    packages = {NETCDF: "h5netcdf", ZARR: "zarr"}
    if path.suffix.lower() not in packages:
        raise fail(str(path), f"a name that ends in {' or '.join(packages)}", repr(path.suffix))
    return packages[path.suffix.lower()]


def _list_names(dataset: "xr.Dataset") -> list[tuple[object, "xr.DataArray"]]:
    """Return (name, coordinate) of the coordinates of a dataset that are names, not numbers."""
    return [(name, c) for name, c in dataset.coords.items() if c.dtype.kind in "OUT"]


def _map_names(change: Callable[[str], str], names: "xr.DataArray") -> np.ndarray:
    """Return the names with each changed by `change`: for a file (`quote_for_file`) as strings of one fixed length.

    Names read from a file are made strings of Python again.
    """
    changed_names = [change(str(name)) for name in names.values]
    if change is quote_for_file:
        return np.array(changed_names, dtype="U")
    texts = np.empty(len(changed_names), dtype=object)  # a fixed length would drop final zero characters
    texts[:] = changed_names
    return texts
