"""What a run leaves behind: trajectories with their claims, or running statistics of the errors."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from heliograph.fusion.rules import Fusion
from heliograph.model.estimate import Claim, Estimate
from heliograph.numerics.check import DEFINITENESS_TOLERANCE, fail, own_units
from heliograph.numerics.readable import readable
from heliograph.simulation.frames import record_frame, record_of_frame
from heliograph.simulation.labelled import checked_units
from heliograph.simulation.labelled_record import record_dataset, record_from
from heliograph.simulation.network import FUSED, Network
from heliograph.simulation.plots import plot_record
from heliograph.simulation.saved import Saved
from heliograph.simulation.uplinks import SentReports

if TYPE_CHECKING:  # extras
    import pandas as pd
    import xarray as xr
    from matplotlib.axes import Axes

Result = TypeVar("Result")


@readable
@dataclass(frozen=True)
class Uplink:
    """What a fusion's quantizers did to the estimates of `nodes`, by component.

    saturated, whether a component was out of reach, and symbols, how many were sent for it: (run, time, node, n) in a
    record; in statistics their means over the runs, (time, node, n).
    """

    nodes: tuple[str, ...]
    saturated: np.ndarray
    symbols: np.ndarray

    def saturated_share(self) -> dict[str, float]:
        """Share of the samples (runs, steps and components) that were out of reach, by node."""
        return {node: float(self.saturated[..., i, :].mean()) for i, node in enumerate(self.nodes)}

    def symbols_per_value(self) -> float:
        """Mean number of symbols that one component of one estimate took."""
        return float(self.symbols.mean())


@readable
@dataclass(frozen=True)
class Record(Saved):
    """Trajectories of one recording (no run axis) or of Monte Carlo runs (a leading run axis).

    truth (run, time, n) or None; measurements[node] (run, time, received); estimates[node][filter] with mean
    (run, time, n), covariance (run, time, n, n) and the claim; uplinks[name] of each fusion that has quantizers;
    reports[name][node] of each fusion that hears reports.
    time is in numbers, or dates (datetime64, UTC); units by the state's name, and of "time", where they were given.
    smoothed: the same of estimates given later data too, where these were asked for: a record of its own to save.
    """

    time: np.ndarray
    states: tuple[str, ...]
    truth: np.ndarray | None
    measurements: dict[str, np.ndarray]
    estimates: dict[str, dict[str, Estimate]]
    uplinks: dict[str, Uplink] = field(default_factory=dict)
    units: dict[str, str] = field(default_factory=dict)
    smoothed: "Record | None" = None
    reports: dict[str, dict[str, SentReports]] = field(default_factory=dict)

    @property
    def runs(self) -> int | None:
        """Number of Monte Carlo runs; None of one recording."""
        means = [np.asarray(e.mean) for filters in self.estimates.values() for e in filters.values()]
        every = [*means, *self.measurements.values(), *([] if self.truth is None else [self.truth])]
        return len(every[0]) if every and every[0].ndim == 3 else None

    def with_units(self, units: Mapping[str, str]) -> "Record":
        """The same record with units, by the state's name and of "time", for files, tables and figures.

        Raises:
            ValueError: a name that is no state.
        """
        smoothed = None if self.smoothed is None else self.smoothed.with_units(units)
        return replace(self, units=checked_units(units, self.states), smoothed=smoothed)

    def errors(self, node: str, name: str) -> np.ndarray:
        """x - xhat of one filter of one node.

        Raises:
            ValueError: a recording has no truth, or there is no such filter.
        """
        self.check_filter(node, name)
        if self.truth is None:
            raise fail("errors", "a record with the true state", "a recording without it")
        result: np.ndarray = self.truth - np.asarray(self.estimates[node][name].mean)
        return result

    def check_filter(self, node: str, name: str) -> None:
        """Raise ValueError unless the node has a filter of this name."""
        if name not in self.estimates.get(node, {}):
            known = [f"{each}/{of}" for each, filters in self.estimates.items() for of in filters]
            raise fail("node and filter", f"one of {', '.join(known)}", f"{node}/{name}")

    def rmse(self, node: str, name: str) -> dict[str, float]:
        """Root mean square error of each state over runs and steps, in that state's unit.

        Raises:
            ValueError: a recording has no truth, or there is no such filter.
        """
        squares = self.errors(node, name).reshape(-1, len(self.states)) ** 2
        return dict(zip(self.states, np.sqrt(squares.mean(axis=0)).tolist(), strict=True))

    def to_xarray(self) -> "xr.Dataset":
        """Labelled arrays: dimensions run, time, node, filter, state; `Record.from_xarray` has the record again.

        Raises:
            ModuleNotFoundError: without xarray (extra "results").
        """
        return record_dataset(self)

    @classmethod
    def from_xarray(cls, dataset: "xr.Dataset") -> "Record":
        """The record in a dataset that `to_xarray` made, or in a part of one that keeps its dimensions.

        Raises:
            ValueError: no such dataset.
        """
        return record_from(dataset)

    def to_pandas(self) -> "pd.DataFrame":
        """A table: a row for each time (and run), columns (node, filter, quantity, component, other).

        Quantities: truth, measurement, mean, "covariance (CLAIM)" of component and other, saturated, symbols.

        Raises:
            ModuleNotFoundError: without pandas (extra "results").
        """
        return record_frame(self)

    @classmethod
    def from_pandas(cls, frame: "pd.DataFrame") -> "Record":
        """The record in a table that `to_pandas` made; units are not in it.

        Raises:
            ValueError: no such table.
        """
        return record_of_frame(frame)

    def apart(self) -> list[str]:
        """What is saved apart."""
        there = {"smoothed": self.smoothed is not None, "reports": bool(self.reports)}
        return [name for name, is_there in there.items() if is_there]

    def plot(
        self,
        node: str | None = None,
        filters: Sequence[str] | None = None,
        states: Sequence[str] | None = None,
        axes: "Axes | Sequence[Axes] | None" = None,
        run: int = 0,
        sigmas: float = 2.0,
    ) -> "list[Axes]":
        """Draw estimates with bands of +-`sigmas` claimed deviations, and the truth where known: one axes a state.

        `axes` to draw on, as many as states; new ones unless given. Of the first node, all its filters and all states
        unless told; `run` of Monte Carlo runs.

        Raises:
            ValueError: a node, filter, state or run that there is not, another number of axes.
            ModuleNotFoundError: without matplotlib (extra "report").
        """
        return plot_record(self, node, filters, states, axes, run, sigmas)

    def failures(self) -> list[str]:
        """One line for each filter whose estimate became non-finite or whose bound lost positive semidefiniteness.

        The line names the node, the filter, the first step, and in how many runs; nothing is repaired. One line more
        for each uplink that saturated.
        """
        lines = []
        for node, filters in self.estimates.items():
            for name, estimate in filters.items():
                bad = ~is_sound(estimate)
                if np.any(bad):
                    by_time = bad.reshape(-1, bad.shape[-1])
                    step = int(np.argmax(by_time.any(axis=0)))
                    runs = int(by_time.any(axis=1).sum())
                    what = "mean" if estimate.claim == "none" else "covariance"
                    lines.append(f"{node}/{name}: no valid {what} from step {step} in {runs} of {len(by_time)} runs")
        for name, uplink in self.uplinks.items():
            for i, node in enumerate(uplink.nodes):
                saturated = uplink.saturated[..., i, :]
                if np.any(saturated):
                    counted = f"{np.count_nonzero(saturated)} of {saturated.size} samples"
                    lines.append(f"{FUSED}/{name}: the quantizer of node {node} saturated in {counted}")
        return lines


def is_sound(estimate: Estimate) -> np.ndarray:
    """Whether each mean is finite and, where a covariance is claimed, positive semidefinite (to rounding)."""
    finite: np.ndarray = np.isfinite(np.asarray(estimate.mean)).all(axis=-1)
    if estimate.claim == "none":
        return finite
    bound = np.asarray(estimate.covariance)
    finite = finite & np.isfinite(bound).all(axis=(-1, -2))
    safe = np.where(finite[..., None, None], bound, np.eye(bound.shape[-1]))
    unit = own_units(safe)
    correlations = (safe + np.swapaxes(safe, -1, -2)) / (2 * unit[..., :, None] * unit[..., None, :])
    result: np.ndarray = finite & (np.linalg.eigvalsh(correlations)[..., 0] >= -DEFINITENESS_TOLERANCE)
    return result


@readable
class AbstractReducer(eqx.Module, Generic[Result]):
    """What is kept of a block of runs: a carry that is summed over blocks, and a part that is collected.

    A block is {"truth": (run, time, n), "measurements": (run, time, node, received) of each group of nodes,
    "estimates": of each kind an `Estimate` with mean (run, time, filter, node, n), "fused": estimates by name,
    "uplinks"}, as `Network` has groups and kinds. What all runs share, a covariance say, has length 1 along the runs.
    """

    def initial(self, shapes: PyTree) -> PyTree:
        """The carry before the first block; `shapes` are those of a block."""
        raise NotImplementedError

    def reduce(self, carry: PyTree, batch: PyTree, runs: jax.Array, valid: jax.Array) -> tuple[PyTree, PyTree]:
        """Next carry and collected part of a block, inside the compiled scan; runs that are not valid are padding."""
        raise NotImplementedError

    def finish(self, carry: PyTree, collected: PyTree, network: Network) -> Result:
        """Make the result; collected parts are joined along the run axis, without padding."""
        raise NotImplementedError

    def beside(self, result: Result, smoothed: Result, claims: Mapping[str, Mapping[str, Claim]]) -> Result:
        """The result with the one made of smoothed estimates, whose claims these are, beside it.

        Raises:
            ValueError: a reducer that keeps nothing of smoothed estimates.
        """
        raise fail("keep", "Statistics() or Trajectories(), to keep smoothed estimates", type(self).__name__)


class Trajectories(AbstractReducer[Record]):
    """Keep everything; memory grows with the number of runs."""

    def initial(self, shapes: PyTree) -> PyTree:
        """Nothing is summed."""
        return ()

    def reduce(self, carry: PyTree, batch: PyTree, runs: jax.Array, valid: jax.Array) -> tuple[PyTree, PyTree]:
        """Collect the block; each run gets its copy of what they share."""
        return carry, jax.tree.map(lambda leaf: jnp.broadcast_to(leaf, (len(runs), *leaf.shape[1:])), batch)

    def finish(self, carry: PyTree, collected: PyTree, network: Network) -> Record:
        """Make the record; its time is the step, starting at 1."""
        time = np.arange(1, collected["truth"].shape[1] + 1, dtype=np.float64)
        return trajectories_record(network, collected, time)

    def beside(self, result: Record, smoothed: Record, claims: Mapping[str, Mapping[str, Claim]]) -> Record:
        """As `Record.smoothed`, for the last steps if there are fewer."""
        estimates = {
            node: {name: replace(found, claim=claims[node][name]) for name, found in filters.items()}
            for node, filters in smoothed.estimates.items()
        }
        time = result.time[-len(smoothed.time) :]
        return replace(result, smoothed=replace(smoothed, time=time, estimates=estimates))


def trajectories_record(network: Network, batch: PyTree, time: np.ndarray) -> Record:
    """Record from the scan's output; nodes in the network's order."""
    measurements = measurements_of(network, batch["measurements"])
    mean = by_name(network, batch, lambda e: np.asarray(e.mean), -3)
    covariance = by_name(network, batch, lambda e: np.asarray(e.covariance), -4)
    estimates = {
        node: {name: Estimate(mean[node][name], covariance[node][name], claim) for name, claim in claims.items()}
        for node, claims in network.claims().items()
    }
    uplinks, reports = uplinks_of(network, batch["uplinks"]), _reports(network, batch["reports"])
    return Record(time, network.states, batch["truth"], measurements, estimates, uplinks, reports=reports)


def _reports(network: Network, found: dict[str, tuple[np.ndarray, np.ndarray]]) -> dict[str, dict[str, SentReports]]:
    """Reports by fusion and node, without the rows that a node has not, from (..., node, m) and (..., node)."""
    result: dict[str, dict[str, SentReports]] = {}
    for name, (values, delay) in found.items():
        fusion = network.fused[name]
        assert isinstance(fusion, Fusion)  # nothing else hears reports
        nodes, n = network.nodes_with(fusion.filter), len(network.states)
        sizes = [link.received(n) for link in fusion.links(nodes)]
        result[name] = {
            node: SentReports(np.asarray(values)[..., i, : sizes[i]], np.asarray(delay)[..., i])
            for i, node in enumerate(nodes)
        }
    return result


def measurements_of(network: Network, groups: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
    """Measurements by node, in the given order, from those of the groups (..., node, received)."""
    heard = {
        name: np.asarray(z)[..., i, :]
        for names, z in zip(network.groups, groups, strict=True)
        for i, name in enumerate(names)
    }
    return {name: heard[name] for name in network.names}


def by_name(
    network: Network, batch: PyTree, read: Callable[[PyTree], np.ndarray], axis: int
) -> dict[str, dict[str, np.ndarray]]:
    """What `read` gives of each kind's part, by node and filter: split at its axes (filter, node), the first `axis`.

    `batch` holds "estimates" by kind and "fused" by name, which is read without these axes.
    """
    result: dict[str, dict[str, np.ndarray]] = {name: {} for name in network.names}
    for (group, filters), part in zip(network.kinds, batch["estimates"], strict=True):
        values = np.moveaxis(read(part), (axis, axis + 1), (0, 1))
        for name, rows in zip(filters, values, strict=True):
            for node, row in zip(network.groups[group], rows, strict=True):
                result[node][name] = row
    if network.fused:
        result[FUSED] = {name: read(part) for name, part in batch["fused"].items()}
    return result


def uplinks_of(network: Network, found: dict[str, dict[str, np.ndarray]]) -> dict[str, Uplink]:
    """Uplinks by the fusion's name, from arrays whose last axes are (node, n)."""
    result = {}
    for name, fusion in network.fused.items() if found else ():
        if isinstance(fusion, Fusion) and name in found:
            result[name] = Uplink(tuple(network.nodes_with(fusion.filter)), **found[name])
    return result
