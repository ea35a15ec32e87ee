"""A scene with relays in the plane: who takes which way, the error that follows, and what no sites can beat.

A hop over a distance d has the noise alpha d^e in sent power. Each sensor has the same share of the power and takes
the better way, through one of the relays or none, with its power split best between the hops. The noise of a path
grows with both distances, so that of a relay on the straight line to the receiver, where it is best, is the least that
any site gives a sensor: with it for every sensor the error is below that of any number of relays at any sites.
"""

from dataclasses import dataclass

import numpy as np

from heliograph.numerics.check import array, covariance, fail, instance, scalar
from heliograph.numerics.readable import readable
from heliograph.numerics.types import ArrayLike, Float
from heliograph.planning.error import Error
from heliograph.planning.moments import steady_covariance
from heliograph.planning.paths.information_filter import Plants, covariances
from heliograph.planning.paths.model import Paths, at_least, independent_paths
from heliograph_studies.network_design.theory.relay_line import relay_line
from heliograph_studies.network_design.theory.splits import path_noise

SLACK = 1e-9  # relative, of the minimum of a search, by which the bound stays below


@readable
@dataclass(frozen=True, init=False)
class Radio:
    """Hops by their distance: noise alpha d^exponent in sent power, and kappa = E g^2 / (E g)^2 of the fading.

    Below the distance `nearest` the noise stays what it is there.

    Raises:
        ValueError: a distance that is not positive, negative numbers, kappa below 1.
    """

    exponent: float
    alpha: float
    kappa: float
    nearest: float

    def __init__(self, exponent: ArrayLike, alpha: ArrayLike = 1.0, kappa: ArrayLike = 1.0, nearest: ArrayLike = 0.01):
        for name, value, least in (
            ("exponent", exponent, 0.0),
            ("alpha", alpha, 0.0),
            ("kappa", kappa, 1.0),
            ("nearest", nearest, np.finfo(float).tiny),
        ):
            object.__setattr__(self, name, float(scalar(f"{name} of a radio", value, least)))

    def noise(self, distance: Float[np.ndarray, "..."]) -> Float[np.ndarray, "..."]:
        """alpha d^e."""
        return np.asarray(self.alpha * np.maximum(distance, self.nearest) ** self.exponent)


@readable
@dataclass(frozen=True, init=False)
class RelayScene:
    """A stable plant, sensors at places in the plane, one receiver, and the radio of all hops.

    Shapes: transition A and process Q (n, n), rows (M, n), noises (M,), sensors (M, 2), receiver (2,).

    Raises:
        ValueError: wrong shapes, negative variances, a plant that is not stable.
    """

    transition: np.ndarray
    process: np.ndarray
    rows: np.ndarray
    noises: np.ndarray
    sensors: np.ndarray
    receiver: np.ndarray
    radio: Radio
    weight: np.ndarray
    signal: np.ndarray

    def __init__(
        self,
        transition: ArrayLike,
        process: ArrayLike,
        rows: ArrayLike,
        noises: ArrayLike,
        sensors: ArrayLike,
        receiver: ArrayLike,
        radio: Radio,
        error: Error | None = None,
    ):
        error = instance("error", Error() if error is None else error, Error, "an Error")
        a = array("transition of a scene", transition, (None, None))
        n = len(a)
        q, c = covariance("process noise of a scene", process, n), array("rows of a scene", rows, (None, n))
        if error.worst or error.steps != 1 or error.horizon is not None:
            raise fail("error of a scene", "a steady trace", error)
        moment = steady_covariance(array("transition of a scene", a, (n, n)), q)
        values = {
            "transition": a,
            "process": q,
            "rows": c,
            "noises": at_least(0.0, "noises of a scene", array("noises of a scene", noises, (len(c),))),
            "sensors": array("sensors of a scene", sensors, (len(c), 2)),
            "receiver": array("receiver of a scene", receiver, (2,)),
            "radio": instance("radio of a scene", radio, Radio, "a Radio"),
            "weight": error.matrix(tuple(f"x{i}" for i in range(n))),
            "signal": np.einsum("in,nm,im->i", c, moment, c),
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)

    def ways(self, relays: ArrayLike, total: float) -> tuple[Float[np.ndarray, "M"], np.ndarray]:
        """Noise over mean gain, K F, of each sensor's best way, and which relay it takes, -1 for none."""
        sites = array("relays of a scene", np.reshape(np.asarray(relays, dtype=float), (-1, 2)), (None, 2))
        power, radio = total / len(self.rows), self.radio
        last = radio.noise(_distance(sites, self.receiver)) / power
        first = radio.noise(_distance(self.sensors[:, None], sites)) / power
        direct = radio.kappa * (1 + radio.noise(_distance(self.sensors, self.receiver)) / power)
        through = radio.kappa**2 * (np.sqrt((1 + first) * (1 + last)) + np.sqrt(first * last)) ** 2
        every = np.concatenate([direct[:, None], through], axis=1)
        best = np.argmin(every, axis=1)
        return every[np.arange(len(best)), best], best - 1

    def error(self, relays: ArrayLike, total: float) -> float:
        """Steady error with relays (R, 2) at these sites, or none, every sensor with its share of the total power."""
        return self.error_of(self.ways(relays, total)[0])

    def error_of(self, noise: Float[np.ndarray, "M"]) -> float:
        """Steady error where paths have this noise K F, as s K F - t."""
        information = 1 / ((self.signal + self.noises) * noise - self.signal)
        plants = Plants(self.transition[None], self.process[None], None)
        p = covariances(plants, (self.rows.T @ (information[:, None] * self.rows))[None])
        return float(np.sum(self.weight * p[0]))

    def bound(self, total: float) -> float:
        """What no relays at any sites come below, each signal taking one of them at most."""
        radio, power = self.radio, total / len(self.rows)
        least = []
        for d in _distance(self.sensors, self.receiver):
            rho = float(radio.noise(d)) / power
            if d <= 2 * radio.nearest:  # both hops may be as short as counts
                relayed = radio.kappa**2 * path_noise(np.full(2, float(radio.noise(np.zeros(()))) / power), 1.0)
            else:
                relayed = relay_line(rho, radio.exponent, 1, radio.kappa, radio.nearest / d).noise
            least.append(min(relayed, radio.kappa * (1 + rho)))
        return self.error_of(np.array(least)) * (1 - SLACK)

    def paths(self, relays: ArrayLike, total: float) -> Paths:
        """The paths that the signals take, of two hops; a direct one has a second hop that costs nothing."""
        sites, taken = np.reshape(np.asarray(relays, dtype=float), (-1, 2)), self.ways(relays, total)[1]
        direct = self.radio.noise(_distance(self.sensors, self.receiver))
        alpha, kappa = np.zeros((len(taken), 2)), np.ones((len(taken), 2))
        alpha[:, 0], kappa[:, 0] = direct, self.radio.kappa
        for i, relay in enumerate(taken):
            if relay >= 0:
                alpha[i] = self.radio.noise(_distance(np.array([self.sensors[i], self.receiver]), sites[relay]))
                kappa[i] = self.radio.kappa
        return independent_paths(self.transition, self.process, self.rows, self.noises, kappa, alpha)


def _distance(a: Float[np.ndarray, "*k 2"], b: Float[np.ndarray, "*k 2"]) -> Float[np.ndarray, "*k"]:
    return np.asarray(np.linalg.norm(a - b, axis=-1))
