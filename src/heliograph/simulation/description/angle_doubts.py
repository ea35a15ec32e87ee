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


class _Usable(NamedTuple):
    """Largest deviation (rad) of an angle or attitude at which a filter can use it, and what to do beyond it."""

    deviation: float
    remedy: str


def _list_usable_deviations(filter: AbstractFilter) -> dict[int, _Usable]:
    """Return by its place each state of a filter that is an angle or part of an attitude, and what the filter can use.

    There is none where the filter claims no covariance, or does not say which states are angles.
    """
    used = filter.angles_used()
    if used is None or filter.claim == "none":
        return {}
    angle = _Usable(find_largest_usable_deviation(filter), REMEDY) if used.states else None
    attitude = _Usable(WIDE_ATTITUDE, REMEDY_OF_ATTITUDE)
    return {**({i: angle for i in used.states} if angle else {}), **{i: attitude for i in filter.attitude}}


def doubt_wide_angles_at_start(network: Network) -> Iterator[str]:
    """Yield a line for each angle, and each axis of an attitude, that starts wider than the filter can use."""
    nodes_by_angle: dict[tuple[str, str, float, str], list[str]] = {}
    for node, label, filter in _yield_filters_with_angles(network):
        covariance = np.asarray(filter.estimate(filter.init()).covariance)
        for name, deviation, usable in _yield_deviations(network, filter, covariance):
            if deviation > usable.deviation:
                nodes_by_angle.setdefault((name, label, float(deviation), usable.remedy), []).append(node)
    for (name, label, deviation_at_start, remedy), nodes in nodes_by_angle.items():
        first_nodes = ", ".join(map(repr, nodes[:3])) + (", ..." if len(nodes) > 3 else "")
        known = f"{name!r} known to +- {deviation_at_start:.2g} rad"
        yield f"wide angle: {label!r} of {first_nodes} starts with {known}; {remedy}"


def doubt_wide_angles_in_rows(network: Network, record: Record) -> Iterator[str]:
    """Yield a line for each filter and angle, or axis of an attitude, that was too wide in some row for the filter."""
    for node, label, filter in _yield_filters_with_angles(network):
        covariance = np.asarray(record.estimates[node][label].covariance)
        for name, deviation, usable in _yield_deviations(network, filter, covariance):
            wide = np.flatnonzero(deviation > usable.deviation)
            if wide.size:
                finding = f"{name!r} is known to +- {deviation[wide].max():.2g} rad"
                rows = f"in {wide.size} of {len(deviation)} rows, first in row {wide[0] + 1}"
                yield f"{node}/{label}: {finding} {rows}; {usable.remedy}"


@readable
class WideAngles:
    """Watch a filter's variances, in rows of an array, for angles and attitudes known less well than it can use.

    Each angle is said once, and each received one that is beyond a full turn, as degrees are. `states` and `received`
    are the names of those that are watched, by their places.

    Args:
        filter: the filter.
        names: of the numbers that it receives; by default measurement[0], measurement[1], ...

    Raises:
        ValueError: no filter, names of another number.
    """

    def __init__(self, filter: AbstractFilter, names: Sequence[str] = ()):
        """Name the angles among the filter's states and received numbers; find the largest deviation it can use."""
        instance("filter", filter, AbstractFilter, "a filter")
        angles = None if filter.claim == "none" else filter.angles_used()
        self._usable = _list_usable_deviations(filter)
        self.states = {i: filter.states[i] for i in self._usable}
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
        """Return a row and a line for each angle whose variance first exceeds what the filter can use in these rows.

        `self.states`: {state number: name} of the angles without such a line so far. An angle with a line is taken out.
        """
        doubts = []
        for i in list(self.states):
            usable = self._usable[i]
            rows_of_wide = np.flatnonzero(variances[:, i] > usable.deviation**2)
            if rows_of_wide.size:
                finding = f"{self.states.pop(i)!r} is known to +- {variances[rows_of_wide[0], i] ** 0.5:.2g} rad"
                doubts.append((int(rows_of_wide[0]), f"{finding}; {usable.remedy}"))
        return doubts


def _yield_filters_with_angles(network: Network) -> Iterator[tuple[str, str, AbstractFilter]]:
    """Yield (node, name, filter) of each filter that has angles or attitudes; the node of central ones is FUSED."""
    plant = first(network.plant)
    if not plant.circular and not plant.attitude:
        return
    for node, network_node in network.nodes.items():
        yield from ((node, label, filter) for label, filter in network_node.filters.items() if filter.angles_used())
    for label, fusion in network.fused.items():
        if isinstance(fusion, AbstractFilter) and fusion.angles_used():
            yield FUSED, label, fusion


def _yield_deviations(
    network: Network, filter: AbstractFilter, covariance: Float[np.ndarray, "*steps n n"]
) -> Iterator[tuple[str, Float[np.ndarray, "*steps"], _Usable]]:
    """Yield the name of each angle or axis of an attitude, its standard deviation (rad), and what the filter can use.

    `covariance` is that which the filter claims.
    """
    for i, usable in _list_usable_deviations(filter).items():
        yield network.states[i], np.sqrt(np.maximum(np.nan_to_num(covariance[..., i, i]), 0.0)), usable


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
    """Yield a line for each measured angle with values beyond a full turn (TURN, 2 pi): they may be degrees."""
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
