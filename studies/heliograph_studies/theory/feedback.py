"""Feedback of the receiver's prediction: how much noise an unstable plant tolerates on the way, and with what error.

A sensor sends c x + v - c xhat with xhat the receiver's prediction; of E (y - c xhat)^2 = s = c P c' + r every
transmitter makes its power p_h. Received over the path's mean gain, this has the second moment s D,
    D = prod_h kappa_h (1 + alpha_h / p_h), kappa = E g^2 / (E g)^2, alpha = Var m / E g^2,
so that the predicted error is P+ = A (P - P c' c P / (s D)) A' + Q: that of a filter whose packets arrive with
probability 1 / D and whose losses are not observed. It is bounded if and only if 1 / D > 1 - 1 / Lambda.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from heliograph.linear.steady_state import plant_matrices, sensor_matrices
from heliograph.model.channel import Channel, amplify_and_forward, hop
from heliograph.model.over_time import over_time
from heliograph.model.plant import LinearPlant
from heliograph.model.sensor import LinearSensor
from heliograph.numerics.check import check_count, fail, items, repeat_per_step, show_value
from heliograph.numerics.lapack import spectral_radius
from heliograph.numerics.module import readable
from heliograph.numerics.types import ArrayLike, Float
from heliograph.random_affine.hop import GainAndNoise

CONVERGED = 1e-12  # relative change of a round at which the error is steady: rounding of the linear equation
STEPS, ROUNDS = 20, 2000  # of the filter in a round; rounds
WHAT = "hops of a sensor with feedback"


@readable
class FeedbackLimit(NamedTuple):
    """Certificate of a plant whose sensor has feedback: the error is bounded if and only if noise < limit.

    noise D = prod kappa_h (1 + alpha_h / p_h) of the path; limit = Lambda / (Lambda - 1), Lambda the product of the
    squared unstable eigenvalues (inf for a stable plant). predicted, filtered (n, n): the steady error covariances,
    None where they grow.
    """

    noise: float
    limit: float
    predicted: Float[np.ndarray, "n n"] | None
    filtered: Float[np.ndarray, "n n"] | None

    @property
    def bounded(self) -> bool:
        """True if the error stays bounded."""
        return self.noise < self.limit


class _Link(NamedTuple):
    """Mean, second moment and noise variance of a hop whose transmitter sends its input at power 1."""

    mean: float
    second: float
    noise: float


def feedback_limit(
    plant: LinearPlant, sensor: LinearSensor, hops: Sequence[GainAndNoise], powers: "Float[ArrayLike, '*hop']"
) -> FeedbackLimit:
    """Certificate of a sensor with feedback: noise of its path, the most that keeps the error bounded, steady error.

    Bounded is the error of `hg.filters.fed_back_filter`.

    Args:
        plant: a linear plant.
        sensor: a linear sensor with one output.
        hops: from the sensor through its relays, as `hg.hop(law, variance)`; how much each amplifies follows from its
            power.
        powers: of each transmitter, shape (hop,), or one number.

    Returns:
        noise D of the path, its limit, whether the error is bounded, and the steady covariances.

    Raises:
        ValueError: a plant or sensor that is not linear or varies, more than one output, an unstable mode that the
            sensor does not show, hops that are no single hops, powers that are not positive.
    Source: Elia, Remote stabilization over fading channels (2005), for one input.
    """
    a, q = plant_matrices(plant)
    c, r = sensor_matrices(sensor, len(a))
    _check_detectable(a, c)
    noise = noise_of_hops(hops, powers)
    eigenvalues = np.abs(np.linalg.eigvals(a))
    lam = float(np.prod(eigenvalues[eigenvalues > 1] ** 2))
    limit = lam / (lam - 1) if lam > 1 else np.inf
    if noise >= limit:
        return FeedbackLimit(noise, limit, None, None)
    predicted = _steady(a, q, c, r, noise)
    return FeedbackLimit(noise, limit, predicted, _filtered(predicted, c, r, noise))


def fed_back_channel(
    plant: LinearPlant,
    sensor: LinearSensor,
    hops: Sequence[GainAndNoise],
    powers: "Float[ArrayLike, '*hop']",
    horizon: int,
) -> Channel:
    """Channel over a horizon of a sensor with feedback, in which every transmitter has a constant power.

    a_1^2 = p_1 / (c P_k c' + r) falls and rises with the receiver's uncertainty, which is known before any data; relays
    amplify by a_{h+1}^2 = p_{h+1} / (E g_h^2 p_h + Var m_h). For `hg.filters.fed_back_filter`.

    Args:
        plant: a linear plant.
        sensor: a linear sensor with one output.
        hops: as in `feedback_limit`.
        powers: of each transmitter, shape (hop,), or one number.
        horizon: number of steps.

    Raises:
        ValueError: as `feedback_limit`; a horizon below one.
    """
    a, q = plant_matrices(plant)
    c, r = sensor_matrices(sensor, len(a))
    links, p = _links(hops), _powers(powers, len(hops))
    noise, steps = noise_of_hops(hops, powers), check_count("horizon", horizon)
    # Relays amplify alike at all steps, the sensor by what is left of its signal.
    relays = [
        np.sqrt(then / (link.second * sent + link.noise)) for link, sent, then in zip(links, p, p[1:], strict=False)
    ]
    filtered, channels = np.asarray(plant.initial_covariance), []
    for _ in range(steps):
        predicted = a @ filtered @ a.T + q
        factors = [np.sqrt(p[0] / (c @ predicted @ c.T + r)[0, 0]), *relays]
        channels.append(
            amplify_and_forward([
                hop(item.law, item.noise, amplification=factor) for item, factor in zip(hops, factors, strict=True)
            ])
        )  # fmt: skip
        filtered = _filtered(predicted, c, r, noise)
    return over_time(channels)


def noise_of_hops(hops: Sequence[GainAndNoise], powers: ArrayLike) -> float:
    """D = prod_h kappa_h (1 + alpha_h / p_h): the second moment of what arrives, over that of what was sent.

    Raises:
        ValueError: hops that are no single hops, powers that are not positive.
    """
    links = _links(hops)
    pairs = zip(links, _powers(powers, len(links)), strict=True)
    return float(np.prod([link.second / link.mean**2 * (1 + link.noise / (link.second * p)) for link, p in pairs]))


def _filtered(p: np.ndarray, c: np.ndarray, r: np.ndarray, noise: float) -> np.ndarray:
    """P - P c' c P / (s D)."""
    cross = p @ c.T
    return np.asarray(p - cross @ cross.T / (noise * (c @ cross + r)[0, 0]))


def _steady(a: np.ndarray, q: np.ndarray, c: np.ndarray, r: np.ndarray, noise: float) -> np.ndarray:
    """P = A (P - P c' c P / (s D)) A' + Q: steps of the filter, and the steady error of their gain once it is bounded.

    With a constant gain K, P+ = A ((I - K c) P (I - K c)' + K r K' + (D - 1) K (c P c' + r) K') A' + Q.
    """
    n = len(a)
    p = q
    for _ in range(ROUNDS):
        for _ in range(STEPS):
            p = a @ _filtered(p, c, r, noise) @ a.T + q
        # Steady error of the gain that these steps end with, by a linear equation.
        gain = p @ c.T / (noise * (c @ p @ c.T + r)[0, 0])
        loop, amplified = a @ (np.eye(n) - gain @ c), a @ gain
        through = np.kron(loop, loop) + (noise - 1) * np.kron(amplified @ c, amplified @ c)
        if spectral_radius(through) >= 1:
            continue
        added = noise * r[0, 0] * amplified @ amplified.T + q
        steady = np.linalg.solve(np.eye(n * n) - through, added.ravel()).reshape(n, n)
        steady = (steady + steady.T) / 2
        if np.abs(steady - p).max() <= CONVERGED * np.abs(steady).max():
            return steady
        p = steady
    return p


def _links(hops: Sequence[GainAndNoise]) -> list[_Link]:
    links = []
    for item in items("hops", hops, "hops"):
        if not isinstance(item, GainAndNoise) or item.inputs != 1 or item.outputs != 1:
            raise fail(WHAT, "single hops of one number", show_value(item))
        variance = float(np.asarray(item.noise.covariance)[0, 0])
        links.append(_Link(float(item.law.moment(1)), float(item.law.moment(2)), variance))
    if not links or any(link.mean == 0 for link in links):
        raise fail(WHAT, "at least one, each with a mean gain", show_value(hops))
    return links


def _powers(powers: ArrayLike, count: int) -> np.ndarray:
    result = repeat_per_step("powers", powers, count)
    if np.any(result <= 0):
        raise fail("powers", "positive numbers", result.tolist())
    return result


def _check_detectable(a: np.ndarray, c: np.ndarray) -> None:
    """One output, which shows every unstable mode (Hautus)."""
    if len(c) != 1:
        raise fail("sensor with feedback", "one output", len(c))
    for value in np.linalg.eigvals(a):
        if abs(value) >= 1 and np.linalg.matrix_rank(np.vstack([a - value * np.eye(len(a)), c])) < len(a):
            raise fail("sensor with feedback", "one that shows every unstable mode", f"none of {value:.4g}")
