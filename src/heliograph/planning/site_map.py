"""The error over places: the same powers, sent from a relay or a sensor that stands elsewhere."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from heliograph.numerics.check import array, fail, function, instance
from heliograph.numerics.readable import readable
from heliograph.numerics.types import Float
from heliograph.planning.outcome import NetworkDesign
from heliograph.planning.task import Task
from heliograph.simulation.network import Network

STARTS = 8  # of the descents at each place


@readable
class SiteMap(NamedTuple):
    """Errors (len(y), len(x)) at places, and the best of them."""

    x: Float[np.ndarray, "columns"]
    y: Float[np.ndarray, "rows"]
    errors: Float[np.ndarray, "rows columns"]

    @property
    def best(self) -> tuple[float, float, float]:
        """x, y and error of the best place."""
        row, column = np.unravel_index(np.argmin(self.errors), self.errors.shape)
        return float(self.x[column]), float(self.y[row]), float(self.errors[row, column])


def error_over_sites(
    build: Callable[[float, float], Network],
    task: Task,
    found: NetworkDesign,
    x: Float[np.ndarray, "columns"],
    y: Float[np.ndarray, "rows"],
    advance: Callable[[str], None] = lambda what: None,
) -> SiteMap:
    """The least error at the design's total power with `build(x, y)` in place of the network, at every place.

    Raises:
        ValueError: a function that builds no network, what `design` refuses.
    """
    function("network of a map", build, "x and y")
    instance("task", task, Task, "a Task")
    instance("design", found, NetworkDesign, "a NetworkDesign")
    x, y = array("x of a map", x, (None,)), array("y of a map", y, (None,))
    errors = np.zeros((len(y), len(x)))
    asked = replace(task.at(found.total), starts=min(task.starts, STARTS))
    for row, north in enumerate(y):
        advance(f"the map at y = {north:.4g}")
        for column, east in enumerate(x):
            network = build(float(east), float(north))
            if not isinstance(network, Network):
                raise fail("map", "a function of x and y that returns a Network", type(network).__name__)
            errors[row, column] = asked.solve(network).error
    return SiteMap(np.asarray(x), np.asarray(y), errors)
