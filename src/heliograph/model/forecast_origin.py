"""Where a forecast starts: the state of a filter, or of a network's filters, after what arrived last."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Protocol, TypeAlias

import jax
import numpy as np
from typing_extensions import TypeAliasType

from heliograph.model.estimate import Estimate
from heliograph.numerics.times.dates import seconds_between
from heliograph.numerics.types import PyTree

if TYPE_CHECKING:
    from heliograph.model.readings.repeated_readings import Repeats

Moments: TypeAlias = "float | np.datetime64 | np.ndarray"


@dataclass(frozen=True, eq=False, repr=False)
class Origin:
    """The last state of a filter or network, from which forecasts predict; nothing of it is changed by them.

    Args:
        model: the filter, or the network.
        state: its state after the last step: of a network that of all its filters.
        step: number of the first step ahead, from 0.
        inputs: inputs of the last step (inputs,), which a forecast may hold; NaN where there was none.
        time: of the last step, a number or a date.
        spacing: usual time between steps, of dates in seconds; NaN where it is not known.
        estimates: of a network, the last ones by node and filter.
        months: of the calendar between steps, of dates that are firsts of months; 0 of all others.
        repeats: of a network, the runs of equal readings with which rows ended, by node with limits.
        several: whether these are the states of several plants side by side: then the leaves of `state`, `step`,
            `inputs`, `time` and the estimates have a leading axis of plants.
    """

    model: object
    state: PyTree
    step: int | np.ndarray
    inputs: np.ndarray
    time: Moments
    spacing: float = float("nan")
    estimates: Mapping[str, Mapping[str, Estimate]] = field(default_factory=dict)
    months: int = 0
    repeats: "Mapping[str, Repeats]" = field(default_factory=dict)
    several: bool = False

    def has_form_of(self, state: PyTree) -> bool:
        """Return whether this origin's state has the same tree structure as another state, and arrays of its shapes."""
        own_leaves, own_structure = jax.tree.flatten(self.state)
        leaves, structure = jax.tree.flatten(state)
        has_same_structure = str(own_structure) == str(structure)
        return has_same_structure and list(map(np.shape, own_leaves)) == list(map(np.shape, leaves))


KeptOrigin = TypeAliasType("KeptOrigin", Origin | None)  # None where no state was kept


class HasOrigin(Protocol):
    """A result or a live object from which one can forecast."""

    @property
    def origin(self) -> Origin | None:
        """Where a forecast starts; None where no state was kept."""


def last_input(u: np.ndarray) -> np.ndarray:
    """Return the inputs of the last of some rows (steps, inputs); NaN without rows."""
    return np.array(u[-1] if len(u) else np.full(u.shape[1], np.nan), dtype=float)


def find_median_spacing(time: np.ndarray) -> float:
    """Return the median time between rows, in seconds for dates, or NaN for fewer than two rows."""
    if len(time) < 2:
        return float("nan")
    steps = seconds_between(np.asarray(time))[1:]  # from row to row; entry 0 is of the first row and says nothing
    # Equal steps need no sorting.
    return float(steps[0] if steps.min() == steps.max() else np.median(steps))


def find_months_between_rows(time: np.ndarray) -> int:
    """Return how many calendar months lie between rows if all are firsts of months, else 0.

    Months, quarters and years have no fixed length in seconds, so such steps are counted on the calendar.
    """
    clock = np.asarray(time)
    if clock.dtype.kind != "M" or len(clock) < 3:
        return 0
    months = clock.astype("datetime64[M]")
    if (months.astype("datetime64[ns]") != clock.astype("datetime64[ns]")).any():
        return 0
    return max(int(np.median(np.diff(months).astype(int))), 0)
