"""Doubts about estimates at the edge of what is possible: where no sensor shows a state any more, or at its limit."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.filters.gaussian.moment_transforms import AbstractTransform, Linearization
from heliograph.filters.wrappers.state_limits import LimitedFilter
from heliograph.model.markov_jump_models import ModalPlant, ModalSensor
from heliograph.model.over_time import first
from heliograph.model.plant import AbstractPlant
from heliograph.model.sensor import AbstractSensor, AnySensor, is_linear
from heliograph.numerics.check import instance
from heliograph.numerics.types import Bool, Float
from heliograph.simulation.description.observability import list_sensors, make_observability_matrix, simulate_outputs
from heliograph.simulation.network import FUSED, Network
from heliograph.simulation.node import Node
from heliograph.simulation.results.record import Record

LAST = 10  # rows: in the last one and in the one so many before it no sensor shows the state
MOST = 0.5  # share of the rows, beyond which it is worth a word that an estimate lies at a limit
HELD = float(np.sqrt(2 / (np.pi - 2)))  # mean over deviation of a Gaussian of mean 0 that is known to be positive
CLOSE = 1e-3  # relative, of that: a mean that is 0.007 deviations inside its limit
APART = 10.0  # deviations between two limits, from which the other one changes nothing


def doubt_estimates(network: Network, record: Record) -> tuple[str, ...]:
    """Return a line for each estimate that ends with states no sensor shows, or that lies at a limit in most rows.

    Args:
        network: the network.
        record: what `run` of this network returned, over one recording.

    Raises:
        ValueError: no network, no record.
    """
    instance("network", network, Network, "a Network")
    instance("record", record, Record, "a Record")
    return *_doubt_unseen_states(network, record), *_doubt_states_at_limits(network, record)


def _doubt_unseen_states(network: Network, record: Record) -> Iterator[str]:
    """Yield a line for each filter that ends where no sensor shows a state that one showed at the start.

    A state is shown where an output within n steps depends on it, at the estimate: by the sensors' tangents, or by
    their values within the filter's deviations (`_FilterView`). Where none does, as beyond the end of a table, what
    arrives says nothing of where the state is, and the estimate cannot return. Not judged: states with limits, which
    bring an estimate back; particles and mixtures; models that vary over time or have modes; estimates that are no
    numbers.
    """
    plant = network.plant
    if not isinstance(plant, AbstractPlant) or isinstance(plant, ModalPlant):
        return
    limited = {name for name, _ in plant.limits}
    for node, label, filter, sensors in _yield_filters_with_covariance(network):
        # A filter of one Gaussian, of a nonlinear sensor and of models that do not vary.
        transform = getattr(filter, "transform", None)
        if not isinstance(transform, AbstractTransform):
            continue
        varies = any(first(sensor) is not sensor or isinstance(sensor, ModalSensor) for sensor in sensors)
        if varies or all(is_linear(plant, sensor) for sensor in sensors):
            continue
        estimate = record.estimates[node][label]
        means, covariances = np.asarray(estimate.mean), np.asarray(estimate.covariance)
        # Judged are the last row and the one LAST rows before it, where estimates have to be numbers.
        if len(means) <= LAST or not np.all(np.isfinite(means[[-1 - LAST, -1]])):
            continue
        view = _FilterView(plant, [first(sensor) for sensor in sensors], isinstance(transform, Linearization))
        for i in np.flatnonzero(_find_unseen_states(view, means, covariances)):
            name = network.states[i]
            if name not in limited:
                yield (
                    f"{node}/{label}: {name!r} ends at {means[-1, i]:.4g}, where no sensor shows it, as beyond the end "
                    "of a table: what arrives does not move it. If it cannot be there, limits= of the plant say so"
                )


def _find_unseen_states(
    view: "_FilterView", means: Float[np.ndarray, "time n"], covariances: Float[np.ndarray, "time n n"]
) -> Bool[np.ndarray, " n"]:
    """Return which states the outputs show at the start, but neither at the last estimate nor LAST rows earlier.

    `view`: how a filter sees plant and sensors. What it shows depends on the estimate if these are not linear.
    """
    plant = view.plant
    initial = np.asarray(plant.initial_mean), np.asarray(plant.initial_covariance)
    last = means[-1], covariances[-1]
    earlier = means[-1 - LAST], covariances[-1 - LAST]
    # Look over one step first. It is cheap, and settles most recordings: few states are lost from sight.
    if not np.any(view.find_shown(*initial, steps=1) & ~view.find_shown(*last, steps=1)):
        return np.zeros(len(plant.states), dtype=bool)
    steps = len(plant.states)
    unseen = view.find_shown(*initial, steps) & ~view.find_shown(*last, steps) & ~view.find_shown(*earlier, steps)
    return np.asarray(unseen)


def _doubt_states_at_limits(network: Network, record: Record) -> Iterator[str]:
    """Yield a line for each state with limits whose estimate lies at one of them in most rows.

    Such an estimate says that the data pull the state out of its range, so that sensor, plant or limit may be wrong.
    The filter's Gaussian N(m, s^2) is cut off at the limits, and its estimate is the mean and the deviation of the cut
    Gaussian. If m lies at a limit, a half Gaussian remains, of mean sqrt(2 / pi) s from the limit and deviation
    sqrt(1 - 2 / pi) s. Their ratio is HELD; it is larger if m lies further inside. The ratio is exact for one limited
    state; with several limited states it holds nearly (up to the share CLOSE). Limits nearer to each other than APART
    deviations are not judged, since both cut.
    """
    for node, label, filter, _ in _yield_filters_with_covariance(network):
        if not isinstance(filter, LimitedFilter):
            continue
        estimate = record.estimates[node][label]
        for state, *limits in filter.limits:
            mean = np.asarray(estimate.mean)[:, state]
            deviation = np.sqrt(np.maximum(np.asarray(estimate.covariance)[:, state, state], 0.0))
            # At the limit: |mean - limit| / deviation of the cut Gaussian is at most the ratio of a half Gaussian.
            for limit in (end for end in limits if np.isfinite(end)):
                is_at_limit = (np.abs(mean - limit) <= HELD * (1 + CLOSE) * deviation) & (deviation > 0)
                is_at_limit &= np.ptp(limits) > APART * deviation
                rows = np.count_nonzero(is_at_limit)
                if rows > MOST * len(mean):
                    yield (
                        f"{node}/{label}: {network.states[state]!r} is held at its limit {limit:g} in "
                        f"{rows} of {len(mean)} rows, as where what arrives puts it beyond: if it is "
                        "not there, a sensor, the plant or the limit is off"
                    )


def _yield_filters_with_covariance(network: Network) -> Iterator[tuple[str, str, AbstractFilter, Sequence[AnySensor]]]:
    """Yield (node, name, filter, sensors whose signals it receives) for every filter that claims a covariance.

    A node behind relays, and a filter of all nodes' measurements (under FUSED in place of a node), receive signals of
    all sensors.
    """
    all_sensors = list_sensors(network)
    for name, node in network.nodes.items():
        sensors = [node.sensor] if isinstance(node, Node) else all_sensors  # others hear what several nodes send
        yield from ((name, label, filter, sensors) for label, filter in node.filters.items() if filter.claim != "none")
    for label, fusion in network.fused.items():
        if isinstance(fusion, AbstractFilter) and fusion.claim != "none":
            yield FUSED, label, fusion, all_sensors


class _FilterView(NamedTuple):
    """What a filter sees of its state: by the tangent of the sensors, or by their outputs beside its mean.

    Args:
        plant: the plant.
        sensors: the sensors that the filter hears, which do not vary.
        tangent: whether it takes the tangent at its mean.
    """

    plant: AbstractPlant
    sensors: Sequence[AbstractSensor]
    tangent: bool

    def find_shown(
        self, mean: Float[np.ndarray, " n"], covariance: Float[np.ndarray, "n n"], steps: int
    ) -> Bool[np.ndarray, " n"]:
        """Return which states change an output within some steps, for a filter with this mean and covariance.

        A filter that linearises (`self.tangent` is True) sees a state if its column of the observability matrix is not
        zero. A filter that takes points also sees a state if outputs differ between mean + sqrt(n) deviations and mean
        - sqrt(n) deviations of it. `Cubature` has its points there if states are not correlated.
        """
        by_tangent = np.any(make_observability_matrix(self.plant, self.sensors, mean, steps) != 0, axis=0)
        if self.tangent or np.all(by_tangent):
            return np.asarray(by_tangent)
        steps_of_points = np.sqrt(len(mean) * np.maximum(np.diagonal(covariance), 0.0))
        ahead = simulate_outputs(self.plant, self.sensors, mean + np.diag(steps_of_points), steps)
        behind = simulate_outputs(self.plant, self.sensors, mean - np.diag(steps_of_points), steps)
        return np.asarray(by_tangent | np.any(ahead != behind, axis=1))
