"""Error statistics by node and filter."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from heliograph.numerics.readable import readable
from heliograph.simulation.results.frames import statistics_frame
from heliograph.simulation.results.labelled import checked_units
from heliograph.simulation.results.labelled_statistics import statistics_dataset, statistics_from
from heliograph.simulation.results.plots import plot_statistics
from heliograph.simulation.results.saved import Saved
from heliograph.simulation.results.statistics import ErrorStatistics

if TYPE_CHECKING:  # extras
    import pandas as pd
    import xarray as xr
    from matplotlib.axes import Axes


@readable
class StatisticsByName(dict[str, dict[str, ErrorStatistics]], Saved):
    """Error statistics by node and filter; fused ones under "fused".

    `smoothed` holds statistics of estimates given later data too, None where these were not asked for. They are saved
    separately.

    Args:
        result: statistics by node and filter.
        states: names of the plant's states.
        units: by the state's name; none by default.
    """

    def __init__(
        self,
        result: Mapping[str, dict[str, ErrorStatistics]],
        states: tuple[str, ...],
        units: Mapping[str, str] | None = None,
    ):
        super().__init__(result)
        self.states, self.units = states, dict(units or {})
        self.smoothed: StatisticsByName | None = None

    def with_units(self, units: Mapping[str, str]) -> "StatisticsByName":
        """Return the statistics with units, by the state's name, for files, tables and figures.

        Raises:
            ValueError: a name that is no state.
        """
        result = StatisticsByName(self, self.states, checked_units(units, self.states))
        result.smoothed = None if self.smoothed is None else self.smoothed.with_units(units)
        return result

    def to_xarray(self) -> "xr.Dataset":
        """Labelled arrays: RMSE, claimed deviation and NEES over time, and the sums that they are made from.

        Raises:
            ModuleNotFoundError: without xarray (extra "results").
        """
        return statistics_dataset(self)

    @classmethod
    def from_xarray(cls, dataset: "xr.Dataset") -> "StatisticsByName":
        """Statistics from a dataset that `to_xarray` made.

        Raises:
            ValueError: no such dataset.
        """
        return statistics_from(dataset)

    def to_pandas(self) -> "pd.DataFrame":
        """Table: a row for each node and filter, with claim, runs, RMSE, NEES, their errors, and figures by state.

        Raises:
            ModuleNotFoundError: without pandas (extra "results").
        """
        return statistics_frame(self)

    def apart(self) -> list[str]:
        """Names of the parts that are saved separately."""
        return [] if self.smoothed is None else ["smoothed"]

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
        return plot_statistics(self, node, filters, states, axes)

    def failures(self) -> list[str]:
        """List filters without a valid estimate in some run, a line each, as for a record.

        One line more for each uplink that saturated. Smoothed estimates likewise, after "smoothed".
        """
        lines = [] if self.smoothed is None else [f"smoothed {line}" for line in self.smoothed.failures()]
        for node, filters in self.items():
            lines += [f"{node}/{name}: {filter_.failure}" for name, filter_ in filters.items() if filter_.failed_runs]
            for name, filter_ in filters.items():
                for single, share in (filter_.uplink.saturated_share() if filter_.uplink else {}).items():
                    if share:
                        lines.append(
                            f"{node}/{name}: the quantizer of node {single} saturated in {share:.2%} of samples"
                        )
        return lines
