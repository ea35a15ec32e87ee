"""The networks: six sensors over one hop or two, a seldom seen state, packets, and a published circuit."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

import heliograph as hg
from heliograph.planning.paths.model import Paths
from heliograph_studies import check_fields

TRANSITION = np.array([[0.95, 0.1, 0.0], [0.0, 0.9, 0.2], [0.0, -0.1, 0.8]])
PROCESS = np.diag([0.1, 0.05, 0.2])
ROWS = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [0, 1, -1], [1, 0, 1]])
NOISES = np.array([0.5, 0.4, 0.3, 0.6, 0.5, 0.8])
NEAR, FAR = np.array([1.2, 0.7, 1.9, 1.0, 1.5, 0.5]), np.array([0.8, 1.6, 0.6, 1.3, 0.9, 1.8])  # lengths of hops
KAPPA = np.array([1.02, 1.05, 1.02, 1.1, 1.02, 1.05])  # E g^2 / (E g)^2 of a single hop
RELAYED_KAPPA = 1.02
NAMES = tuple("abcdef")


@dataclass(frozen=True)
class Setting:
    """What is designed.

    one_hop, two_hops, front: total powers of the six sensors. on: power of the sensor that sends at a step, chosen: of
    those that are chosen once. losses: errors of the packets' filter, times that without losses. rho: noise of the
    whole way over the power, exponent: of the path loss. seeds: of the demonstration's relays, from `seed` on.
    """

    one_hop: tuple[float, ...] = (2.0, 10.0, 50.0)
    two_hops: tuple[float, ...] = (6.0, 30.0)
    front: tuple[float, ...] = (2.0, 4.0, 8.0, 15.0, 30.0, 60.0)
    periods: tuple[int, ...] = (1, 2, 3, 4, 5)
    on: float = 6.0
    chosen: float = 2.0
    losses: tuple[float, ...] = (1.1, 3.0)
    rho: tuple[float, ...] = (1.0, 4.0, 8.0, 20.0, 60.0)
    exponent: float = 3.0
    seeds: int = 5
    seed: int = 0

    def __post_init__(self) -> None:
        power = (np.finfo(float).tiny,)
        check_fields(self, one_hop=power, two_hops=power, front=power, on=power, chosen=power, rho=power)
        check_fields(self, seeds=1, periods=1, losses=(1.0,), exponent=(1.0,))


def gain(kappa: float, length: float) -> hg.Discrete:
    """Two gains of mean length^-3/2 and of this kappa."""
    mean = length**-1.5
    away = mean * np.sqrt(kappa - 1)
    return hg.Discrete([mean - away, mean + away], [0.5, 0.5])


def six(relayed: bool, names: Sequence[str] = NAMES) -> hg.Network:
    """Three states, and these of the six sensors, received directly or each through a relay of its own."""
    nodes = {}
    for i, name in enumerate(NAMES):
        hops = [hg.hop(gain(RELAYED_KAPPA if relayed else KAPPA[i], NEAR[i]), 1.0)]
        if relayed:
            hops.append(hg.hop(gain(RELAYED_KAPPA, FAR[i]), 1.0))
        sensor = hg.LinearSensor(ROWS[i : i + 1], NOISES[i])
        nodes[name] = hg.Node(sensor, hg.amplify_and_forward(hops), {})
    plant = hg.LinearPlant(TRANSITION, PROCESS, np.zeros(3), np.eye(3))
    return hg.Network(plant, {name: nodes[name] for name in names})


def slow_state() -> Paths:
    """A state that hardly moves, received over two hops without fading."""
    return hg.planning.independent_paths([[0.99]], [[0.02]], [[1.0]], [0.2], 1.0, [[2.0, 2.0]])
