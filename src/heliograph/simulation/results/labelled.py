"""Datasets with labelled axes: the common parts of those of records and of statistics."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, cast

import numpy as np

import heliograph
from heliograph.disk.quoting import visible
from heliograph.model.estimate import Claim, Estimate
from heliograph.numerics.check import fail, instance, table
from heliograph.numerics.types import ArrayLike
from heliograph.simulation.centres.uplinks import Uplink

if TYPE_CHECKING:
    import xarray as xr

SENT = ("saturated", "symbols")  # fields of an Uplink


def modes_of(estimates: Mapping[str, Mapping[str, Estimate]]) -> int:
    """Return the largest number of modes that a filter weighs; 0 where none weighs any."""
    return max((read_modes(e).shape[-1] for filters in estimates.values() for e in filters.values()), default=0)


def read_modes(estimate: Estimate) -> np.ndarray:
    """Return the modes' probabilities (..., M) of an estimate; none of a filter that weighs none."""
    mean = np.asarray(estimate.mean)
    return np.zeros((*mean.shape[:-1], 0)) if estimate.modes is None else np.asarray(estimate.modes)


def without_padding(modes: np.ndarray | None) -> np.ndarray | None:
    """Return the modes' probabilities without those that are NaN at all times; None where nothing is left."""
    if modes is None:
        return None
    used = ~np.isnan(modes).all(axis=tuple(range(modes.ndim - 1)))
    return modes[..., used] if used.any() else None


TIME = "time"
T = TypeVar("T")
Shape = tuple[int, ...]
Placed = tuple[Shape, T]  # where a value belongs, and the value


class VariableDescription(NamedTuple):
    """A variable of a dataset: its axes, of which "..." are those of rows (run, time), and what it means."""

    axes: str
    meaning: str


# Everything that datasets of records, and of statistics, hold.
_FIELDS = {
    "truth": ("... state", "true state"),
    "measurement": ("... node received", "what reached the node, NaN where nothing arrived and beyond its length"),
    "length": ("node", "how many numbers the node receives; -1: it is no place that receives"),
    "mean": ("... node filter state", "estimate of the state"),
    "covariance": ("... node filter state other", "covariance of the error as the filter claims it"),
    "modes": ("... node filter mode", "probability of each mode, NaN of a filter that weighs fewer or none"),
    "attitude": ("state", "place among the numbers of attitudes, three of each rotation vector; -1 if it is none"),
    "claim": (
        "node filter",
        "what the claimed covariance is: exact, upper, nominal or none; empty where there is no such filter",
    ),
    "estimated": ("node", "whether estimates are kept for the node"),
    "saturated": (
        "... fusion sender state",
        "whether a component was out of the quantizer's reach; in statistics, in which share of the runs",
    ),
    "symbols": (
        "... fusion sender state",
        "how many symbols were sent for a component; in statistics their mean over the runs",
    ),
    "place": ("fusion sender", "place of the sender among those of the fusion; -1: it sends nothing to it"),
    "runs": ("batch", "number of runs in the batch"),
    "errors": ("batch ... node filter state other", "sum over the batch's runs of e_i e_j, e = truth - mean"),
    "claimed": ("batch ... node filter state other", "mean over the batch's runs of the claimed covariance"),
    "nees": ("batch ... node filter", "sum over the batch's runs of e' B^-1 e"),
    "failed": ("... node filter", "runs without a valid estimate at this step"),
    "failed_runs": ("node filter", "runs without a valid estimate at some step"),
    "rmse": ("... node filter state", "root mean square error"),
    "deviation": ("... node filter state", "root of the mean claimed variance"),
    "nees_per_dimension": ("... node filter", "mean of e' B^-1 e / n, 1 if the claim is exact"),
}
FIELDS = {name: VariableDescription(*parts) for name, parts in _FIELDS.items()}


def axes_of(name: str, lead: Sequence[str]) -> list[str]:
    """Return the axes of a field, with those of rows (`lead`) where it has them."""
    return [axis for part in FIELDS[name].axes.split() for axis in (lead if part == "..." else [part])]


def check_units(units: Mapping[str, str], states: Sequence[str]) -> dict[str, str]:
    """Check units by the state's name, and of `time`; empty ones are left out.

    Raises:
        ValueError: a name that is no state, a unit that is no text.
    """
    by_name = table("units", units, "texts")
    for name, unit in by_name.items():
        if name not in (*states, TIME):
            raise fail("units", f"names of states {list(states)}, or {TIME!r}", repr(name))
        instance(f"unit of {name!r}", unit, str, "a text")
    return {name: unit for name, unit in by_name.items() if unit}


@dataclass(frozen=True)
class FilterLabels:
    """Labels of results by node and filter, which fill the fields of a dataset at their places.

    Args:
        nodes: names of all nodes.
        by_node: results by node and filter, each with a claim.
        states: names of the plant's states.
        rows: lengths of the axes of rows, (run, time) or (time), by name.
        lengths: of other axes by name.
        uplinks: quantizers by fusion.
    """

    nodes: Sequence[str]
    by_node: Mapping[str, Mapping[str, Any]]
    states: Sequence[str]
    rows: Mapping[str, int]
    lengths: Mapping[str, int]
    uplinks: Mapping[str, Uplink]

    @property
    def filters(self) -> list[str]:
        """Names of all filters."""
        return list(dict.fromkeys(name for by_filter in self.by_node.values() for name in by_filter))

    @property
    def senders(self) -> list[str]:
        """Names of all nodes that send through a quantizer."""
        return list(dict.fromkeys(node for uplink in self.uplinks.values() for node in uplink.nodes))

    def place(self, value: Callable[[Any], T]) -> list[Placed[T]]:
        """Return a value of each result, with its place (node, filter)."""
        filters = self.filters
        return [((self.nodes.index(node), filters.index(name)), value(result))
                for node, by_filter in self.by_node.items() for name, result in by_filter.items()]  # fmt: skip

    def fill(self, name: str, parts: Iterable[Placed[ArrayLike]]) -> np.ndarray:
        """Return the array of a field with these parts at their places along node, or node and filter; NaN elsewhere.

        A part that is shorter than its axis, as measurements of a node may be, fills the beginning.
        """
        sizes = {"node": len(self.nodes), "filter": len(self.filters), "state": len(self.states)}
        sizes |= {"other": len(self.states), **self.rows, **self.lengths}
        axes = axes_of(name, list(self.rows))
        array, node_axis = np.full([sizes[axis] for axis in axes], np.nan), axes.index("node")
        for place, part in parts:
            lengths = np.shape(part)[node_axis:]
            index: Any = (*(slice(None),) * node_axis, *place, *map(slice, lengths))
            array[index] = part
        return array

    def of_filters(self, name: str, value: Callable[[Any], ArrayLike]) -> np.ndarray:
        """Return the array of a field with a value of each result at its place."""
        return self.fill(name, self.place(value))

    def claims(self) -> np.ndarray:
        """Return what each filter claims of its covariance (node, filter): exact, upper, nominal or none.

        Empty where a node has no filter of the name.
        """
        claims = np.full((len(self.nodes), len(self.filters)), "", dtype="U7")
        for position, claim in self.place(lambda result: result.claim):
            claims[position] = claim
        return claims

    def attitudes(self) -> dict[str, np.ndarray]:
        """Return which states are the rotation vectors of attitudes; nothing where none are."""
        places = next((places for _, places in self.place(lambda result: result.attitude) if places), ())
        order = np.full(len(self.states), -1, dtype=np.int64)
        order[list(places)] = np.arange(len(places))
        return {"attitude": order} if places else {}

    def sent(self) -> dict[str, np.ndarray]:
        """Return the fields of the quantizers, by fusion and sender, with integers and booleans as they are."""
        if not self.uplinks:
            return {}
        # Places of the senders in each fusion, -1 for none.
        senders, n, first = self.senders, len(self.states), next(iter(self.uplinks.values()))
        positions = np.full((len(self.uplinks), len(senders)), -1, dtype=np.int64)
        like = {name: getattr(first, name) for name in SENT}
        parts = {name: np.zeros((*v.shape[: len(self.rows)], *positions.shape, n), v.dtype) for name, v in like.items()}
        # Values by fusion and sender.
        for i, uplink in enumerate(self.uplinks.values()):
            for j, node in enumerate(uplink.nodes):
                positions[i, senders.index(node)] = j
                for name, values in parts.items():
                    values[..., i, senders.index(node), :] = getattr(uplink, name)[..., j, :]
        return {"place": positions, **parts}

    def dataset(
        self, title: str, fields: Mapping[str, np.ndarray], time: np.ndarray, units: Mapping[str, str]
    ) -> "xr.Dataset":
        """Return a dataset with a title, these fields, and names, times and units as coordinates."""
        import xarray as xr

        lead = list(self.rows)  # fields, with their meaning in words
        data = {name: (axes_of(name, lead), values, {"long_name": FIELDS[name].meaning})
                for name, values in fields.items()}  # fmt: skip
        # Coordinates: names, time, units.
        labels = {"node": self.nodes, "filter": self.filters, "state": self.states, "other": self.states}
        labels |= {"fusion": list(self.uplinks), "sender": self.senders} if self.uplinks else {}
        coordinates: dict[str, object] = {axis: ([axis], text(names)) for axis, names in labels.items()}
        coordinates[TIME] = ([TIME], time, {"units": units[TIME]} if TIME in units and time.dtype.kind == "f" else {})
        if any(state in units for state in self.states):
            coordinates["unit"] = (["state"], text([units.get(state, "") for state in self.states]))
        # Attributes for people; the claims are a variable too.
        claims = [f"{node}/{name}: {result.claim}" for node, r in self.by_node.items() for name, result in r.items()]
        attributes = {
            "title": title,
            "heliograph": heliograph.__version__,
            "states": visible(", ".join(self.states)),
            "claims": visible(", ".join(claims)),
        }
        return xr.Dataset(data, coordinates, attributes)


def iterate_filters(
    dataset: "xr.Dataset", names: Sequence[str], lead: Sequence[str]
) -> Iterator[tuple[str, str, Claim, dict[str, np.ndarray]]]:
    """Yield node, filter, claim, and copies of these fields without their axes (node, filter), of each filter there."""
    nodes, filters, claim = names_of(dataset, "node"), names_of(dataset, "filter"), read_values(dataset, "claim", lead)
    fields = {name: read_values(dataset, name, lead) for name in names}
    places = {name: axes_of(name, lead).index("node") for name in names}
    for i, j in zip(*np.nonzero(claim != ""), strict=True):
        values = {name: field[(*(slice(None),) * places[name], i, j)].copy() for name, field in fields.items()}
        yield nodes[i], filters[j], cast(Claim, str(claim[i, j])), values


def read_estimate(dataset: "xr.Dataset", claim: Claim, values: Mapping[str, np.ndarray]) -> Estimate:
    """Return the estimate of a filter of a dataset, from its values by field."""
    order = read_values(dataset, "attitude", []) if "attitude" in dataset else np.zeros(0, dtype=np.int64)
    attitude = tuple(int(i) for i in np.argsort(order, kind="stable") if order[i] >= 0)
    modes = without_padding(values.get("modes"))
    return Estimate(values["mean"], values["covariance"], claim, modes, attitude=attitude)


def read_uplinks(dataset: "xr.Dataset", lead: Sequence[str]) -> "dict[str, Uplink]":
    """Return the uplinks of a dataset, by the fusion's name."""
    if "place" not in dataset:
        return {}
    senders, positions = names_of(dataset, "sender"), read_values(dataset, "place", lead)
    saturated, symbols = (read_values(dataset, name, lead) for name in SENT)
    uplinks = {}
    for i, name in enumerate(names_of(dataset, "fusion")):
        order = np.array([j for j in np.argsort(positions[i], kind="stable") if positions[i, j] >= 0], dtype=int)
        nodes = tuple(senders[j] for j in order)
        uplinks[name] = Uplink(nodes, saturated[..., i, order, :], symbols[..., i, order, :])
    return uplinks


def text(names: Sequence[str]) -> np.ndarray:
    """Return the names as an array of objects, whatever characters they have."""
    texts = np.empty(len(names), dtype=object)
    texts[:] = names
    return texts


def check_title(dataset: "xr.Dataset", title: str) -> None:
    """Raise ValueError unless the dataset has this title."""
    came = getattr(dataset, "attrs", {}).get("title", type(dataset).__name__)
    if came != title:
        raise fail("dataset", f"one whose title is {title!r}", repr(came))


def names_of(dataset: "xr.Dataset", axis: str) -> list[str]:
    """Return the labels of a dimension."""
    if axis not in dataset.dims:
        raise fail("dataset", f"the dimension {axis!r}, also where it has one label", f"{list(dataset.dims)}")
    return [str(name) for name in dataset[axis].values]


def read_values(dataset: "xr.Dataset", name: str, lead: Sequence[str]) -> np.ndarray:
    """Return the values of a field with its axes in their order."""
    axes = axes_of(name, lead)
    if name not in dataset or set(dataset[name].dims) != set(axes):
        came = list(dataset[name].dims) if name in dataset else "no such variable"
        raise fail(f"dataset, variable {name!r}", f"the dimensions {axes}", came)
    return np.asarray(dataset[name].transpose(*axes).values)


def read_units(dataset: "xr.Dataset") -> dict[str, str]:
    """Return the units of the states and of time in a dataset."""
    time = {TIME: str(dataset[TIME].attrs["units"])} if "units" in dataset[TIME].attrs else {}
    if "unit" not in dataset.coords:
        return time
    items = zip(names_of(dataset, "state"), dataset["unit"].values, strict=True)
    return {state: str(unit) for state, unit in items if unit} | time
