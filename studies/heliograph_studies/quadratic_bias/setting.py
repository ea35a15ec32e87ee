"""Section 4's example as printed, and a scenario of ours with outages and rare shocks, as heliograph models."""

import numpy as np

from heliograph.model.channel import amplify_and_forward
from heliograph.model.over_time import OverTime, over_time
from heliograph.model.plant import LinearPlant, with_bias
from heliograph.model.sensor import LinearSensor
from heliograph.random_affine.atoms import GainAndNoise
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.law import Discrete
from heliograph.random_affine.noise import FiniteSupport, Independent, Shaped

HORIZON = 100
SETTLED = 30  # library step of t = 31: means are over t = 31 ... 100

C, D = np.array([[0.2, 0.18]]), np.array([[0.01]])
B = np.array([[0.05], [0.1]])
F = np.array([[0.1, 0.0], [0.1, 0.2]])
THETA = 3.0
SENSOR_POWER = Discrete(np.sqrt([1.0, 1.5, 2.0]), [0.1, 0.3, 0.6])  # l_t; the gain is its root
RELAY_POWER = Discrete(np.sqrt([1.0, 1.1, 1.2]), [0.2, 0.4, 0.4])  # m_t, printed 'l_t' for its last value
INITIAL_VARIANCE = 0.01

TABLE_1 = {  # second, third and fourth moments as printed, rounded to four digits
    "w": (1.0, 0.0, 1.0), "v": (0.9100, -0.5460, 1.1557),
    "eps1": (0.9600, 0.3840, 1.0752), "eps2": (0.1875, -0.0938, 0.0820),
    "xi1": (0.7500, -0.7500, 1.3125), "xi2": (0.3750, -0.0938, 0.1641),
    "varpi": (0.3600, -0.5760, 1.0512), "sigma": (0.2100, -0.0840, 0.0777),
}  # fmt: skip


def two_values(a: float, b: float, chance_of_a: float) -> FiniteSupport:
    """The law of a with `chance_of_a`, else b."""
    return FiniteSupport([[a], [b]], [chance_of_a, 1 - chance_of_a])


NOISES = {
    "w": two_values(-1.0, 1.0, 0.5),
    "v": two_values(0.7, -1.3, 0.65),
    "eps1": two_values(-0.8, 1.2, 0.6),
    "eps2": two_values(-0.75, 0.25, 0.25),
    "xi1": two_values(-1.5, 0.5, 0.25),
    "xi2": two_values(-0.75, 0.5, 0.4),
    "varpi": two_values(-1.8, 0.2, 0.1),
    "sigma": two_values(-0.7, 0.3, 0.3),
}


def plant(horizon: int = HORIZON) -> OverTime:
    """State (x1, x2) and bias (eps1, eps2), (1) and (2), over `horizon` steps from t = 0."""
    bias = LinearPlant(
        F,
        Independent([NOISES["xi1"], NOISES["xi2"]]),
        np.zeros(2),
        Independent([NOISES["eps1"], NOISES["eps2"]]),
        states=("eps1", "eps2"),
    )

    def at_time(t: int) -> LinearPlant:
        matrix = [[0.6, 0.5], [-0.1 * np.sin(0.2 * t), 0.8]]
        coupling = [[0.1, 0.0], [0.03 * np.cos(0.2 * t), 0.15]]
        state = LinearPlant(matrix, Shaped(B, NOISES["w"]), np.zeros(2), INITIAL_VARIANCE * np.eye(2),
                            states=("x1", "x2"))  # fmt: skip
        return with_bias(state, coupling, bias)

    return over_time([at_time(t) for t in range(horizon)])


def sensor() -> LinearSensor:
    """y = C x + D v, (3)."""
    return LinearSensor(np.concatenate([C, np.zeros((1, 2))], axis=1), Shaped(D, NOISES["v"]))


def channel() -> AbstractRandomAffine:
    """z = theta sqrt(m) (sqrt(l) y + varpi) + sigma, (5) to (7)."""
    return amplify_and_forward(
        [
            GainAndNoise(SENSOR_POWER, np.eye(1), NOISES["varpi"]),
            GainAndNoise(RELAY_POWER, THETA * np.eye(1), NOISES["sigma"]),
        ]
    )


OUTAGE_HORIZON = 150
OUTAGE_SETTLED = 100
SHOCK_PROBABILITY = 0.005  # one large shock in 200 steps


def shock(size: float, probability: float) -> FiniteSupport:
    """Mean zero: far from zero with a small probability, near it else."""
    return two_values(size * (1 - probability), -size * probability, probability)


def outage_plant() -> LinearPlant:
    """x+ = 0.9 x + 0.3 bias + w with rare large shocks w; bias+ = 0.8 bias + xi."""
    bias = LinearPlant([[0.8]], two_values(-0.1, 0.1, 0.5), [0.0], two_values(-0.3, 0.3, 0.5), states=("bias",))
    noise = shock(SHOCK_PROBABILITY**-0.5, SHOCK_PROBABILITY)
    state = LinearPlant([[0.9]], noise, [0.0], two_values(-1.0, 1.0, 0.5), states=("x",))
    return with_bias(state, [[0.3]], bias)


def outage_sensor() -> LinearSensor:
    """y = x + v."""
    return LinearSensor([[1.0, 0.0]], shock(1.0, 0.1))


def outage_channel() -> AbstractRandomAffine:
    """Both transmitters are off at random: the sensor's with probability 0.7, the relay's with 0.3."""
    return amplify_and_forward(
        [
            GainAndNoise(Discrete([0.0, 1.0], [0.7, 0.3]), np.eye(1), shock(1.0, 0.1)),
            GainAndNoise(Discrete([0.0, 1.0], [0.3, 0.7]), np.eye(1), shock(1.0, 0.1)),
        ]
    )
