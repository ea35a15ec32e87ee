"""What a run leaves behind: trajectories with their claims, or running statistics of the errors."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from heliograph.fusion.rules import Fusion
from heliograph.model.estimate import Estimate
from heliograph.numerics.check import DEFINITENESS_TOLERANCE, fail, own_units
from heliograph.simulation.network import FUSED, Network
from heliograph.simulation.uplinks import SentReports

Result = TypeVar("Result")


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


@dataclass(frozen=True)
class Record:
    """Trajectories of one recording (no run axis) or of Monte Carlo runs (a leading run axis).

    truth (run, time, n) or None; measurements[node] (run, time, received); estimates[node][filter] with mean
    (run, time, n), covariance (run, time, n, n) and the claim; uplinks[name] of each fusion that has quantizers;
    reports[name][node] of each fusion that hears reports.
    """

    time: np.ndarray
    states: tuple[str, ...]
    truth: np.ndarray | None
    measurements: dict[str, np.ndarray]
    estimates: dict[str, dict[str, Estimate]]
    uplinks: dict[str, Uplink] = field(default_factory=dict)
    reports: dict[str, dict[str, SentReports]] = field(default_factory=dict)

    def errors(self, node: str, name: str) -> np.ndarray:
        """x - xhat of one filter of one node.

        Raises:
            ValueError: a recording has no truth.
        """
        if self.truth is None:
            raise fail("errors", "a record with the true state", "a recording without it")
        result: np.ndarray = self.truth - np.asarray(self.estimates[node][name].mean)
        return result

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
    return Record(time, network.states, batch["truth"], measurements, estimates, uplinks, reports)


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
