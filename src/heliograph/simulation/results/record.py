"""Record of runs: trajectories of the truth, the measurements, and the estimates with their claims."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

import jax
import numpy as np

from heliograph.model.estimate import Estimate, is_sound
from heliograph.numerics.check import check_count, fail
from heliograph.numerics.readable import readable
from heliograph.simulation.centres.uplinks import SentReports, Uplink
from heliograph.simulation.network import FUSED
from heliograph.simulation.results.consistency import nees
from heliograph.simulation.results.frames import record_frame, record_of_frame
from heliograph.simulation.results.labelled import checked_units
from heliograph.simulation.results.labelled_record import record_dataset, record_from
from heliograph.simulation.results.plots import plot_record
from heliograph.simulation.results.saved import Saved

if TYPE_CHECKING:  # extras
    import pandas as pd
    import xarray as xr
    from matplotlib.axes import Axes


@readable
@dataclass(frozen=True)
class Record(Saved):
    """Trajectories of one recording (no run axis) or of Monte Carlo runs (a leading run axis).

    Args:
        time: numbers (time,), or dates (datetime64, UTC).
        states: names of the plant's states.
        truth: true states (run, time, n); None in a recording without them, NaN where they are not known.
        measurements: by node, (run, time, received), NaN where nothing arrived.
        estimates: by node and filter, with mean (run, time, n), covariance (run, time, n, n) and the claim.
        uplinks: by name, of each fusion that has quantizers.
        units: by the state's name, and of "time"; empty where they were not given.
        smoothed: record of estimates given later data too; None where these were not asked for. It is saved separately.
        reports: by fusion and node, of each fusion that uses reports.
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
        """Number of Monte Carlo runs; None for one recording."""
        means = [np.asarray(e.mean) for filters in self.estimates.values() for e in filters.values()]
        every = [*means, *self.measurements.values(), *([] if self.truth is None else [self.truth])]
        return len(every[0]) if every and every[0].ndim == 3 else None

    def of_run(self, run: int) -> "Record":
        """Return the record of one of the runs, without an axis of runs.

        Raises:
            ValueError: a recording, which has none, or a number that no run has.
        """
        if self.runs is None or check_count("run", run, 0) >= self.runs:
            raise fail("run", "one of a Monte Carlo simulation" if self.runs is None else f"one of {self.runs}", run)
        # All arrays but the times have an axis of runs first.
        measurements, estimates, reports = jax.tree.map(
            lambda leaf: np.asarray(leaf)[run], (self.measurements, self.estimates, self.reports)
        )
        return replace(
            self,
            truth=None if self.truth is None else self.truth[run],
            measurements=measurements,
            estimates=estimates,
            uplinks={
                name: Uplink(item.nodes, item.saturated[run], item.symbols[run]) for name, item in self.uplinks.items()
            },
            smoothed=None if self.smoothed is None else self.smoothed.of_run(run),
            reports=reports,
        )

    def with_units(self, units: Mapping[str, str]) -> "Record":
        """Return the record with units, by the state's name and of "time", for files, tables and figures.

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
            known = [f"{element}/{of}" for element, filters in self.estimates.items() for of in filters]
            raise fail("node and filter", f"one of {', '.join(known)}", f"{node}/{name}")

    def rmse(self, node: str, name: str) -> dict[str, float]:
        """Root mean square error of each state over runs and the steps whose truth is known, in that state's unit.

        Raises:
            ValueError: a recording has no truth, or there is no such filter.
        """
        squares = self.errors(node, name).reshape(-1, len(self.states)) ** 2
        known = ~np.isnan(np.asarray(self.truth)).reshape(squares.shape)
        sums, count = np.sum(np.where(known, squares, 0.0), axis=0), known.sum(axis=0)
        mean = np.divide(sums, count, out=np.full(len(count), np.nan), where=count > 0)
        return dict(zip(self.states, np.sqrt(mean).tolist(), strict=True))

    def nees(self, node: str, name: str) -> np.ndarray:
        """Normalised estimation error squared of each step (run, time), of the states whose truth is known.

        Its expectation is their number where the claim is exact; NaN where no state's truth is known, or nothing is
        claimed.

        Raises:
            ValueError: a recording has no truth, or there is no such filter.
        """
        errors, estimate = self.errors(node, name), self.estimates[node][name]
        sound = is_sound(estimate)[..., None]
        if estimate.claim == "none":
            return np.full(errors.shape[:-1], np.nan)
        claimed = np.where(sound[..., None], np.asarray(estimate.covariance), np.eye(len(self.states)))
        return nees(self.truth, np.where(sound, np.asarray(estimate.mean), np.nan), claimed)

    def to_xarray(self) -> "xr.Dataset":
        """Labelled arrays: dimensions run, time, node, filter, state; `Record.from_xarray` converts them back.

        Raises:
            ModuleNotFoundError: without xarray (extra "results").
        """
        return record_dataset(self)

    @classmethod
    def from_xarray(cls, dataset: "xr.Dataset") -> "Record":
        """Record from a dataset that `to_xarray` made, or from a part of one that keeps its dimensions.

        Raises:
            ValueError: no such dataset.
        """
        return record_from(dataset)

    def to_pandas(self) -> "pd.DataFrame":
        """Table: a row for each time (and run), columns (node, filter, quantity, component, other).

        Quantities: truth, measurement, mean, "covariance (CLAIM)" of component and other, saturated, symbols.

        Raises:
            ModuleNotFoundError: without pandas (extra "results").
        """
        return record_frame(self)

    @classmethod
    def from_pandas(cls, frame: "pd.DataFrame") -> "Record":
        """Record from a table that `to_pandas` made; units are not in it.

        Raises:
            ValueError: no such table.
        """
        return record_of_frame(frame)

    def apart(self) -> list[str]:
        """Names of the parts that are saved separately."""
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

        Args:
            node: name of the node; the first by default.
            filters: names of its filters; all by default.
            states: names of states; all by default.
            axes: to draw on, as many as states; new ones by default.
            run: number of the Monte Carlo run; 0 by default.
            sigmas: half-width of the bands in claimed deviations; 2 by default.

        Raises:
            ValueError: a node, filter, state or run that there is not, another number of axes.
            ModuleNotFoundError: without matplotlib (extra "report").
        """
        return plot_record(self, node, filters, states, axes, run, sigmas)

    def failures(self) -> list[str]:
        """List filters whose estimate became non-finite or whose bound lost positive semidefiniteness, a line each.

        The line names the node, the filter, the first step, and in how many runs; nothing is repaired. One line more
        for each uplink that saturated. Smoothed estimates likewise, after "smoothed".
        """
        # Smoothed estimates first.
        lines = [] if self.smoothed is None else [f"smoothed {line}" for line in self.smoothed.failures()]
        for node, filters in self.estimates.items():
            for name, estimate in filters.items():
                # First step and number of runs without a valid estimate.
                bad = ~is_sound(estimate)
                if np.any(bad):
                    by_time = bad.reshape(-1, bad.shape[-1])
                    step = int(np.argmax(by_time.any(axis=0)))
                    runs = int(by_time.any(axis=1).sum())
                    what = "mean" if estimate.claim == "none" else "covariance"
                    lines.append(f"{node}/{name}: no valid {what} from step {step} in {runs} of {len(by_time)} runs")
        # Quantizers that saturated.
        for name, uplink in self.uplinks.items():
            for i, node in enumerate(uplink.nodes):
                saturated = uplink.saturated[..., i, :]
                if np.any(saturated):
                    counted = f"{np.count_nonzero(saturated)} of {saturated.size} samples"
                    lines.append(f"{FUSED}/{name}: the quantizer of node {node} saturated in {counted}")
        return lines
