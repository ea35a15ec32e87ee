"""Datasets with labelled axes: the common parts of those of records and of statistics."""

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple, TypeVar, cast

import numpy as np

import heliograph
from heliograph.disk.quoted_text import visible
from heliograph.model.estimate import Claim, Estimate
from heliograph.numerics.check import fail, instance, table
from heliograph.numerics.types import ArrayLike
from heliograph.simulation.centres.uplinks import Uplink

if TYPE_CHECKING:
    import xarray as xr

SENT = ("saturated", "symbols")  # fields of an Uplink


def count_modes(estimates: Mapping[str, Mapping[str, Estimate]]) -> int:
    """Return the largest number of modes that a filter weighs; 0 where none weighs any."""
    return max((read_modes(e).shape[-1] for filters in estimates.values() for e in filters.values()), default=0)


def read_modes(estimate: Estimate) -> np.ndarray:
    """Return the modes' probabilities (..., M) of an estimate; M = 0 of a filter that weighs none."""
    mean = np.asarray(estimate.mean)
    return np.zeros((*mean.shape[:-1], 0)) if estimate.modes is None else np.asarray(estimate.modes)


def drop_unused_modes(modes: np.ndarray | None) -> np.ndarray | None:
    """Return the probabilities of modes (..., M) without modes that are always NaN, or None if no mode is left.

    A dataset has equally many modes for all filters, NaN for modes that a filter does not have.
    """
    if modes is None:
        return None
    is_used = ~np.isnan(modes).all(axis=tuple(range(modes.ndim - 1)))
    return modes[..., is_used] if is_used.any() else None


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


def list_axes(name: str, lead: Sequence[str]) -> list[str]:
    """Return the axes of a field in FIELDS, with `lead`, the axes of rows (run, time) or (time), in place of "..."."""
    return [axis for part in FIELDS[name].axes.split() for axis in (lead if part == "..." else [part])]


def select_given_units(units: Mapping[str, str], states: Sequence[str]) -> dict[str, str]:
    """Return the units that are not empty, by the state's name or "time".

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
    """Labels of results by node and filter, by which the fields of a dataset (FIELDS) are filled.

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
        """Names of all filters, each once: the labels of the axis of filters."""
        names = [name for by_filter in self.by_node.values() for name in by_filter]
        return list(dict.fromkeys(names))

    @property
    def senders(self) -> list[str]:
        """Names of all nodes that send through a quantizer, each once: the labels of the axis of senders."""
        names = [node for uplink in self.uplinks.values() for node in uplink.nodes]
        return list(dict.fromkeys(names))

    def list_placed(self, read: Callable[[Any], T]) -> list[Placed[T]]:
        """Return (place, read(result)) for each result by node and filter.

        A place is (number of the node, number of the filter's name): the indices of the result along the axes node and
        filter of a dataset.
        """
        filters = self.filters
        placed: list[Placed[T]] = []
        for node, by_filter in self.by_node.items():
            for name, result in by_filter.items():
                placed.append(((self.nodes.index(node), filters.index(name)), read(result)))
        return placed

    def fill_field(self, name: str, placed_values: Iterable[Placed[ArrayLike]]) -> np.ndarray:
        """Return the array of a field with values at their places (node, or node and filter) and NaN elsewhere.

        Values shorter than their axis, such as measurements of some nodes, fill its beginning. `self.rows` and
        `self.lengths`: the lengths of the axes of rows, and of further axes, by name.
        """
        sizes = {"node": len(self.nodes), "filter": len(self.filters), "state": len(self.states)}
        sizes |= {"other": len(self.states), **self.rows, **self.lengths}
        axes = list_axes(name, list(self.rows))
        array, node_axis = np.full([sizes[axis] for axis in axes], np.nan), axes.index("node")
        for place, values in placed_values:
            # Axes of rows come before the node's axis, and the values' own axes after their place.
            lengths = np.shape(values)[node_axis:]
            all_rows = (slice(None),) * node_axis
            index: Any = (*all_rows, *place, *map(slice, lengths))
            array[index] = values
        return array

    def fill_from_results(self, name: str, read: Callable[[Any], ArrayLike]) -> np.ndarray:
        """Return the array of a field with what `read` gives of each result at its place; NaN elsewhere."""
        return self.fill_field(name, self.list_placed(read))

    def claims(self) -> np.ndarray:
        """Return the claim of each filter's covariance (node, filter): exact, upper, nominal or none.

        The text is empty if a node has no filter of this name.
        """
        claims = np.full((len(self.nodes), len(self.filters)), "", dtype="U7")
        for place, claim in self.list_placed(lambda result: result.claim):
            claims[place] = claim
        return claims

    def make_attitude_field(self) -> dict[str, np.ndarray]:
        """Return the field that says which states are rotation vectors of attitudes; no field if none are.

        It has for each state its place among the numbers of all rotation vectors, or -1 for other states.
        """
        # States that are rotation vectors: of the first filter that has any, since all that have some have the same.
        placed = self.list_placed(lambda result: result.attitude)
        rotations = next((states for _, states in placed if states), ())
        order = np.full(len(self.states), -1, dtype=np.int64)
        order[list(rotations)] = np.arange(len(rotations))
        return {"attitude": order} if rotations else {}

    def make_quantizer_fields(self) -> dict[str, np.ndarray]:
        """Return what quantizers sent as arrays (..., fusion, sender, state) by field; {} without quantizers.

        `self.uplinks` holds for each fusion the fields SENT with the axes (..., node, state), of the nodes that it
        fuses. Integers and booleans stay what they are. "place" (fusion, sender) is the number of the sender among the
        fusion's nodes, -1 where it is none of them.
        """
        if not self.uplinks:
            return {}
        # Arrays of zeros, of the types that the first fusion has.
        senders, n, first = self.senders, len(self.states), next(iter(self.uplinks.values()))
        places = np.full((len(self.uplinks), len(senders)), -1, dtype=np.int64)
        values_by_field = {}
        for field in SENT:
            example = getattr(first, field)
            values_by_field[field] = np.zeros((*example.shape[: len(self.rows)], *places.shape, n), example.dtype)
        for i, uplink in enumerate(self.uplinks.values()):
            for j, node in enumerate(uplink.nodes):
                sender = senders.index(node)
                places[i, sender] = j
                for field, values in values_by_field.items():
                    values[..., i, sender, :] = getattr(uplink, field)[..., j, :]
        return {"place": places, **values_by_field}

    def make_dataset(
        self, title: str, fields: Mapping[str, np.ndarray], time: np.ndarray, units: Mapping[str, str]
    ) -> "xr.Dataset":
        """Return a dataset of fields, with names, times and units as coordinates.

        Args:
            title: a title, by which the dataset is known again.
            fields: arrays by name of the field, such as "mean"; FIELDS names their axes and says what they are.
            time: times of the rows, numbers or dates.
            units: units by the state's name, and the unit of "time".
        """
        import xarray as xr

        # Fields, with their axes and their meaning in words.
        lead = list(self.rows)
        data = {name: (list_axes(name, lead), values, {"long_name": FIELDS[name].meaning})
                for name, values in fields.items()}  # fmt: skip
        # Coordinates: names, time, units.
        labels = {"node": self.nodes, "filter": self.filters, "state": self.states, "other": self.states}
        labels |= {"fusion": list(self.uplinks), "sender": self.senders} if self.uplinks else {}
        coordinates: dict[str, object] = {axis: ([axis], make_name_array(names)) for axis, names in labels.items()}
        has_unit = TIME in units and time.dtype.kind == "f"  # dates have none
        coordinates[TIME] = ([TIME], time, {"units": units[TIME]} if has_unit else {})
        if any(state in units for state in self.states):
            coordinates["unit"] = (["state"], make_name_array([units.get(state, "") for state in self.states]))
        # Attributes for people; the claims are a variable too.
        claims = [
            f"{node}/{name}: {result.claim}"
            for node, by_filter in self.by_node.items()
            for name, result in by_filter.items()
        ]
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
    """Yield (node, filter, claim, values) for each filter in a dataset.

    `names`: the fields to read. `values`: {field: copy of its values of this filter}, without the axes node and filter.
    `lead`: the axes of rows, such as run and time.
    """
    nodes, filters = read_labels(dataset, "node"), read_labels(dataset, "filter")
    claim = read_values(dataset, "claim", lead)
    fields = {name: read_values(dataset, name, lead) for name in names}
    node_axes = {name: list_axes(name, lead).index("node") for name in names}
    for i, j in zip(*np.nonzero(claim != ""), strict=True):  # "": node i has no filter j
        values = {}
        for name, field in fields.items():
            all_rows = (slice(None),) * node_axes[name]  # the axes of rows stand before that of nodes
            values[name] = field[(*all_rows, i, j)].copy()
        yield nodes[i], filters[j], cast(Claim, str(claim[i, j])), values


def read_estimate(dataset: "xr.Dataset", claim: Claim, values: Mapping[str, np.ndarray]) -> Estimate:
    """Return the estimate of a filter of a dataset, from its {field: values} as `iterate_filters` yields them.

    `claim`: what its covariance is said to be, such as "exact".
    """
    # For each state, its place among the numbers of all rotation vectors of attitudes, or -1 for other states.
    order = read_values(dataset, "attitude", []) if "attitude" in dataset else np.zeros(0, dtype=np.int64)
    attitude = tuple(int(i) for i in np.argsort(order, kind="stable") if order[i] >= 0)
    modes = drop_unused_modes(values.get("modes"))
    return Estimate(values["mean"], values["covariance"], claim, modes, attitude=attitude)


def read_uplinks(dataset: "xr.Dataset", lead: Sequence[str]) -> "dict[str, Uplink]":
    """Return what nodes sent to fusions (uplinks) in a dataset, by the fusion's name.

    `lead`: names of the axes of rows, such as run and time. SENT names the fields of an uplink: whether a quantizer
    saturated, and how many symbols it sent. "place" (fusion, sender) is the number of the sender among the fusion's
    nodes, -1 where it is none of them.
    """
    if "place" not in dataset:
        return {}
    senders, places = read_labels(dataset, "sender"), read_values(dataset, "place", lead)
    saturated, symbols = (read_values(dataset, name, lead) for name in SENT)
    uplinks = {}
    for i, name in enumerate(read_labels(dataset, "fusion")):
        # The fusion's nodes, in their order.
        order = np.array([j for j in np.argsort(places[i], kind="stable") if places[i, j] >= 0], dtype=int)
        nodes = tuple(senders[j] for j in order)
        uplinks[name] = Uplink(nodes, saturated[..., i, order, :], symbols[..., i, order, :])
    return uplinks


def make_name_array(names: Sequence[str]) -> np.ndarray:
    """Return the names as an array of Python strings, since an array of fixed-length strings drops final zero bytes."""
    texts = np.empty(len(names), dtype=object)
    texts[:] = names
    return texts


def check_title(dataset: "xr.Dataset", title: str) -> None:
    """Raise ValueError unless the dataset has this title."""
    title_found = getattr(dataset, "attrs", {}).get("title", type(dataset).__name__)
    if title_found != title:
        raise fail("dataset", f"one whose title is {title!r}", repr(title_found))


def read_labels(dataset: "xr.Dataset", axis: str) -> list[str]:
    """Return the labels of a dimension of a dataset, such as names of nodes; raise ValueError if it is missing."""
    if axis not in dataset.dims:
        raise fail("dataset", f"the dimension {axis!r}, also where it has one label", f"{list(dataset.dims)}")
    return [str(name) for name in dataset[axis].values]


def read_values(dataset: "xr.Dataset", name: str, lead: Sequence[str]) -> np.ndarray:
    """Return the values of a field with its axes in the order of `list_axes`; raise ValueError if it has other axes.

    `lead`: the axes of rows, such as run and time, which stand first. Both axes of a covariance have the states of the
    dataset, in their order.
    """
    axes = list_axes(name, lead)
    if name not in dataset or set(dataset[name].dims) != set(axes):
        found = list(dataset[name].dims) if name in dataset else "no such variable"
        raise fail(f"dataset, variable {name!r}", f"the dimensions {axes}", found)
    values = np.asarray(dataset[name].transpose(*axes).values)
    if "other" not in axes:
        return values
    states, others = read_labels(dataset, "state"), read_labels(dataset, "other")
    if not set(states) <= set(others):
        raise fail("dataset, dimension 'other'", f"the states, {', '.join(states)}", ", ".join(others))
    return np.take(values, [others.index(state) for state in states], axis=axes.index("other"))


def read_units(dataset: "xr.Dataset") -> dict[str, str]:
    """Return the units in a dataset, by the state's name or "time"."""
    time = {TIME: str(dataset[TIME].attrs["units"])} if "units" in dataset[TIME].attrs else {}
    if "unit" not in dataset.coords:
        return time
    items = zip(read_labels(dataset, "state"), dataset["unit"].values, strict=True)
    return {state: str(unit) for state, unit in items if unit} | time
