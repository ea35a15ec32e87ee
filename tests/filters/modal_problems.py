"""Links that remember, and a plant behind them, that several tests look at."""

import numpy as np

import heliograph as hg

GOOD = hg.hop(hg.Discrete([0.7, 1.1], [0.4, 0.6]), hg.Gaussian([[0.2]], [0.1]))
BAD = hg.hop(hg.Rayleigh(0.2), 0.5)
RELAY = hg.hop(hg.random_affine.Nakagami(2.0), 0.15, amplification=1.4)
PLANT = hg.LinearPlant([[0.98]], [[0.04]], [0.0], [[0.04 / (1 - 0.98**2)]])
SENSOR = hg.LinearSensor([[1.0]], 0.05)
BURSTS = np.array([[0.95, 0.05], [0.03, 0.97]])

CHAIN_A = [np.array([[0.8, 0.2], [0.4, 0.6]]), np.array([[0.5, 0.5], [0.1, 0.9]]), np.array([[0.9, 0.1], [0.3, 0.7]])]
LAW_A = np.array([0.9, 0.1])  # not stationary


def chain_a(k, name=None):
    return hg.random_affine.MarkovChain(CHAIN_A[min(k, 2)], LAW_A, name)


def bursts(transition=BURSTS):
    return hg.markov_fading([0.2, 1.0], transition, 0.05)


def variances(plant, sensor, channel, steps):
    """Of the exact filter's errors, after each correction."""
    item = hg.linear_filter(plant, sensor, channel)
    assert item.claim == "exact"
    return np.diagonal(item.planned(np.zeros((steps, 0))).covariances[2::2], axis1=1, axis2=2)
