"""The example's plants and links: a gain of two levels in bursts, and two hops whose gains drift."""

import numpy as np

import heliograph as hg

BURSTS = np.array([[0.95, 0.05], [0.03, 0.97]])
GAINS = (0.2, 1.0)
NOISE = 0.05
POWER = 0.04 / (1 - 0.98**2)  # E x^2 of the plant, where it starts

PLANT = hg.LinearPlant([[0.98]], [[0.04]], [0.0], [[POWER]])
SENSOR = hg.LinearSensor([[1.0]], NOISE)
TWO_SENSORS = hg.LinearSensor([[1.0], [1.0]], NOISE * np.eye(2))

DRIFTING_PLANT = hg.LinearPlant([[0.98, 0.1], [0.0, 0.95]], np.diag([0.002, 0.02]), [1.0, 0.0], np.diag([1.0, 0.2]))
DRIFTING_SENSOR = hg.LinearSensor([[1.0, 0.0]], NOISE)

ARRIVAL = (0.5, 0.95)  # in each mode, where losses are told
CLASSES = np.array([[0.8, 0.2], [0.2, 0.8]])  # P(class of the signal's strength | mode)


def bursts(transition: np.ndarray = BURSTS, name: str | None = None) -> hg.random_affine.AbstractRandomAffine:
    """A link whose gain stays at one of two levels for a while."""
    return hg.markov_fading(GAINS, transition, NOISE, name=name)


def lossy() -> hg.random_affine.AbstractRandomAffine:
    """The same link; packets arrive less often while it is bad, and the receiver is told."""
    hops = [hg.erasure(hg.hop(gain, NOISE), arrival) for gain, arrival in zip(GAINS, ARRIVAL, strict=True)]
    return hg.markov_fading(hops, BURSTS)


def drifting() -> hg.random_affine.AbstractRandomAffine:
    """Two hops whose gains drift."""
    first, second = ((1.0, 0.4, 0.95), (0.8, 0.3, 0.9))
    return hg.amplify_and_forward([hg.autoregressive_fading(*hop, NOISE) for hop in (first, second)])


def correlated(lag: float) -> hg.random_affine.AbstractRandomAffine:
    """The same two levels, as often each, with correlation `lag` from one step to the next."""
    law = np.array([0.375, 0.625])
    return bursts(lag * np.eye(2) + (1 - lag) * law)
