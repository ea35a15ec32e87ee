"""Levels of which a service publishes the probability that they are passed, as they are typed: level>30, flow<600."""

import re
from typing import NamedTuple

import numpy as np
from typing_extensions import TypeAliasType

import heliograph
from heliograph.model.forecast_origin import HasOrigin
from heliograph.model.markov_jump_models import ModalPlant
from heliograph.model.over_time import first
from heliograph.numerics.check import fail, show_value
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node

DRAWS = 2000  # paths for each probability, whose standard error is then 1.1 % at most
TYPED = re.compile(r"\s*(?P<name>.+?)\s*(?P<sign>[<>])\s*(?P<level>[-+.\deE]+)\s*")


class Threshold(NamedTuple):
    """A level of a state or an output, for whose passing a service publishes the probability.

    Args:
        name: of the state or output.
        level: what is passed.
        above: whether beyond is above it.
    """

    name: str
    level: float
    above: bool

    def __str__(self) -> str:
        """Return the threshold as it is typed: level>30."""
        return f"{self.name}{'>' if self.above else '<'}{self.level:g}"


Thresholds = TypeAliasType("Thresholds", tuple[Threshold, ...])


def parse_threshold(text: str) -> Threshold:
    """Return a threshold from a name, a sign and a number: the level of a state or output, and the side to be on.

    Args:
        text: a name, a sign and a number, as level>30 or flow<600.

    Raises:
        ValueError: the text is not a name, a sign and a number.
    """
    match = TYPED.fullmatch(text) if isinstance(text, str) else None
    try:
        return Threshold(match["name"], float(match["level"]), match["sign"] == ">")  # type: ignore[index]
    except (TypeError, ValueError):
        expected = "a state or output and its level, as level>30 or flow<600"
        raise fail("--threshold", expected, show_value(text)) from None


def check_threshold_names(network: Network, thresholds: Thresholds) -> None:
    """Raise ValueError unless each threshold is of a state of the network or of an output of its sensors.

    Raises:
        ValueError: a threshold is of anything else, or the plant has modes, so that its paths cannot be drawn.
    """
    if thresholds and isinstance(first(network.plant), ModalPlant):
        raise fail("--threshold", "a plant of one law of motion, whose paths can be drawn", "a markov_plant")
    sensors = [first(node.sensor) for node in network.nodes.values() if isinstance(node, Node)]
    known = dict.fromkeys([*network.states, *(output for sensor in sensors for output in sensor.outputs)])
    for threshold in thresholds:
        if threshold.name not in known:
            raise fail("--threshold", f"a state or output: {', '.join(known)}", repr(threshold.name))


def find_crossing_probabilities(
    source: HasOrigin, node_and_filter: tuple[str, str], thresholds: Thresholds, horizons: list[float], whole: bool
) -> dict[str, list[dict[str, float]]]:
    """Return by threshold the probabilities that it is crossed at each horizon, and by then, as they are published.

    DRAWS paths of the future are drawn from the last state, with the last inputs held. A probability is the share of
    these paths, the same ones for all thresholds and horizons. Of each horizon are returned "then" (beyond the
    threshold at that time), "by" (beyond it at any time up to then) and "by_error", the standard error of "by".

    Args:
        source: where the forecast starts: the last state, such as that of a live network.
        node_and_filter: names of the node and its filter.
        thresholds: (name of a state or output, level, whether beyond is above it); at least one.
        horizons: how far ahead, in steps or in the unit of dt.
        whole: whether horizons are steps; every step up to the last is then looked at, else the horizons alone.
    """
    node, filter_name = node_and_filter
    ahead = int(horizons[-1]) if whole else horizons
    # `ahead` as a number asks for every step up to it, as a list for these times alone.
    paths = heliograph.forecasting.draw_paths(source, ahead, "held", DRAWS, node=node, filter=filter_name)
    # Row of each horizon in the paths, which have every step, or the horizons alone.
    rows = [int(horizon) - 1 for horizon in horizons] if whole else range(len(horizons))
    found = dict[str, list[dict[str, float]]]()
    for threshold in thresholds:
        beyond = paths.is_beyond(*threshold)  # (path, row)
        # Share of the paths that are beyond at a row, and that were at any row up to it, with its standard error.
        then = beyond.mean(axis=0)
        by = np.logical_or.accumulate(beyond, axis=1).mean(axis=0)
        error = np.sqrt(by * (1 - by) / DRAWS)
        found[str(threshold)] = [
            {"then": float(then[i]), "by": float(by[i]), "by_error": float(error[i])} for i in rows
        ]
    return found
