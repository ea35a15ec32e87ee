"""A channel as those see it who know of no memory: modes drawn anew at each step, and whether that does any harm."""

from collections.abc import Sequence

import numpy as np

from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.combine import Mixture
from heliograph.random_affine.modes import JointModes, joint_modes

ROUNDING = 1e-12  # relative: of sums over modes that cancel
DOUBLINGS = 60  # of the steps after which the law of the modes is that of the long run


def forgetful(channel: AbstractRandomAffine) -> AbstractRandomAffine:
    """The channel with its modes drawn anew at each step, by their law in the long run; moments up to order 4 are kept.

    A channel without memory is itself.

    Raises:
        ValueError: a map inside that remembers in a way of its own.
    """
    if not channel.remembers:
        return channel
    return mixed(joint_modes(channel, order=2))


def mixed(modes: JointModes, law: np.ndarray | None = None) -> AbstractRandomAffine:
    """One of the modes' maps, by a law (that of the long run unless given)."""
    return Mixture(modes.maps, long_run(modes) if law is None else law)


def long_run(modes: JointModes) -> np.ndarray:
    """p (I + Pi)^n / 2^n for a large n: the mean of the laws of all steps, of a chain that goes in circles too."""
    rows = (np.eye(len(modes.initial)) + np.asarray(modes.transition)) / 2
    for _ in range(DOUBLINGS):
        rows = rows @ rows
        rows = rows / rows.sum(axis=1, keepdims=True)
    law: np.ndarray = np.asarray(modes.initial) @ rows
    law = law / law.sum()
    return law


def laws(steps: Sequence[JointModes]) -> list[np.ndarray]:
    """Law of the mode at each step."""
    laws_by_step = [np.asarray(steps[0].initial)]
    for step in steps[:-1]:
        laws_by_step.append(laws_by_step[-1] @ np.asarray(step.transition))
    return laws_by_step


def harmless(steps: Sequence[JointModes], constant: bool) -> bool:
    """Return whether the linear filter that ignores memory is the best linear one: Cov(Hbar_k, Hbar_l) = 0 for k < l.

    Hbar_k = E[H_k | mode]. Where nothing varies (`constant`, one step given), the law of the modes must be that of all
    steps, and lags up to the number of modes decide, since Pi^t is a combination of lower powers (Cayley-Hamilton).
    """
    items = list(steps) * (len(steps[0].initial) + 1) if constant else list(steps)
    if constant and not np.allclose(steps[0].initial @ steps[0].transition, steps[0].initial, rtol=0, atol=ROUNDING):
        return False
    means = [np.array([np.asarray(m.moments(1).mean[:-1]).ravel() for m in step.maps]) for step in steps]
    means = means * len(items) if constant else means
    size = max(float(np.max(np.abs(m))) for m in means) ** 2
    starts = 1 if constant else len(items)
    for k, law in enumerate(laws(items)[:starts]):
        apart = law[:, None] * (means[k] - law @ means[k])
        for item, later in zip(items[k:-1], means[k + 1 :], strict=True):
            apart = np.asarray(item.transition).T @ apart
            if np.max(np.abs(apart.T @ later)) > ROUNDING * size:
                return False
    return True
