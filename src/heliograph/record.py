"""What a run leaves behind: trajectories with their claims, or running statistics of the errors."""

from dataclasses import dataclass
from typing import Any

import equinox as eqx
import jax
import numpy as np

from heliograph.check import fail
from heliograph.filter.base import Estimate
from heliograph.network import Network


@dataclass(frozen=True)
class Record:
    """Trajectories of one recording (no run axis) or of Monte Carlo runs (a leading run axis).

    truth (run, time, n) or None; measurements[node] (run, time, received); estimates[node][filter] with mean
    (run, time, n), bound (run, time, n, n) and the claim.
    """

    time: np.ndarray
    states: tuple[str, ...]
    truth: np.ndarray | None
    measurements: dict[str, np.ndarray]
    estimates: dict[str, dict[str, Estimate]]

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

        The line names the node, the filter, the first step, and in how many runs; nothing is repaired.
        """
        lines = []
        for node, filters in self.estimates.items():
            for name, estimate in filters.items():
                bad = ~is_sound(np.asarray(estimate.mean), np.asarray(estimate.bound))
                if np.any(bad):
                    by_time = bad.reshape(-1, bad.shape[-1])
                    step = int(np.argmax(by_time.any(axis=0)))
                    runs = int(by_time.any(axis=1).sum())
                    lines.append(
                        f"{node}/{name}: no valid covariance from step {step} in {runs} of {len(by_time)} runs"
                    )
        return lines


def is_sound(mean: np.ndarray, bound: np.ndarray) -> np.ndarray:
    """Whether each estimate is finite with a positive semidefinite bound (to rounding)."""
    finite = np.isfinite(mean).all(axis=-1) & np.isfinite(bound).all(axis=(-1, -2))
    safe = np.where(finite[..., None, None], bound, np.eye(bound.shape[-1]))
    values = np.linalg.eigvalsh((safe + np.swapaxes(safe, -1, -2)) / 2)
    result: np.ndarray = finite & (values[..., 0] >= -1e-12 * np.abs(values[..., -1]))  # rounding of an eigenvalue
    return result


class AbstractReducer(eqx.Module):
    """What is kept of a block of runs: a carry that is summed over blocks, and a part that is collected."""

    def initial(self, shapes: Any) -> Any:
        """The carry before the first block; `shapes` are those of a block's trajectories."""
        raise NotImplementedError

    def reduce(self, carry: Any, batch: Any, runs: jax.Array, valid: jax.Array) -> tuple[Any, Any]:
        """Next carry and collected part of a block, inside the compiled scan; runs that are not valid are padding."""
        raise NotImplementedError

    def finish(self, carry: Any, collected: Any, network: Network) -> Any:
        """Make the result; collected parts are joined along the run axis, without padding."""
        raise NotImplementedError


class Trajectories(AbstractReducer):
    """Keep everything; memory grows with the number of runs."""

    def initial(self, shapes: Any) -> Any:
        """Nothing is summed."""
        return ()

    def reduce(self, carry: Any, batch: Any, runs: jax.Array, valid: jax.Array) -> tuple[Any, Any]:
        """Collect the block."""
        return carry, batch

    def finish(self, carry: Any, collected: Any, network: Network) -> Record:
        """Make the record; its time is the step, starting at 1."""
        time = np.arange(1, collected["truth"].shape[1] + 1, dtype=np.float64)
        return trajectories_record(network, collected, time)


def trajectories_record(network: Network, batch: Any, time: np.ndarray) -> Record:
    """Record from the scan's output; nodes in the network's order."""
    measurements = {name: np.asarray(batch["measurements"][name]) for name in network.nodes}
    found = batch["estimates"]
    estimates = {node: {name: found[node][name] for name in claims} for node, claims in network.claims().items()}
    return Record(time, network.states, batch["truth"], measurements, estimates)
