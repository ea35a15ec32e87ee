"""The example of six sensors over one hop or two that the tests of designs share."""

import numpy as np

import heliograph as hg
from heliograph.planning import Error
from heliograph.planning.multihop_paths import make_power_task
from heliograph.planning.power_budget import make_unlimited

A = np.array([[0.95, 0.1, 0.0], [0.0, 0.9, 0.2], [0.0, -0.1, 0.8]])
Q = np.diag([0.1, 0.05, 0.2])
ROWS = np.array([[1.0, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [0, 1, -1], [1, 0, 1]])
NOISES = np.array([0.5, 0.4, 0.3, 0.6, 0.5, 0.8])
KAPPA = np.array([1.02, 1.05, 1.02, 1.1, 1.02, 1.05])
FIRST, SECOND = np.array([1.2, 0.7, 1.9, 1.0, 1.5, 0.5]), np.array([0.8, 1.6, 0.6, 1.3, 0.9, 1.8])
NAMES = "abcdef"


def gain(kappa, distance):
    """A gain with mean d^-1.5 and kappa = E g^2 / (E g)^2."""
    mean = distance**-1.5
    away = mean * np.sqrt(kappa - 1)
    return hg.Discrete([mean - away, mean + away], [0.5, 0.5])


def plant():
    return hg.LinearPlant(A, Q, np.zeros(3), np.eye(3))


def one_hop():
    nodes = {
        name: hg.Node(hg.LinearSensor(ROWS[i : i + 1], NOISES[i]), hg.hop(gain(KAPPA[i], FIRST[i]), 1.0), {})
        for i, name in enumerate(NAMES)
    }
    return hg.Network(plant(), nodes)


def two_hops():
    nodes = {}
    for i, name in enumerate(NAMES):
        hops = [hg.hop(gain(1.02, d[i]), 1.0) for d in (FIRST, SECOND)]
        nodes[name] = hg.Node(hg.LinearSensor(ROWS[i : i + 1], NOISES[i]), hg.amplify_and_forward(hops), {})
    return hg.Network(plant(), nodes)


def path_problem(paths, error, weight, free, powers):
    """The error of paths by the powers of the hops that are free, without limits; `weight` is a matrix."""
    weighted = Error(weight, error.worst, error.horizon, error.at_end, error.period)
    criterion = weighted.criterion(("x0", "x1", "x2"))
    return make_power_task(paths, criterion, make_unlimited(error.steps, int(free.sum())), free, powers, 1, 0).problem
