"""Doubts about angles and attitudes that are known no better than a good part of a turn, and about degrees."""

from collections.abc import Iterator, Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.filters.gaussian.gaussian import GaussianFilter
from heliograph.filters.gaussian.moment_transforms import Cubature
from heliograph.filters.gaussian.unscented import Unscented
from heliograph.model.over_time import first
from heliograph.model.sensor import is_linear
from heliograph.numerics.angles.angle import TURN
from heliograph.numerics.check import fail, instance, show_value
from heliograph.numerics.module import readable
from heliograph.numerics.types import Float
from heliograph.simulation.description.observability import list_sensors
from heliograph.simulation.network import FUSED, Network
from heliograph.simulation.results.record import Record

WIDE = 1.0  # rad: a Gaussian of this deviation has E cos = 0.61, and what lies beyond pi is not on the circle any more
# rad: a body that is turned by so much about each axis. Two directions measured to 0.05 leave the errors of an extended
# filter 12, of a cubature filter 7 times the variance that they claim, after one row; one direction 4 and 3 for ever.
WIDE_ATTITUDE = 0.5
REMEDY = "on the circle that is no Gaussian any more: start from an angle that data show"
REMEDY_OF_ATTITUDE = "turns so wide are no Gaussian about one attitude any more: start from one that data show"


def find_largest_usable_deviation(filter: AbstractFilter) -> float:
    """Return the largest standard deviation of an angle, in radians, at which a filter can treat the angle as Gaussian.

    It is WIDE (1 rad) at most. A cubature or unscented filter has points at sqrt(c) deviations from the mean, with c =
    n (the number of states) or alpha^2 (n + kappa). These must stay within half a turn, since a point beyond it counts
    as one on the other side.
    """
    inner = getattr(filter, "base", filter)
    transform, n = getattr(inner, "transform", None), len(filter.states)
    if isinstance(inner, GaussianFilter) and is_linear(inner.plant, inner.sensor):  # no points are drawn
        return WIDE
    if isinstance(transform, Cubature):
        return min(WIDE, float(np.pi / n**0.5))
    if isinstance(transform, Unscented):
        alpha, kappa = float(transform.alpha), float(transform.kappa)
        return min(WIDE, float(np.pi / (alpha * (n + kappa) ** 0.5)))
    return WIDE


class _Direction(NamedTuple):
    """An angle, or the three axes of an attitude: its states, the largest usable deviation (rad), what to do beyond."""

    states: tuple[int, ...]
    usable: float
    remedy: str


def _list_directions(filter: AbstractFilter) -> list[_Direction]:
    """Return the angles and attitudes among a filter's states, with the deviation at which the filter can use each.

    There is none where the filter claims no covariance, or does not say which states are angles.
    """
    used = filter.angles_used()
    if used is None or filter.claim == "none":
        return []
    angles = [_Direction((i,), find_largest_usable_deviation(filter), REMEDY) for i in used.states]
    axes = tuple(filter.attitude)
    bodies = [axes[i : i + 3] for i in range(0, len(axes), 3)]
    return angles + [_Direction(body, WIDE_ATTITUDE, REMEDY_OF_ATTITUDE) for body in bodies]


def _find_wide(direction: _Direction, deviation: Float[np.ndarray, "rows n"]) -> tuple[np.ndarray, list[int]]:
    """Return the rows in which an angle, or an axis of an attitude, is too wide, and the states that are in some row.

    `deviation`: standard deviations of all states in each row.
    """
    wide = deviation[:, direction.states] > direction.usable
    which = np.flatnonzero(wide.any(axis=0))
    return np.flatnonzero(wide.any(axis=1)), [direction.states[i] for i in which]


def _join_names(states: Sequence[int], names: Sequence[str]) -> str:
    """Return the names of states in quotes, with commas."""
    return ", ".join(repr(names[i]) for i in states)


def doubt_wide_angles_at_start(network: Network) -> Iterator[str]:
    """Yield a line for each angle, and each attitude, that starts wider than the filter can use.

    The deviation is that of the filter before any data. Nodes whose filters of one name start alike share a line.
    """
    nodes_by_angle: dict[tuple[str, str, float, str], list[str]] = {}
    for node, label, filter in _yield_filters_with_angles(network):
        deviation = _find_deviations(np.asarray(filter.estimate(filter.init()).covariance)[None])
        for direction in _list_directions(filter):
            rows, states = _find_wide(direction, deviation)
            if rows.size:
                largest = float(deviation[0, states].max())
                key = _join_names(states, network.states), label, largest, direction.remedy
                nodes_by_angle.setdefault(key, []).append(node)
    for (names, label, deviation_at_start, remedy), nodes in nodes_by_angle.items():
        first_nodes = ", ".join(map(repr, nodes[:3])) + (", ..." if len(nodes) > 3 else "")
        known = f"{names} known to +- {deviation_at_start:.2g} rad"
        yield f"wide angle: {label!r} of {first_nodes} starts with {known}; {remedy}"


def doubt_wide_angles_in_rows(network: Network, record: Record) -> Iterator[str]:
    """Yield a line for each filter and angle, or attitude, that was too wide in some row for the filter.

    `record`: estimates of a recording. A row is too wide where the claimed deviation is above the largest at which the
    filter can take the angle for Gaussian.
    """
    for node, label, filter in _yield_filters_with_angles(network):
        deviation = _find_deviations(np.asarray(record.estimates[node][label].covariance))
        for direction in _list_directions(filter):
            wide, states = _find_wide(direction, deviation)
            if wide.size:
                finding = _describe_width(states, network.states, deviation[:, states].max())
                rows = f"in {wide.size} of {len(deviation)} rows, first in row {wide[0] + 1}"
                yield f"{node}/{label}: {finding} {rows}; {direction.remedy}"


def _describe_width(states: Sequence[int], names: Sequence[str], deviation: float) -> str:
    """Return in words how well an angle is known, or those axes of an attitude."""
    return f"{_join_names(states, names)} {'is' if len(states) == 1 else 'are'} known to +- {deviation:.2g} rad"


def _find_deviations(covariance: Float[np.ndarray, "rows n n"]) -> Float[np.ndarray, "rows n"]:
    """Return the standard deviations of all states in each row, 0 where a variance is none."""
    variances = np.diagonal(np.nan_to_num(covariance), axis1=-2, axis2=-1)
    return np.asarray(np.sqrt(np.maximum(variances, 0.0)))


@readable
class WideAngles:
    """Watch a filter's variances, in rows of an array, for angles and attitudes known less well than it can use.

    Each is said once, an attitude with all its axes, and so is each received angle beyond a full turn, as degrees are.
    `states` and `received` are the names of those that are watched, by their places.

    Args:
        filter: the filter.
        names: of the numbers that it receives; by default measurement[0], measurement[1], ...

    Raises:
        ValueError: no filter, names of another number.
    """

    def __init__(self, filter: AbstractFilter, names: Sequence[str] = ()):
        """Name the angles among the filter's states and received numbers; find the largest deviation it can use.

        `names`: names of the received numbers for the lines, by default measurement[0] and so on.
        """
        instance("filter", filter, AbstractFilter, "a filter")
        self._names = filter.states
        # Angles and attitudes among the states that were not yet too wide, each with its largest usable deviation.
        self._directions = _list_directions(filter)
        self.states = {i: filter.states[i] for direction in self._directions for i in direction.states}
        # Angles among the received numbers, by index.
        angles = None if filter.claim == "none" else filter.angles_used()
        if not isinstance(names, Sequence) or len(names) not in (0, filter.received):
            raise fail("names", f"those of {filter.received} received numbers", show_value(names))
        names = list(names) or [f"measurement[{i}]" for i in range(filter.received)]
        self.received = {} if angles is None else {i: names[i] for i in angles.received}

    def doubt_unit(self, values: Float[np.ndarray, "rows m"]) -> list[tuple[int, str]]:
        """Return a row and a line for each received angle that first goes beyond a full turn (TURN) in these values.

        `self.received`: {component: name} of the angles without such a line so far. An angle with a line is taken out.
        """
        doubts = []
        for i in list(self.received):
            rows_beyond = np.flatnonzero(np.abs(values[:, i]) > TURN)
            if rows_beyond.size:
                doubts.append((int(rows_beyond[0]), doubt_degrees(self.received.pop(i), values[rows_beyond[0], i])))
        return doubts

    def said_of(self, variances: Float[np.ndarray, "rows n"]) -> list[tuple[int, str]]:
        """Return a row and a line for each angle or attitude that first is wider than the filter can use in these rows.

        `self.states`: {state number: name} of those without such a line so far. What has a line is taken out.
        """
        doubts, deviation = [], np.sqrt(np.maximum(np.nan_to_num(variances), 0.0))
        for direction in list(self._directions):
            rows, _ = _find_wide(direction, deviation)
            if rows.size:
                row = int(rows[0])
                _, states = _find_wide(direction, deviation[[row]])
                finding = _describe_width(states, self._names, deviation[row, states].max())
                doubts.append((row, f"{finding}; {direction.remedy}"))
                self._directions.remove(direction)
        self.states = {i: self._names[i] for direction in self._directions for i in direction.states}
        return doubts


def _yield_filters_with_angles(network: Network) -> Iterator[tuple[str, str, AbstractFilter]]:
    """Yield (node, name, filter) of each filter that has angles or attitudes among its states.

    Filters of all nodes' measurements come last, under FUSED in place of a node.
    """
    plant = first(network.plant)
    if not plant.circular and not plant.attitude:
        return
    for node, network_node in network.nodes.items():
        yield from ((node, label, filter) for label, filter in network_node.filters.items() if filter.angles_used())
    for label, fusion in network.fused.items():
        if isinstance(fusion, AbstractFilter) and fusion.angles_used():
            yield FUSED, label, fusion


def doubt_degrees_at_start(network: Network) -> Iterator[str]:
    """Yield a line for each angle that a model has beyond a full turn before any data, as degrees are.

    Angles are in radians here, so an angle of 90 was probably meant in degrees. Looked at are the initial means of
    states, the limits of nodes, and what sensors measure at the initial mean with inputs of 1.
    """
    plant = first(network.plant)
    start, u = np.asarray(plant.initial_mean, dtype=float), np.ones(len(plant.inputs))
    # Initial means.
    for i in plant.angles:
        if line := doubt_degrees(plant.states[i], start[i]):
            yield f"degrees: the initial mean of {line}"
    # The larger limit of each angle that a node receives.
    for name, angles in network.angles.items():
        node, limits = network.nodes[name], network.nodes[name].limits
        if limits is None:
            continue
        for i in angles:
            ends = [float(end[i]) for end in (limits.low, limits.high) if np.isfinite(end[i])]
            if line := doubt_degrees(node.received_names[i], max(ends, key=abs, default=0.0)):
                yield f"degrees: a limit at node {name!r} of {line}"
    # Angles that sensors measure.
    for sensor in list_sensors(network):
        if sensor.angles:
            with jax.enable_x64(True):
                measured = np.asarray(sensor.under(plant.inputs, u).measure(jnp.asarray(start)))
            for i in sensor.angles:
                if line := doubt_degrees(sensor.outputs[i], measured[i]):
                    yield f"degrees: what a sensor measures at the initial mean of {line}"


def doubt_degrees(name: str, value: float) -> str:
    """Return a line that this value of the angle `name` is beyond a full turn; "" where it is not."""
    return f"{name!r}, an angle in radians, is {value:.4g}, beyond 2 pi: degrees?" if abs(value) > TURN else ""


def doubt_angles_beyond_a_turn(network: Network, z: dict[str, Float[np.ndarray, "steps m"]]) -> Iterator[str]:
    """Yield a line for each measured angle with values beyond a full turn (TURN, 2 pi): they may be degrees.

    `z`: measurements by node, NaN where nothing arrived. The line says how many values of the angle are beyond a turn,
    and the first.
    """
    for name, angles in network.angles.items():
        names = network.nodes[name].received_names if angles else ()
        for i in angles:
            is_beyond = np.abs(z[name][:, i]) > TURN
            if np.any(is_beyond):
                row = int(np.argmax(is_beyond))
                received = np.count_nonzero(~np.isnan(z[name][:, i]))
                beyond = f"{np.count_nonzero(is_beyond)} of {received} values are beyond 2 pi"
                value = f"row {row + 1}: {z[name][row, i]:.4g}"
                yield f"node {name!r}: {names[i]!r} is an angle in radians, and {beyond}; {value}: degrees?"
