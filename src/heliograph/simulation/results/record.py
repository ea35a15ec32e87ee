"""Record of runs: trajectories of the truth, the measurements, and the estimates with their claims."""

from collections.abc import Sequence
from copy import copy
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import jax
import numpy as np
from typing_extensions import TypeAliasType

from heliograph.disk.quoted_text import label_with_unit
from heliograph.filters.innovation import InnovationSummary, Weighed
from heliograph.model.estimate import Estimate, mask_sound_estimates
from heliograph.model.forecast_origin import KeptOrigin, Origin
from heliograph.numerics.check import check_count, fail
from heliograph.numerics.module import readable
from heliograph.numerics.types import units_in
from heliograph.simulation.centres.uplinks import SentReports, Uplink
from heliograph.simulation.network import FUSED
from heliograph.simulation.results.consistency import nees
from heliograph.simulation.results.labelled_datasets import (
    TIME,
    FilterLabels,
    check_title,
    count_modes,
    iterate_filters,
    read_estimate,
    read_labels,
    read_modes,
    read_units,
    read_uplinks,
    read_values,
)
from heliograph.simulation.results.overloaded_words import Overloads, find_overloads
from heliograph.simulation.results.plots import (
    check_run,
    choose_filters,
    draw_modes,
    draw_state,
    find_state_indices,
    legend_outside,
    make_panels,
)
from heliograph.simulation.results.record_html import write_record_html
from heliograph.simulation.results.refusal_counts import Refusal, list_refusals
from heliograph.simulation.results.saved_datasets import SavableResults
from heliograph.simulation.results.wide_table import make_frame, read_frame

if TYPE_CHECKING:  # extras
    import pandas as pd
    import xarray as xr
    from matplotlib.axes import Axes

RECORD = "heliograph record"  # the title of a dataset that holds one

Array = TypeAliasType("Array", np.ndarray)
Units = TypeAliasType("Units", dict[str, str])  # by name
ByNode = TypeAliasType("ByNode", dict[str, np.ndarray])
Uplinks = TypeAliasType("Uplinks", dict[str, Uplink])  # by fusion
Estimates = TypeAliasType("Estimates", dict[str, dict[str, Estimate]])  # by node and filter
Reports = TypeAliasType("Reports", dict[str, dict[str, SentReports]])  # by fusion and node
Weights = TypeAliasType("Weights", dict[str, dict[str, Weighed]])  # by node and filter


@readable
@dataclass(frozen=True)
class Record(SavableResults):
    """Trajectories of one recording (no run axis) or of Monte Carlo runs (a leading run axis).

    Args:
        time: numbers (time,), or dates (datetime64, UTC).
        states: names of the plant's states.
        truth: true states (run, time, n); None in a recording without them, NaN where they are not known.
        measurements: by node, (run, time, received), NaN where nothing arrived.
        estimates: by node and filter, with mean (run, time, n), covariance (run, time, n, n) and the claim.
        uplinks: by name, of each fusion that has quantizers.
        units: by the state's name, and of "time"; by default those that the names of states have.
        smoothed: record of estimates given later data too; None where these were not asked for. It is saved separately.
        reports: by fusion and node, of each fusion that uses reports.
        transmissions: by simulated node with a trigger, (run, time, m): the `model.SendReason` for which a component
            was sent, negative where it was lost, 0 where it was not sent.
        refused: of a recording, by node that refused any, the number of the reason for which a reading that came counts
            as missing (`model.checks.refusal_reasons`), 0 where it does not, (time, received); `refusals` counts them.
        weighed: of a recording, by node and filter that weighs what arrives: `value` and `variance` of its innovations
            and their `weight` in the update, (time, received) each; `outputs` summarises them.
        origin: of what `hg.run` returns, the filters' last states, from which `hg.forecast` predicts; not saved.
    """

    time: Array
    states: tuple[str, ...]
    truth: Array | None
    measurements: ByNode
    estimates: Estimates
    uplinks: Uplinks = field(default_factory=dict)
    units: Units = field(default_factory=dict)
    smoothed: "Record | None" = None
    reports: Reports = field(default_factory=dict)
    transmissions: ByNode = field(default_factory=dict)
    weighed: Weights = field(default_factory=dict)
    refused: ByNode = field(default_factory=dict, init=False, compare=False, repr=False)
    origin: KeptOrigin = field(default=None, init=False, compare=False, repr=False)

    def __post_init__(self) -> None:
        """Take the units of states whose names have one; units given apart come first."""
        if isinstance(self.states, tuple) and (units := units_in(self.states)):
            object.__setattr__(self, "units", units | self.units)

    def _repr_html_(self) -> str:
        """Draw the estimates with their bands, for notebooks."""
        return write_record_html(self)

    def with_origin(self, origin: Origin) -> "Record":
        """Return the same record with the final states of its filters, from which more rows can be filtered."""
        changed = copy(self)
        vars(changed)["origin"] = origin  # fields are frozen
        return changed

    @property
    def overloads(self) -> Overloads:
        """How often words overload, and by how much a claim may be off, by node and filter; of what `run` returns."""
        return find_overloads(getattr(self.origin, "model", None))

    @property
    def runs(self) -> int | None:
        """Number of Monte Carlo runs, the first of three axes of all arrays; None for a recording, with two axes."""
        means = [np.asarray(estimate.mean) for filters in self.estimates.values() for estimate in filters.values()]
        truth = [] if self.truth is None else [self.truth]
        arrays = [*means, *self.measurements.values(), *truth]  # (run, time, n), or (time, n) without runs
        has_runs = bool(arrays) and arrays[0].ndim == 3
        return len(arrays[0]) if has_runs else None

    def of_run(self, run: int) -> "Record":
        """Return the record of one of the runs, without an axis of runs.

        Raises:
            ValueError: a recording, which has none, or a number that no run has.
        """
        if self.runs is None or check_count("run", run, least=0) >= self.runs:
            raise fail("run", "one of a Monte Carlo simulation" if self.runs is None else f"one of {self.runs}", run)
        measurements, estimates, reports = jax.tree.map(
            lambda leaf: np.asarray(leaf)[run], (self.measurements, self.estimates, self.reports)
        )
        return replace(
            self,
            truth=None if self.truth is None else self.truth[run],
            measurements=measurements,
            estimates=estimates,
            uplinks={name: Uplink(up.nodes, up.saturated[run], up.symbols[run]) for name, up in self.uplinks.items()},
            smoothed=None if self.smoothed is None else self.smoothed.of_run(run),
            reports=reports,
        )

    def errors(self, node: str, name: str) -> np.ndarray:
        """Return x - xhat of one filter of one node; for attitudes it is the rotation from the estimate to the truth.

        Raises:
            ValueError: a recording has no truth, or there is no such filter.
        """
        self.check_filter(node, name)
        if self.truth is None:
            raise fail("errors", "a record with the true state", "a recording without it")
        errors: np.ndarray = np.asarray(self.estimates[node][name].error(self.truth))
        return errors

    def check_filter(self, node: str, name: str) -> None:
        """Raise ValueError unless the node has a filter of this name."""
        if name not in self.estimates.get(node, {}):
            available = [f"{node_name}/{label}" for node_name, filters in self.estimates.items() for label in filters]
            raise fail("node and filter", f"one of {', '.join(available)}", f"{node}/{name}")

    def rmse(self, node: str, name: str) -> dict[str, float]:
        """Return the root mean square error of each state, in its unit, over runs and the steps whose truth is known.

        Raises:
            ValueError: a recording has no truth, or there is no such filter.
        """
        squares = self.errors(node, name).reshape(-1, len(self.states)) ** 2
        is_known = ~np.isnan(np.asarray(self.truth)).reshape(squares.shape)
        sums, count = np.sum(np.where(is_known, squares, 0.0), axis=0), is_known.sum(axis=0)
        mean = np.divide(sums, count, out=np.full(len(count), np.nan), where=count > 0)
        return dict(zip(self.states, np.sqrt(mean).tolist(), strict=True))

    def nees(self, node: str, name: str) -> np.ndarray:
        """Return the normalised estimation error squared of each step (run, time), over states of known truth.

        Its expectation is the number of these states if the claim is exact. It is NaN where no state's truth is known,
        or if no covariance is claimed.

        Raises:
            ValueError: a recording has no truth, or there is no such filter.
        """
        errors, estimate, truth = self.errors(node, name), self.estimates[node][name], np.asarray(self.truth)
        is_sound = mask_sound_estimates(estimate)[..., None]
        if estimate.claim == "none":
            return np.full(errors.shape[:-1], np.nan)
        covariance = np.where(is_sound[..., None], np.asarray(estimate.covariance), np.eye(len(self.states)))
        return nees(truth, np.where(is_sound, truth - errors, np.nan), covariance)

    def outputs(self, node: str, name: str) -> tuple[InnovationSummary, ...]:
        """Return a summary of each output's innovations, for a filter that weighs them: use, weights, bias, size.

        Raises:
            ValueError: no such filter, one that weighs nothing, or a simulation (use `filter.run` for its weights).
        """
        self.check_filter(node, name)
        if name not in self.weighed.get(node, {}):
            weighing = [f"{node_name}/{label}" for node_name, filters in self.weighed.items() for label in filters]
            raise fail("node and filter", f"one that weighs, of a recording: {weighing}", f"{node}/{name}")
        return self.weighed[node][name].summarise()

    def with_refused(self, refused: ByNode) -> "Record":
        """Return the same record with the reason for which each reading was refused, by node (time, received).

        Nodes that refused nothing are left out.
        """
        changed = copy(self)
        vars(changed)["refused"] = {node: reasons for node, reasons in refused.items() if reasons.any()}
        return changed

    @property
    def refusals(self) -> tuple[Refusal, ...]:
        """How many readings of a recording were refused, by reason, of each node's component and by each filter."""
        return list_refusals(self.refused, self.weighed)

    def to_xarray(self) -> "xr.Dataset":
        """Return the labelled arrays: dimensions run, time, node, filter, state, and `other`, which is a state too.

        A filter that a node does not have is NaN, and its `claim` is empty. `Record.from_xarray` converts them back.

        Raises:
            ModuleNotFoundError: without xarray (extra "results").
        """
        # Labels, and lengths of the axes: those of rows, and of the longest measurement and the most modes.
        nodes = list(dict.fromkeys([*self.measurements, *self.estimates]))
        rows = {TIME: len(self.time)} if self.runs is None else {"run": self.runs, TIME: len(self.time)}
        lengths = {node: z.shape[-1] for node, z in self.measurements.items()}
        longest = {"received": max(lengths.values(), default=0)}
        if modes := count_modes(self.estimates):
            longest["mode"] = modes
        labels = FilterLabels(nodes, self.estimates, self.states, rows, longest, self.uplinks)
        fields = {
            "measurement": labels.fill_field(
                "measurement", [((nodes.index(node),), z) for node, z in self.measurements.items()]
            ),
            "length": np.array([lengths.get(node, -1) for node in nodes], dtype=np.int64),
            "estimated": np.array([node in self.estimates for node in nodes], dtype=bool),
            "claim": labels.claims(),
            "mean": labels.fill_from_results("mean", lambda estimate: estimate.mean),
            "covariance": labels.fill_from_results("covariance", lambda estimate: estimate.covariance),
            **labels.make_quantizer_fields(),
            **labels.make_attitude_field(),
        }
        if modes:
            fields["modes"] = labels.fill_from_results("modes", read_modes)
        fields |= {} if self.truth is None else {"truth": self.truth}
        return labels.make_dataset(RECORD, fields, self.time, self.units)

    @classmethod
    def from_xarray(cls, dataset: "xr.Dataset") -> "Record":
        """Return the record from a dataset that `to_xarray` made, or from a part of one that keeps its dimensions.

        Raises:
            ValueError: no such dataset.
        """
        check_title(dataset, RECORD)
        lead, nodes = ["run", TIME] if "run" in dataset.dims else [TIME], read_labels(dataset, "node")
        # `lead` are the leading axes of all values. "estimated" is true for nodes whose estimates were recorded, and
        # "length" is how many numbers each node receives.
        measurement, length = read_values(dataset, "measurement", lead), read_values(dataset, "length", lead)
        estimated = np.flatnonzero(read_values(dataset, "estimated", lead))
        estimates: dict[str, dict[str, Estimate]] = {nodes[i]: {} for i in estimated}
        fields = ("mean", "covariance", *(["modes"] if "modes" in dataset else []))
        for node, name, claim, values in iterate_filters(dataset, fields, lead):
            estimates[node][name] = read_estimate(dataset, claim, values)
        return cls(
            time=np.asarray(dataset[TIME].values),
            states=tuple(read_labels(dataset, "state")),
            truth=read_values(dataset, "truth", lead) if "truth" in dataset else None,
            measurements={  # without padding; a length of -1 is of a place that receives nothing
                node: measurement[..., i, : length[i]].copy() for i, node in enumerate(nodes) if length[i] >= 0
            },
            estimates=estimates,
            uplinks=read_uplinks(dataset, lead),
            units=read_units(dataset),
        )  # fmt: skip

    def to_pandas(self) -> "pd.DataFrame":
        """Return the table: a row for each time (and run), columns (node, filter, quantity, component, other).

        Quantities: truth, measurement, mean, "covariance (CLAIM)", "mode probability", saturated, symbols.

        Raises:
            ModuleNotFoundError: without pandas (extra "results").
        """
        return make_frame(vars(self), self.runs)

    @classmethod
    def from_pandas(cls, frame: "pd.DataFrame") -> "Record":
        """Return the record from a table that `to_pandas` made; units are not in it.

        Raises:
            ValueError: no such table.
        """
        return cls(**read_frame(frame))

    def apart(self) -> list[str]:
        """Return the names of the parts that `save` leaves out of a file, and that must be saved separately."""
        return super().apart() + [
            name for name in ("reports", "transmissions", "weighed", "refused") if getattr(self, name)
        ]

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
        node, filters = choose_filters(self.estimates, node, filters)
        indices = find_state_indices(states, self.states)
        check_run(run, self.runs)
        of_run: Any = ... if self.runs is None else run  # index of the run; `...` takes all of a record without runs
        drawn = make_panels(axes, len(indices), self.time, self.units)
        for panel, i in zip(drawn, indices, strict=True):
            truth = None if self.truth is None else self.truth[of_run][..., i]
            estimates = {name: self.estimates[node][name] for name in filters}
            draw_state(panel, self.time, estimates, (of_run, i), sigmas, truth)
            panel.set_ylabel(label_with_unit(self.states[i], self.units))
        legend_outside(drawn[0])
        return drawn

    def plot_modes(
        self, node: str | None = None, filters: Sequence[str] | None = None, axes: "Axes | None" = None, run: int = 0
    ) -> "Axes":
        """Draw the probabilities of the modes over time, of the filters of a node that weigh modes.

        Args:
            node: name of the node; the first by default.
            filters: names of its filters; all that weigh modes by default.
            axes: to draw on; new ones by default.
            run: number of the Monte Carlo run; 0 by default.

        Raises:
            ValueError: no filter that weighs modes, a node, filter or run that there is not.
            ModuleNotFoundError: without matplotlib (extra "report").
        """
        check_run(run, self.runs)
        run_index = None if self.runs is None else run
        return draw_modes(self.estimates, node, filters, axes, run_index, (self.time, self.units))

    def failures(self) -> list[str]:
        """List filters whose estimate became non-finite or whose bound lost positive semidefiniteness, a line each.

        The line names the node, the filter, the first step, and in how many runs; nothing is repaired. One line more
        for each uplink that saturated. Smoothed estimates likewise, after "smoothed".
        """
        lines = [] if self.smoothed is None else [f"smoothed {line}" for line in self.smoothed.failures()]
        for node, filters in self.estimates.items():
            for name, estimate in filters.items():
                what = "mean" if estimate.claim == "none" else "covariance"
                lines += [
                    f"{node}/{name}: no valid {what} {when}"
                    for when in describe_bad_steps(~mask_sound_estimates(estimate))
                ]
        for name, uplink in self.uplinks.items():
            for i, node in enumerate(uplink.nodes):
                saturated = uplink.saturated[..., i, :]
                if np.any(saturated):
                    counted = f"{np.count_nonzero(saturated)} of {saturated.size} samples"
                    lines.append(f"{FUSED}/{name}: the quantizer of node {node} saturated in {counted}")
        return lines


def describe_bad_steps(is_bad: np.ndarray) -> list[str]:
    """Return one phrase that says from which step on, and in how many runs, some flag of `is_bad` (..., time) is True.

    The list is empty if no flag is True.
    """
    if not np.any(is_bad):
        return []
    by_time = is_bad.reshape(-1, is_bad.shape[-1])
    step, runs = int(np.argmax(by_time.any(axis=0))), int(by_time.any(axis=1).sum())
    return [f"from step {step} in {runs} of {len(by_time)} runs"]
