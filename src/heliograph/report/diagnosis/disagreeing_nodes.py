"""Nodes that disagree by a constant: the error of one sensor, where each node only filters by itself."""

import numpy as np
from scipy.special import ndtri

import heliograph
from heliograph.filters.base import AbstractFilter
from heliograph.model.augmented.joint_sensors import join_links
from heliograph.model.over_time import OverTime
from heliograph.model.plant import LinearPlant
from heliograph.model.sensor import LinearSensor
from heliograph.model.trigger import Periodic
from heliograph.numerics.check import InputError
from heliograph.report.diagnosis.constant_sensor_error import MOST, ConstantError, find_constant_error
from heliograph.report.diagnosis.sensor_output_health import weighs
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node
from heliograph.simulation.results.record import Record

LEAST = 0.2  # of an innovation's deviation: an error of less is not worth a warning


def find_constant_error_between_nodes(
    network: Network, record: Record, inputs: np.ndarray, level: float
) -> ConstantError | None:
    """Return the constant error of one output that explains why nodes disagree; None where there is none.

    A node that filters by itself takes its sensor's constant error for the state, and its innovations show nothing. So
    a filter of all nodes' measurements is made, and its innovations judged as those of a centre are. The error has to
    be significant twice: by the stated noises, and by the spread over the rows, which holds also where noises are
    stated wrong or remember.

    Args:
        network: the network.
        record: the recording that was run through it.
        inputs: inputs of the plant (time, inputs).
        level: probability with which a network without such an error may be doubted by chance.
    """
    # Nodes whose measurements can be joined; a network with a central filter is judged by that filter.
    nodes = {name: node for name, node in network.nodes.items() if isinstance(node, Node) and _can_be_joined(node)}
    names = [f"{name}: {output}" for name, node in nodes.items() for output in node.received_names]
    has_centre = any(isinstance(fusion, AbstractFilter) for fusion in network.fused.values())
    if len(nodes) < 2 or len(names) > MOST or has_centre:  # MOST: outputs of which each is tried
        return None
    # Filter of all nodes' measurements (time, all outputs).
    joint = _make_joint_filter(network, nodes)
    if joint is None:
        return None
    z = np.concatenate([record.measurements[name] for name in nodes], axis=1)
    # `size`: the error over the usual deviation of the output's innovations; below LEAST (0.2) it is not worth a word.
    found = find_constant_error(names, joint, z, inputs)
    if found is None or found.size < LEAST:
        return None
    # The error in standard errors, by the worse of both tests. The level is shared by all outputs and both signs
    # (Bonferroni).
    deviations = min(found.significance, abs(found.error) / found.standard_error)
    return found if deviations > -ndtri(level / (2 * len(names))) else None


def _make_joint_filter(network: Network, nodes: dict[str, Node]) -> AbstractFilter | None:
    """Return a filter of what all these nodes receive, or None if no such filter can be made for their links.

    The sensors are stacked, and the links joined into one channel behind them, which delivers all numbers at once. The
    filter is linear if plant and sensors are, else a cubature filter.
    """
    # Lost numbers are NaN in the data, so the links only need to say how numbers that arrive are changed.
    links = [node.channel.condition_on_arrival() for node in nodes.values() if not isinstance(node.channel, OverTime)]
    sensor, channel = join_links({name: node.sensor for name, node in nodes.items()}, links)
    is_linear = isinstance(network.plant, LinearPlant) and isinstance(sensor, LinearSensor)
    make_filter = heliograph.linear_filter if is_linear else heliograph.cubature_filter
    try:
        return make_filter(network.plant, sensor, channel)
    except InputError:
        return None


def _can_be_joined(node: Node) -> bool:
    """Return whether a filter of several nodes can take this one in.

    Its sensor and link must not change over time. Messages must come whenever they are due, and without an encoder. A
    filter of the node must claim a covariance, and no such filter may weigh values by how likely they are. A `Periodic`
    trigger sends at fixed steps.
    """
    is_constant = not isinstance(node.sensor, OverTime) and not isinstance(node.channel, OverTime)
    sends_when_due = node.trigger is None or isinstance(node.trigger, Periodic)
    filters = [filter for filter in node.filters.values() if filter.received and filter.claim != "none"]
    if not filters or any(weighs(filter) for filter in filters):
        return False
    return is_constant and sends_when_due and node.encoder is None
