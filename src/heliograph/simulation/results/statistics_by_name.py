"""Error statistics by node and filter."""

import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from heliograph.disk.quoting import label_with_unit, quote_for_figure
from heliograph.numerics.check import fail
from heliograph.numerics.module import readable
from heliograph.numerics.types import units_in
from heliograph.simulation.network import FUSED
from heliograph.simulation.results.labelled import (
    TIME,
    FilterLabels,
    check_title,
    iterate_filters,
    names_of,
    read_units,
    read_uplinks,
    read_values,
)
from heliograph.simulation.results.plots import (
    FAR,
    choose_filters,
    colour_of,
    legend_outside,
    make_panels,
    state_places,
)
from heliograph.simulation.results.saved import Saved
from heliograph.simulation.results.statistics import ErrorStatistics, matrices

if TYPE_CHECKING:  # extras
    import pandas as pd
    import xarray as xr
    from matplotlib.axes import Axes

STATISTICS = "heliograph statistics"  # the title of a dataset that holds them


@readable
class StatisticsByName(dict[str, dict[str, ErrorStatistics]], Saved):
    """Error statistics by node and filter; fused ones under "fused".

    `smoothed` holds statistics of estimates given later data too, None where these were not asked for. They are saved
    separately.

    Args:
        by_node: statistics by node and filter.
        states: names of the plant's states.
        units: by the state's name; by default those that the names have.
    """

    def __init__(
        self,
        by_node: Mapping[str, dict[str, ErrorStatistics]],
        states: tuple[str, ...],
        units: Mapping[str, str] | None = None,
    ):
        super().__init__(by_node)
        self.states, self.units = states, units_in(states) | dict(units or {})
        self.smoothed: StatisticsByName | None = None

    def to_xarray(self) -> "xr.Dataset":
        """Return the labelled arrays: RMSE, claimed deviation and NEES over time, and the sums that they are made from.

        Raises:
            ModuleNotFoundError: without xarray (extra "results").
        """
        first = next((score for filters in self.values() for score in filters.values()), None)
        if first is None:
            raise fail("statistics", "those of one filter at least", "none")
        n, rows, batches = len(self.states), {TIME: first.nees.shape[1]}, {"batch": len(first.count)}
        uplinks = {name: score.uplink for name, score in self.get(FUSED, {}).items() if score.uplink}
        labels = FilterLabels(list(self), self, self.states, rows, batches, uplinks)

        def variances(covariances: np.ndarray) -> np.ndarray:
            """Return the diagonals (..., n) of covariances (..., n, n)."""
            return np.diagonal(covariances, axis1=-2, axis2=-1)

        # fill(name, read): what `read` returns of each filter's score, along the axes of this field.
        fill, none_failed = labels.of_filters, np.full(rows[TIME], np.nan)
        claimed = fill("deviation", lambda s: variances(s.claimed()))
        fields = {
            # Sums by batch, from which the statistics can be restored.
            "runs": first.count,
            "errors": fill("errors", lambda s: matrices(s.pairs)),
            "claimed": fill("claimed", lambda s: matrices(s.claimed_pairs)),
            "nees": fill("nees", lambda s: s.nees),
            "claim": labels.claims(),
            "failed": fill("failed", lambda s: none_failed if s.failed is None else s.failed),
            "failed_runs": fill("failed_runs", lambda s: s.failed_runs),
            # Figures.
            "rmse": np.sqrt(fill("rmse", lambda s: variances(s.actual()))),
            "deviation": np.sqrt(np.where(claimed >= 0, claimed, np.nan)),
            "nees_per_dimension": fill("nees_per_dimension", lambda s: s.nees.sum(axis=0) / s.runs / n),
            **labels.sent(),
        }
        return labels.dataset(STATISTICS, fields, np.arange(1.0, rows[TIME] + 1), self.units)

    @classmethod
    def from_xarray(cls, dataset: "xr.Dataset") -> "StatisticsByName":
        """Return the statistics from a dataset that `to_xarray` made.

        Raises:
            ValueError: no such dataset.
        """
        check_title(dataset, STATISTICS)
        states, count = names_of(dataset, "state"), read_values(dataset, "runs", [TIME])
        upper, uplinks = np.triu_indices(len(states)), read_uplinks(dataset, [TIME])
        # Back to nodes and filters by name; of symmetric matrices the pairs i <= j.
        results: dict[str, dict[str, ErrorStatistics]] = {node: {} for node in names_of(dataset, "node")}
        sums = ("errors", "claimed", "nees", "failed", "failed_runs")
        for node, name, claim, values in iterate_filters(dataset, sums, [TIME]):
            results[node][name] = ErrorStatistics(
                count=count.copy(),
                pairs=values["errors"][..., *upper],
                claimed_pairs=values["claimed"][..., *upper],
                nees=values["nees"],
                claim=claim,
                uplink=uplinks.get(name) if node == FUSED else None,
                failed=None if np.isnan(values["failed"]).any() else values["failed"],
                failed_runs=int(values["failed_runs"]),
            )
        return cls(results, tuple(states), read_units(dataset))

    def to_pandas(self) -> "pd.DataFrame":
        """Return the table: a row for each node and filter, with claim, runs, RMSE, NEES, errors, and figures by state.

        Raises:
            ModuleNotFoundError: without pandas (extra "results").
        """
        import pandas as pd

        # Failed runs stand in the row, without a warning each.
        rows, index = [], []
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # the row says in how many runs it failed
            for node, filters in self.items():
                for name, score in filters.items():
                    index.append((node, name))
                    rows.append(_summarise(score, self.states))
        names = pd.MultiIndex.from_tuples(index, names=["node", "filter"])
        return pd.DataFrame(rows, index=names)

    def plot(
        self,
        node: str | None = None,
        filters: Sequence[str] | None = None,
        states: Sequence[str] | None = None,
        axes: "Axes | Sequence[Axes] | None" = None,
    ) -> "list[Axes]":
        """Draw the RMSE over time, and dashed the claimed deviation: one axes a state.

        Args:
            node: name of the node; the first by default.
            filters: names of its filters; all by default.
            states: names of states; all by default.
            axes: to draw on, as many as states; new ones by default.

        Raises:
            ValueError: a node, filter or state that there is not, another number of axes.
            ModuleNotFoundError: without matplotlib (extra "report").
        """
        # What is drawn, on which axes.
        node, filters = choose_filters(self, node, filters)
        places = state_places(states, self.states)
        time = np.arange(1.0, self[node][filters[0]].nees.shape[1] + 1)
        drawn = make_panels(axes, len(places), time, self.units)
        for panel, i in zip(drawn, places, strict=True):
            for number, name in enumerate(filters):
                # Solid: actual; dashed: claimed.
                score, colour = self[node][name], colour_of(number)
                claimed = score.claimed()[:, i, i]
                panel.plot(time, np.sqrt(score.actual()[:, i, i]), color=colour, label=quote_for_figure(name))
                panel.plot(time, np.sqrt(np.where(claimed >= 0, claimed, np.nan)), color=colour, linestyle="--")
            panel.set_ylabel(f"RMSE of {label_with_unit(self.states[i], self.units)}")
            # A log axis where one is far larger than another.
            ends = [float(np.sqrt(self[node][name].actual()[-1, i, i])) for name in filters]
            if min(ends) > 0 and np.isfinite(max(ends)) and max(ends) > FAR * min(ends):
                panel.set_yscale("log")
        legend_outside(drawn[0], "dashed: claimed")
        return drawn

    def failures(self) -> list[str]:
        """Return a line for each filter without a valid estimate in some run, and for each uplink that saturated.

        Those of smoothed estimates come first and begin with "smoothed".
        """
        lines = [] if self.smoothed is None else [f"smoothed {line}" for line in self.smoothed.failures()]
        for node, filters in self.items():
            lines += [f"{node}/{name}: {score.failure}" for name, score in filters.items() if score.failed_runs]
            for name, score in filters.items():
                shares = score.uplink.saturated_share() if score.uplink else {}
                for sender, share in shares.items():
                    if share:
                        lines.append(
                            f"{node}/{name}: the quantizer of node {sender} saturated in {share:.2%} of samples"
                        )
        return lines


def _summarise(score: "ErrorStatistics", states: Sequence[str]) -> Mapping[str, object]:
    """Return a filter's figures by name: RMSE, NEES with its interval, and RMSE and claim of each state."""
    # Figures of all states together, then of each state.
    nees, low, high = score.nees_per_dimension()
    rmse, error = score.rmse()
    # Figures of each state, after those of all together.
    by_state = zip(states, *score.rmse_by_state(), score.deviation_by_state(), strict=True)
    total = {
        "claim": "none" if score.failed_runs else score.claim,
        "runs": score.runs,
        "failed runs": score.failed_runs,
        "rmse": rmse,
        "rmse error": error,
        "nees": nees,
        "nees low": low,
        "nees high": high,
    }
    for state, rmse_of_state, error_of_state, claimed in by_state:
        total |= {
            f"rmse of {state}": rmse_of_state,
            f"rmse error of {state}": error_of_state,
            f"claimed of {state}": claimed,
        }
    return total
