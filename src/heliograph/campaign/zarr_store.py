"""Labelled Zarr store of a campaign: created completely before the first run, then filled file by file.

Every chunk of runs has files of its own, each with a checksum, written under another name and then renamed. So a chunk
is done when its files exist and agree with their checksums, whoever wrote them and whatever was interrupted meanwhile,
and the bytes depend on the campaign alone.
"""

import json
import os
import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, TypedDict

import google_crc32c
import numpy as np
import zarr
from zarr.codecs import Crc32cCodec, ZstdCodec

from heliograph.campaign.campaign_file import read_campaign
from heliograph.campaign.definition import Campaign, Chunk
from heliograph.disk.atomic_files import sync, whole_folder
from heliograph.numerics.check import fail
from heliograph.simulation.network import Network

Claims = dict[str, dict[str, str]]


@dataclass(frozen=True)
class AxisLabels:
    """Names along the axes of a campaign's store, and the size of the largest measurement."""

    states: tuple[str, ...]
    nodes: tuple[str, ...]
    filters: tuple[str, ...]
    received: int


class LabelsAsJson(TypedDict):
    """Labels in a form that JSON can represent."""

    states: Sequence[str]
    nodes: Sequence[str]
    filters: Sequence[str]
    received: int


class NetworkDescription(TypedDict):
    """Labels of one network and its claims by node and filter, in a form that JSON can represent."""

    labels: LabelsAsJson
    claims: Claims


def describe_network(network: Network) -> NetworkDescription:
    """Return labels of one network (states, nodes, filters, longest measurement) and claims of its filters.

    A claim says what a filter's covariance is, such as "exact" or "upper".
    """
    claims: Claims = {node: dict(filters) for node, filters in network.claims().items()}
    labels = LabelsAsJson(
        states=network.states,
        nodes=tuple(claims),
        filters=tuple(dict.fromkeys(name for filters in claims.values() for name in filters)),
        received=max(node.received for node in network.nodes.values()),
    )
    return {"labels": labels, "claims": claims}


def restore_labels(table: LabelsAsJson) -> AxisLabels:
    """Restore labels from the form that `describe_network` returns."""
    return AxisLabels(tuple(table["states"]), tuple(table["nodes"]), tuple(table["filters"]), table["received"])


def unite_labels(by_setting: Mapping[int, AxisLabels]) -> AxisLabels:
    """Return the union of the labels (names of nodes and filters) of all settings, in order of first appearance.

    All settings must have the same states. `received` is the number of components of the longest measurement.
    """
    first_setting, first = next(iter(by_setting.items()))
    for setting, labels in by_setting.items():
        if labels.states != first.states:
            raise fail(f"setting {setting}", f"the states of setting {first_setting}, {first.states}", labels.states)
    return AxisLabels(
        states=first.states,
        nodes=_unite_names([labels.nodes for labels in by_setting.values()]),
        filters=_unite_names([labels.filters for labels in by_setting.values()]),
        received=max(labels.received for labels in by_setting.values()),
    )


def check_labels_within(labels: AxisLabels, known: AxisLabels, setting: int) -> None:
    """Raise ValueError if a setting has names that the store lacks, or a longer measurement.

    `labels` are those of the setting, and `known` those of the store.
    """
    lacking = [name for name in (*labels.nodes, *labels.filters) if name not in (*known.nodes, *known.filters)]
    if labels.states != known.states or labels.received > known.received or lacking:
        raise fail(f"setting {setting}", f"states, nodes and filters of the store, {known}", labels)


def _unite_names(names: Sequence[Sequence[str]]) -> tuple[str, ...]:
    """Return all names, each once, in order of first appearance."""
    return tuple(dict.fromkeys(name for axis in names for name in axis))


STORE = "results.zarr"
ERRORS = {  # variables by name: their axes and what they are
    "error": (("setting", "run", "time", "node", "filter", "state"), "true state less its estimate"),
    "variance": (("setting", "run", "time", "node", "filter", "state"), "claimed variance of the error"),
    "nees_per_dimension": (("setting", "run", "time", "node", "filter"), "e' B^-1 e / n, 1 if the claim is exact"),
}
WORLD = {
    "truth": (("setting", "run", "time", "state"), "true state"),
    "measurement": (("setting", "run", "time", "node", "received"), "what reached the node, NaN beyond its length"),
}
CLAIM, CLAIM_AXES = "claim", ("setting", "node", "filter")


def list_stored_variables(campaign: Campaign) -> dict[str, tuple[tuple[str, ...], str]]:
    """Return the variables that chunks of runs are written to, with their axes and meaning."""
    return ERRORS | (WORLD if campaign.keep == "trajectories" else {})


def create_store(path: Path, campaign: Campaign, labels: AxisLabels) -> None:
    """Create the store of a campaign, complete except for the claims and the chunks of runs.

    Jobs write chunks of runs into it later, each into files of its own.

    Args:
        path: where the store is made; it appears at once when it is complete.
        campaign: the definition, whose text and versions the store records.
        labels: names along the store's axes: states, nodes, filters.
    """
    with whole_folder(path) as folder:
        attributes = {
            "campaign": campaign.text,
            "network_source": campaign.source,
            "versions": campaign.versions,
            "labels": asdict(labels),
            "coordinates": " ".join(campaign.parameters),
        }
        group = zarr.create_group(folder, zarr_format=3, attributes=attributes)
        # Coordinates: parameters along the settings, names along the other axes.
        coordinates = _make_coordinates(campaign, labels)
        for name, values in coordinates.items():
            _write_coordinate(group, name, values, "setting" if name in campaign.parameters else name)
        # Variables, empty so far. A file is one chunk of runs of one setting; the claims of a setting are one file.
        sizes = {name: len(values) for name, values in coordinates.items()}
        for name, (axes, meaning) in list_stored_variables(campaign).items():
            shape = tuple(sizes[axis] for axis in axes)
            chunks = (1, campaign.chunk, *shape[2:])  # the axes are setting, run, and then all others
            _create_array(group, name, axes, shape, chunks, fill=np.nan, attributes={"long_name": meaning})
        shape = tuple(sizes[axis] for axis in CLAIM_AXES)
        meaning = "what the filter claims of its variance"
        _create_array(group, CLAIM, CLAIM_AXES, shape, (1, *shape[1:]), fill="", attributes={"long_name": meaning})
        with warnings.catch_warnings():  # zarr says that consolidated metadata are not in the format's text yet
            warnings.simplefilter("ignore", zarr.errors.ZarrUserWarning)
            zarr.consolidate_metadata(folder)


def _make_coordinates(campaign: Campaign, labels: AxisLabels) -> dict[str, np.ndarray]:
    """Return the store's coordinates by name: one for each axis, and each parameter along the settings."""
    steps = {
        "setting": np.arange(len(campaign.settings)),
        "run": np.arange(campaign.runs),
        "time": np.arange(1, campaign.horizon + 1),
    }
    names = {"node": labels.nodes, "filter": labels.filters, "state": labels.states}
    received = {"received": np.arange(labels.received)} if campaign.keep == "trajectories" else {}
    parameters = {name: list_parameter_values(campaign, name) for name in campaign.parameters}
    return steps | {name: np.array(value) for name, value in names.items()} | received | parameters


def list_parameter_values(campaign: Campaign, name: str) -> np.ndarray:
    """Return a parameter's value in each setting, as numbers or booleans if all values are such, else as texts.

    A setting without the parameter has NaN among numbers, and "" among texts.
    """
    values = [setting.get(name) for setting in campaign.settings]
    if all(isinstance(value, bool) for value in values):
        return np.array(values)
    if any(isinstance(value, bool) or not isinstance(value, int | float | None) for value in values):
        return np.array([_write_as_text(value) for value in values])
    are_whole = all(isinstance(value, int) for value in values)
    return np.array(values, dtype=np.int64 if are_whole else np.float64)


def _write_as_text(value: object) -> str:
    """Return a text as it is, None as "", and anything else as JSON."""
    if value is None or isinstance(value, str):
        return value or ""
    return json.dumps(value, sort_keys=True, ensure_ascii=False)


def _write_coordinate(group: zarr.Group, name: str, values: np.ndarray, axis: str) -> None:
    """Create a coordinate (labels along an axis) in one chunk of the store, and write its values."""
    fill = "" if values.dtype.kind == "U" else values.dtype.type(0)
    shape = values.shape
    _create_array(group, name, (axis,), shape=shape, chunks=shape, fill=fill, attributes={}, kind=values.dtype)
    _open_array(group, name)[...] = values


def _create_array(
    group: zarr.Group,
    name: str,
    axes: tuple[str, ...],
    shape: tuple[int, ...],
    chunks: tuple[int, ...],
    fill: str | float | np.generic,
    attributes: Mapping[str, str],
    kind: np.dtype | type = np.float64,
) -> None:
    """Create one array of the store, with its chunks, its fill value and a checksum for each chunk.

    Args:
        group: the store.
        name: name of the array.
        axes: names of its axes.
        shape: lengths of its axes.
        chunks: lengths of a chunk along the axes; a chunk is one file.
        fill: value of entries that were never written; a text makes an array of texts.
        attributes: metadata of the array, such as its unit.
        kind: type of the numbers.
    """
    is_text = isinstance(fill, str)
    group.create_array(
        name,
        shape=shape,
        chunks=chunks,
        dtype=str if is_text else kind,
        fill_value=fill,
        compressors=(Crc32cCodec(),) if is_text else (ZstdCodec(level=1), Crc32cCodec()),
        dimension_names=axes,
        attributes=dict(attributes),
        chunk_key_encoding={"name": "default", "separator": "."},  # one flat folder for each variable
    )


def _open_array(group: zarr.Group, name: str) -> zarr.Array[Any]:
    """Return an array of the store that writes a chunk's file even if the chunk has only fill values.

    The existence of the file marks the chunk as done.
    """
    array = group[name]
    assert isinstance(array, zarr.Array)
    return array.with_config({"write_empty_chunks": True})


def write_chunk(path: Path, chunk: Chunk, values: Mapping[str, np.ndarray]) -> None:
    """Write the values (run, ...) of one chunk of runs, one file for each variable."""
    group = zarr.open_group(path, mode="r+")
    for name, block in values.items():
        _open_array(group, name)[chunk.setting : chunk.setting + 1, chunk.start : chunk.stop] = block[None]
        _sync_files(path / name, f"c.{chunk.setting}.{chunk.number}.")


def write_claims(path: Path, setting: int, claims: Claims) -> None:
    """Write what each filter claims of its covariance ("exact", "upper", ...) in one setting; "" for no filter."""
    labels = read_labels(path)
    table = [[claims.get(node, {}).get(name, "") for name in labels.filters] for node in labels.nodes]
    _open_array(zarr.open_group(path, mode="r+"), CLAIM)[setting : setting + 1] = np.array([table], dtype=object)
    _sync_files(path / CLAIM, f"c.{setting}.")


def _sync_files(folder: Path, start: str) -> None:
    """Flush files whose names begin with `start`, and their folder, to the disk, to outlast a loss of power."""
    for file in folder.glob(f"{start}*"):
        sync(file)
    sync(folder)


def find_done_chunks(path: Path, campaign: Campaign) -> set[tuple[int, ...]]:
    """Return {(setting, chunk)} of the chunks of a campaign whose files all exist in the store."""
    return set.intersection(*(set(_find_chunk_files(path / name, 2)) for name in list_stored_variables(campaign)))


def find_described_settings(path: Path) -> set[tuple[int, ...]]:
    """Return {(setting,)} of the settings whose claims are written in the store."""
    return set(_find_chunk_files(path / CLAIM, 1))


def remove_damaged_chunks(path: Path, campaign: Campaign) -> list[Path]:
    """Remove the files of chunks that do not match their checksums; return their paths."""
    files: list[Path] = []
    for name in list_stored_variables(campaign):
        files += _find_chunk_files(path / name, indices=2).values()
    files += _find_chunk_files(path / CLAIM, indices=1).values()
    damaged = [file for file in files if not _has_right_checksum(file)]
    for file in damaged:
        file.unlink()
    return damaged


def _has_right_checksum(file: Path) -> bool:
    """Return whether the last four bytes of a file are the checksum (CRC-32C) of all others."""
    data = file.read_bytes()
    return len(data) > 4 and google_crc32c.value(data[:-4]) == int.from_bytes(data[-4:], "little")


def _find_chunk_files(folder: Path, indices: int) -> dict[tuple[int, ...], Path]:
    """Return {first indices of a chunk: its file}, with as many indices as `indices` says.

    A chunk's file has a name such as "c.0.3.0". Its first two indices are (0, 3).
    """
    found = {}
    for name in os.listdir(folder):
        start, *parts = name.split(".")
        if start == "c" and parts and all(map(str.isdigit, parts)):  # no partial file
            found[tuple(map(int, parts[:indices]))] = folder / name
    return found


def remove_partial_files(path: Path) -> None:
    """Remove the partial files of a process that was killed."""
    # The name of a whole chunk's file is "c" and numbers. A file with more after them was not finished.
    for folder in path.iterdir():
        for file in folder.iterdir() if folder.is_dir() else ():
            if file.name.startswith("c.") and not all(map(str.isdigit, file.name.split(".")[1:])):
                file.unlink(missing_ok=True)


def read_labels(path: Path) -> AxisLabels:
    """Return the labels that the store was created with."""
    stored: Any = zarr.open_group(path, mode="r").attrs["labels"]
    return restore_labels(stored)


def restore_campaign(path: Path) -> Campaign:
    """Return the campaign with which the store was created, as if its file were next to the store."""
    attributes: Any = _read_attributes(path)
    stored = read_campaign(attributes["campaign"], attributes["network_source"], path.parent / "campaign.toml")
    return replace(stored, versions=attributes["versions"])


def check_same_campaign(path: Path, campaign: Campaign) -> None:
    """Raise ValueError, naming the difference, unless the store was created with this campaign."""
    attributes: Any = _read_attributes(path)
    stored_versions = dict(attributes["versions"])
    differences = [
        f"{name} {version or 'none'} (was {stored_versions.get(name) or 'none'})"
        for name, version in campaign.versions.items()
        if version != stored_versions.get(name)
    ]
    if not differences:
        stored = read_campaign(attributes["campaign"], attributes["network_source"], Path(campaign.path))
        differences = list(_list_differences(stored, campaign))
    if differences:
        expected = "the campaign it was begun with, or another folder"
        raise fail(f"results folder {path.parent}", expected, "; ".join(differences))


def _read_attributes(path: Path) -> Mapping[str, object]:
    """Return the attributes of a store, or raise one line if they are damaged."""
    try:
        attributes = zarr.open_group(path, mode="r").attrs.asdict()
        if not {"versions", "campaign", "network_source", "labels"} <= attributes.keys():
            raise ValueError("not all that it had")
    except (OSError, ValueError, KeyError, TypeError) as error:
        expected = "a store that can be read, or another folder"
        raise fail(f"{path / 'zarr.json'}", expected, f"a damaged one ({type(error).__name__})") from None
    return attributes


def _list_differences(stored: Campaign, campaign: Campaign) -> Iterable[str]:
    """Yield in words each difference of a campaign from the store's campaign; only the first one of the settings."""
    for name in ("network", "horizon", "runs", "seed", "chunk", "keep", "inputs"):
        new, old = getattr(campaign, name), getattr(stored, name)
        if new != old:
            yield f"{name} {new!r} (was {old!r})"
    if campaign.source != stored.source:
        yield f"another source of {campaign.network.rpartition(':')[0]}"
    if campaign.settings != stored.settings:
        for i, (new_setting, old_setting) in enumerate(zip(campaign.settings, stored.settings, strict=False)):
            if new_setting != old_setting:
                yield f"setting {i} {new_setting} (was {old_setting})"
                return
        yield f"{len(campaign.settings)} settings (was {len(stored.settings)})"
