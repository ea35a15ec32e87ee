"""Error statistics by node and filter."""

import warnings
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from heliograph.disk.quoted_text import label_with_unit, quote_for_figure, visible
from heliograph.numerics.check import fail
from heliograph.numerics.module import readable
from heliograph.numerics.types import units_in
from heliograph.simulation.network import FUSED
from heliograph.simulation.results.labelled_datasets import (
    TIME,
    FilterLabels,
    check_title,
    iterate_filters,
    read_labels,
    read_units,
    read_uplinks,
    read_values,
)
from heliograph.simulation.results.plots import (
    FAR,
    choose_colour,
    choose_filters,
    find_state_indices,
    legend_outside,
    make_panels,
)
from heliograph.simulation.results.saved_datasets import SavableResults
from heliograph.simulation.results.statistics import ErrorStatistics, expand_pairs

if TYPE_CHECKING:  # extras
    import pandas as pd
    import xarray as xr
    from matplotlib.axes import Axes

STATISTICS = "heliograph statistics"  # the title of a dataset that holds them


@readable
class StatisticsByName(dict[str, dict[str, ErrorStatistics]], SavableResults):
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
        """Make the dictionary from statistics by node and filter, with the names of the states and their units."""
        super().__init__(by_node)
        # The names of states may carry units; units that are given override these.
        self.states, self.units = states, units_in(states) | dict(units or {})
        self.smoothed: StatisticsByName | None = None  # statistics of smoothed estimates, set where there are some

    def to_xarray(self) -> "xr.Dataset":
        """Return the labelled arrays: RMSE, claimed deviation and NEES over time, and the sums that they are made from.

        Raises:
            ModuleNotFoundError: without xarray (extra "results").
        """
        first = next((score for filters in self.values() for score in filters.values()), None)
        if first is None:
            raise fail("statistics", "those of one filter at least", "none")
        n, steps = len(self.states), first.nees.shape[1]
        labels = FilterLabels(
            nodes=list(self),
            by_node=self,
            states=self.states,
            rows={TIME: steps},
            lengths={"batch": len(first.count)},
            uplinks={name: score.uplink for name, score in self.get(FUSED, {}).items() if score.uplink},
        )

        def take_variances(covariances: np.ndarray) -> np.ndarray:
            """Return the diagonals (..., n) of covariances (..., n, n)."""
            return np.diagonal(covariances, axis1=-2, axis2=-1)

        # fill(name, read): the array of the field `name`, of what `read` returns of each filter's statistics.
        fill, none_failed = labels.fill_from_results, np.full(steps, np.nan)
        claimed = fill("deviation", lambda score: take_variances(score.claimed()))
        fields = {
            # Sums over the runs of each batch (a part of the runs), from which the statistics can be restored. Sums of
            # e_i e_j are held for i <= j; `expand_pairs` makes matrices of them.
            "runs": first.count,
            "errors": fill("errors", lambda score: expand_pairs(score.pairs)),
            "claimed": fill("claimed", lambda score: expand_pairs(score.claimed_pairs)),
            "nees": fill("nees", lambda score: score.nees),
            "claim": labels.claims(),
            "failed": fill("failed", lambda score: none_failed if score.failed is None else score.failed),
            "failed_runs": fill("failed_runs", lambda score: score.failed_runs),
            # Figures made from these; of a claimed variance that is negative there is no deviation.
            "rmse": np.sqrt(fill("rmse", lambda score: take_variances(score.actual()))),
            "deviation": np.sqrt(np.where(claimed >= 0, claimed, np.nan)),
            "nees_per_dimension": fill("nees_per_dimension", lambda score: score.nees.sum(axis=0) / score.runs / n),
            **labels.make_quantizer_fields(),
        }
        return labels.make_dataset(STATISTICS, fields, np.arange(1.0, steps + 1), self.units)

    @classmethod
    def from_xarray(cls, dataset: "xr.Dataset") -> "StatisticsByName":
        """Return the statistics from a dataset that `to_xarray` made, with all its states.

        They are sums over runs by node and filter: error products, claimed covariances, NEES (e' P^-1 e of an error e
        with the claimed covariance P) and failures.

        Raises:
            ValueError: another dataset, or one with some of the states only, whose NEES is not known.
        """
        # The dataset may have been cut: it says in words of which states it was made.
        check_title(dataset, STATISTICS)
        states, count = read_labels(dataset, "state"), read_values(dataset, "runs", [TIME])
        made_of = str(dataset.attrs.get("states", ""))
        if sorted(visible(", ".join(states)).split(", ")) != sorted(made_of.split(", ")):
            expected = f"all states, {made_of}, since the NEES is of all"
            raise fail("dataset, dimension 'state'", expected, ", ".join(states))
        upper, uplinks = np.triu_indices(len(states)), read_uplinks(dataset, [TIME])
        # Back to nodes and filters by name; symmetric matrices are stored as the pairs i <= j.
        results: dict[str, dict[str, ErrorStatistics]] = {node: {} for node in read_labels(dataset, "node")}
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
        """Return a table with a row for each node and filter: claim, runs, RMSE, NEES, errors, and figures by state.

        Raises:
            ModuleNotFoundError: without pandas (extra "results").
        """
        import pandas as pd

        rows, index = [], []
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # no warnings of failed runs, since each row says how many failed
            for node, filters in self.items():
                for name, score in filters.items():
                    index.append((node, name))
                    rows.append(_list_figures(score, self.states))
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
        # The filters and states that are drawn, over steps 1, 2, ..., on one axes for each state.
        node, filters = choose_filters(self, node, filters)
        indices = find_state_indices(states, self.states)
        time = np.arange(1.0, self[node][filters[0]].nees.shape[1] + 1)
        drawn = make_panels(axes, len(indices), time, self.units)
        for panel, i in zip(drawn, indices, strict=True):
            for number, name in enumerate(filters):
                # Solid: actual; dashed: claimed, the root of the variance that the filter states.
                score, colour = self[node][name], choose_colour(number)
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

        Lines on smoothed estimates come first and begin with "smoothed".
        """
        lines = [] if self.smoothed is None else [f"smoothed {line}" for line in self.smoothed.failures()]
        for node, filters in self.items():
            lines += [f"{node}/{name}: {score.failure}" for name, score in filters.items() if score.failed_runs]
            # Quantizers through which a fusion received its nodes' estimates.
            for name, score in filters.items():
                shares = score.uplink.saturated_share() if score.uplink else {}
                for sender, share in shares.items():
                    if share:
                        lines.append(
                            f"{node}/{name}: the quantizer of node {sender} saturated in {share:.2%} of samples"
                        )
        return lines


def _list_figures(score: "ErrorStatistics", states: Sequence[str]) -> Mapping[str, object]:
    """Return a filter's figures by name: RMSE, NEES with its interval, and RMSE and claim of each state.

    They make a row of a table. NEES is e' B^-1 e / n for an error e of n states and the claimed covariance B: 1 on
    average if the claim is exact.
    """
    nees, low, high = score.nees_per_dimension()
    rmse, error = score.rmse()
    # All states together.
    figures = {
        "claim": "none" if score.failed_runs else score.claim,
        "runs": score.runs,
        "failed runs": score.failed_runs,
        "rmse": rmse,
        "rmse error": error,
        "nees": nees,
        "nees low": low,
        "nees high": high,
    }
    # Each state.
    by_state = zip(states, *score.rmse_by_state(), score.deviation_by_state(), strict=True)
    for state, rmse_of_state, error_of_state, claimed in by_state:
        figures |= {
            f"rmse of {state}": rmse_of_state,
            f"rmse error of {state}": error_of_state,
            f"claimed of {state}": claimed,
        }
    return figures
