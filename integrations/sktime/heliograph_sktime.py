"""A filter of heliograph as a transformer of sktime: series of measurements in, estimated states out."""

from collections.abc import Callable
from typing import Any, ClassVar

import jax
import numpy as np
from sktime.transformations.base import BaseTransformer

import heliograph as hg

BLOCK = 1024  # series in memory side by side, with their filters' states


class FilterTransformer(BaseTransformer):
    """Estimate the states behind each series: means after each row, and with `deviations` their claimed deviations.

    Nothing is fitted: the filter has its model, which `hg.fit` learns. Series are filtered side by side in blocks, so
    that memory beyond the panel and its estimates does not grow with their number. NaN did not arrive.

    Parameters
    ----------
    filter : filter of heliograph
        As `hg.kalman_filter(plant, sensor)`; without inputs. A random walk seen through noise unless given.
    deviations : bool
        Whether the standard deviations that the filter claims follow the means, in further columns.

    Examples
    --------
    >>> import numpy as np
    >>> from heliograph_sktime import FilterTransformer
    >>> panel = np.zeros((3, 1, 20))  # series, columns, time
    >>> FilterTransformer(deviations=True).fit_transform(panel).shape
    (3, 2, 20)
    """

    _tags: ClassVar[dict[str, Any]] = {
        "authors": ["heliograph"],
        "scitype:transform-input": "Series",
        "scitype:transform-output": "Series",
        "scitype:instancewise": True,
        "X_inner_mtype": "numpy3D",
        "y_inner_mtype": "None",
        "capability:multivariate": False,
        "capability:missing_values": True,
        "capability:unequal_length": False,
        "transform-returns-same-time-index": True,
        "fit_is_empty": True,
        "python_dependencies": ["heliograph"],
    }

    def __init__(self, filter: Any = None, deviations: bool = False) -> None:
        self.filter = filter
        self.deviations = deviations
        super().__init__()
        if filter is not None and filter.received > 1:
            self.set_tags(**{"capability:multivariate": True})

    def _transform(self, X: np.ndarray, y: object = None) -> np.ndarray:
        """Filter a panel (series, columns, time); return the states (series, states, time)."""
        chosen = _make_random_walk() if self.filter is None else self.filter
        if chosen.received != X.shape[1]:
            raise ValueError(f"X: expected {chosen.received} columns, as the filter receives, got {X.shape[1]}")
        follow = _make_follower(chosen, self.deviations)
        states = len(chosen.estimate(chosen.init()).mean) * (1 + self.deviations)
        found = np.empty((len(X), states, X.shape[2]))
        for begin in range(0, len(X), BLOCK):
            z = np.moveaxis(np.asarray(X[begin : begin + BLOCK], dtype=np.float64), 1, 2)
            found[begin : begin + BLOCK] = np.moveaxis(np.asarray(hg.simulation.over_runs(follow, z)), 2, 1)
        return found

    @classmethod
    def get_test_params(cls, parameter_set: str = "default") -> list[dict[str, Any]]:
        """Return two settings by which sktime checks this class."""
        plant = hg.LinearPlant([[1.0, 1.0], [0.0, 1.0]], 0.01 * np.eye(2), [0.0, 0.0], np.eye(2))
        trend = hg.kalman_filter(plant, hg.LinearSensor([[1.0, 0.0]], 0.1))
        return [{}, {"filter": trend, "deviations": True}]


def _make_random_walk() -> Any:
    """Return the filter of a level that moves as a random walk, ten times as slow as its noise is large."""
    plant = hg.LinearPlant([[1.0]], 0.01, [0.0], 100.0)
    return hg.kalman_filter(plant, hg.LinearSensor([[1.0]], 1.0))


def _make_follower(chosen: Any, deviations: bool) -> Callable[[jax.Array], jax.Array]:
    """Return the function of one series (time, columns) to its states (time, states)."""

    def follow(rows: jax.Array) -> jax.Array:
        def step(state: Any, row: jax.Array) -> tuple[Any, jax.Array]:
            state, estimate = chosen.step(state, row)
            if not deviations:
                return state, estimate.mean
            variances = jax.numpy.diagonal(estimate.covariance)
            return state, jax.numpy.concatenate([estimate.mean, jax.numpy.sqrt(variances)])

        return jax.lax.scan(step, chosen.init(), rows)[1]

    return follow
