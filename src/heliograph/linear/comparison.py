"""Gain of polynomial filters over the linear one, from the model alone."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np

from heliograph.linear.lift import lifted_system
from heliograph.linear.recursion import lmmse
from heliograph.linear.system import LinearSystem, state_moments
from heliograph.model.channel import Channel
from heliograph.model.over_time import first
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor
from heliograph.numerics.check import check_count, fail
from heliograph.numerics.readable import readable
from heliograph.numerics.types import Float
from heliograph.random_affine.moments.monomials import exponents

SYMMETRIC = 1e-10  # standardised third moment below which it is rounding


@readable
@dataclass(frozen=True)
class GainOverLinear:
    """Error covariances of filters by degree, exact before any data, and the skewness that higher degrees exploit.

    Args:
        states: names of the states.
        covariance: error covariance over time (time, n, n) by degree.
        skewness: the largest standardised joint third central moment of (x_k, z_k) over all steps.
        after: first step that counts in `gain`, which leaves out the start.
    """

    states: tuple[str, ...]
    covariance: dict[int, Float[np.ndarray, "time n n"]]
    skewness: float
    after: int

    def gain(self, degree: int) -> Float[np.ndarray, "n"]:
        """Return the share of the linear filter's error variance that this degree removes, for each state."""
        mean = {d: np.diagonal(self.covariance[d][self.after :], axis1=1, axis2=2).mean(axis=0) for d in (1, degree)}
        return np.asarray(1 - mean[degree] / mean[1])

    @property
    def symmetric(self) -> bool:
        """True if all third moments vanish; then the quadratic filter is the linear one (a cubic one may still gain).

        Third moments of (x_k, z_k) at one time are enough: x_j given x_i is affine in x_i plus independent noise, so
        the third moments across times are made of them, and centred squares are uncorrelated with all x_k and z_k.
        """
        return self.skewness <= SYMMETRIC


def gain_over_linear(
    plant: AnyPlant,
    sensor: AnySensor,
    channel: Channel,
    horizon: int = 100,
    degrees: Sequence[int] = (2, 3),
    after: int | None = None,
) -> GainOverLinear:
    """Compute how much filters of these degrees gain over the best linear one, from the model alone.

    Args:
        plant: linear plant without inputs.
        sensor: linear sensor.
        channel: its channel.
        horizon: number of steps, 100 unless given.
        degrees: degrees to compare with 1, each at least 2; (2, 3) unless given.
        after: first step that counts, a third of the horizon unless given.

    Raises:
        ValueError: what `lifted_system` refuses, no degree above 1, `after` outside the horizon.
    """
    check_count("horizon", horizon)
    expected = sorted({1, 2, *degrees})
    if not degrees or min(degrees) < 2:
        raise fail("degrees", "at least one, all of 2 or more", list(degrees))
    begin = horizon // 3 if after is None else after
    if not 0 <= begin < horizon:
        raise fail("first step that counts", f"one from 0 to {horizon - 1}", begin)
    systems = {d: lifted_system(plant, sensor, channel, d, horizon) for d in expected}
    n, m = len(first(plant).states), int(first(channel).outputs)
    covariances = {d: lmmse(system).gains.covariance for d, system in systems.items()}
    return GainOverLinear(first(plant).states, covariances, skewness(systems[2], n, m), begin)


def skewness(square: LinearSystem, states: int, outputs: int) -> float:
    """Largest |E (a - Ea)(b - Eb)(c - Ec)| / (sd a sd b sd c) over a, b, c among x_k, z_k, from the system of degree 2.

    k3(a, b, c) = Cov(a b, c) - E a Cov(b, c) - E b Cov(a, c), with a b a monomial of the square.
    """
    x, z = _places(states), _places(outputs)
    before = state_moments(square)
    worst = 0.0
    for k in range(square.horizon):
        s, spread = square.step(k), before.covariance[k + 1]
        cross = s.output @ spread
        # Joint covariance and mean of the lifted (x, z).
        joint = np.block([[spread, cross.T], [cross, cross @ s.output.T + s.noise]])
        mean = np.concatenate([before.mean[k + 1], s.output @ before.mean[k + 1] + s.offset])
        linear = [x[(i,)] for i in range(states)] + [len(spread) + z[(i,)] for i in range(outputs)]
        deviation = np.sqrt(np.diag(joint))
        for places, start in ((x, 0), (z, len(spread))):
            for (a, b), place in ((key, p) for key, p in places.items() if len(key) == 2):
                i, j = start + places[(a,)], start + places[(b,)]
                # k3(a, b, c) = Cov(a b, c) - E a Cov(b, c) - E b Cov(a, c).
                third = joint[start + place, linear] - mean[i] * joint[j, linear] - mean[j] * joint[i, linear]
                size = deviation[i] * deviation[j] * deviation[linear]
                ratio = np.divide(np.abs(third), size, out=np.zeros_like(third), where=size > 0)
                worst = max(worst, float(np.max(ratio)))
    return worst


def _places(variables: int) -> dict[tuple[int, ...], int]:
    """Places of y_i and of y_i y_j among the monomials of degree 2."""
    index = {powers: i for i, powers in enumerate(exponents(variables + 1, 2))}
    unit = np.eye(variables + 1, dtype=int)
    places: dict[tuple[int, ...], int] = {
        (i,): index[tuple(int(v) for v in unit[i] + unit[-1])] for i in range(variables)
    }
    for i, j in combinations_with_replacement(range(variables), 2):
        places[(i, j)] = index[tuple(int(v) for v in unit[i] + unit[j])]
    return places
