"""A second way to a relay network's error covariances: raw moments in absolute coordinates, in plain NumPy.

It shares no step with `second_moments`: it follows E q q' of q = (1, x, s_1, ..., s_F) itself, with E[z z'] taken from
each link's second moments, and it asks nothing of the gains. Designs are certified with it.
"""

from typing import NamedTuple

import numpy as np

from heliograph.model.over_time import at
from heliograph.model.relays import SENSOR, RelayNetwork
from heliograph.numerics.check import fail, instance
from heliograph.numerics.types import Float
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.relays.design import GainsByFilter


class Recomputed(NamedTuple):
    """Error covariance[filter], mean error[filter], state covariance at k = 0 .. steps; how far gains are from greedy.

    correlation[filter]: largest correlation of a component of the error after the step with a component of
    the innovation; zero if and only if the gain minimises the filter's own next error.
    """

    covariance: dict[str, Float[np.ndarray, "steps+1 n n"]]
    mean: dict[str, Float[np.ndarray, "steps+1 n"]]
    state: Float[np.ndarray, "steps+1 n n"]
    correlation: dict[str, Float[np.ndarray, "steps"]]


class _Observation(NamedTuple):
    """Reception of one filter: mean map and E z z' = raw_ij : (sent, 1)(sent, 1)'."""

    mean: Float[np.ndarray, "p sent+1"]
    raw: Float[np.ndarray, "p p sent+1 sent+1"]


def recompute(network: RelayNetwork, gains: GainsByFilter) -> Recomputed:
    """Follow the raw second moments under any gains {filter: (steps, n, received)}.

    Raises:
        ValueError: a filter without gains.
    """
    instance("relay network", network, RelayNetwork, "a RelayNetwork")
    if set(gains) != set(network.filters):
        raise fail("gains", f"those of {list(network.filters)}", list(gains))
    (mean, spread), n = network.initial(), len(network.states)
    # q = (1, x, s_1, ..., s_F): raw moments E q q', and the maps to e_f = x - s_f.
    filters, start = network.filters, np.concatenate([[1.0], np.tile(mean, 1 + len(network.filters))])
    raw = np.outer(start, start)
    raw[1 : 1 + n, 1 : 1 + n] += spread
    errors = np.zeros((len(filters), n, len(start)))  # e_f = x - s_f
    for f in range(len(filters)):
        errors[f, :, 1 : 1 + n], errors[f, :, 1 + (1 + f) * n : 1 + (2 + f) * n] = np.eye(n), -np.eye(n)
    history, correlation = [raw], []
    by_filter = [np.asarray(gains[name], dtype=np.float64) for name in filters]
    for k in range(len(by_filter[0])):
        # One step of E q q'; innovations must be uncorrelated with errors.
        raw, result = _step(network, k, raw, [gain[k] for gain in by_filter], errors)
        history.append(raw)
        correlation.append(result)
    moments = np.array(history)
    means = moments[:, 0, 1 : 1 + n]
    return Recomputed(
        {name: errors[f] @ moments @ errors[f].T for f, name in enumerate(filters)},
        {name: moments[:, 0] @ errors[f].T for f, name in enumerate(filters)},
        moments[:, 1 : 1 + n, 1 : 1 + n] - means[:, :, None] * means[:, None, :],
        {name: np.array(correlation)[:, f] for f, name in enumerate(filters)},
    )


def _step(
    network: RelayNetwork, k: int, raw: np.ndarray, gains: list[np.ndarray], errors: np.ndarray
) -> tuple[np.ndarray, list[float]]:
    """E q+ q+' from E q q', and each filter's largest correlation of error and innovation."""
    n, size = len(network.states), len(raw)
    plant, sensor = (at(item, k) for item in (network.plant, network.sensor))
    c, m = sensor.matrix, len(sensor.matrix)
    # Motion and transmission: q -> (1, x+, s) -> (y, C s_r, 1).
    move = np.eye(size)  # (1, x, s) -> (1, x+, s)
    move[1 : 1 + n, 0], move[1 : 1 + n, 1 : 1 + n] = plant.noise.mean, plant.matrix
    sends = np.zeros((m * (1 + len(network.relays)) + 1, size))  # (1, x+, s) -> (y, C s_r, 1), less the sensor's noise
    sends[:m, 0], sends[:m, 1 : 1 + n] = sensor.noise.mean, c
    for r in range(len(network.relays)):
        sends[(1 + r) * m : (2 + r) * m, 1 + (1 + r) * n : 1 + (2 + r) * n] = c
    sends[-1, 0] = 1.0
    # Second moments after the motion and of the sent signals.
    moved = move @ raw @ move.T
    moved[1 : 1 + n, 1 : 1 + n] += plant.noise.covariance
    second = sends @ moved @ sends.T
    second[:m, :m] += sensor.noise.covariance
    received = [_receive(network, name, k, len(sends)) for name in network.filters]
    joint, close, innovations = _joint(moved, sends, second, received), np.eye(size), []
    update = np.zeros((size, sum(len(h.mean) for h in received)))
    place = 0
    for f, (h, gain) in enumerate(zip(received, gains, strict=True)):
        rows, mine = slice(1 + (1 + f) * n, 1 + (2 + f) * n), slice(place, place + len(h.mean))
        place += len(h.mean)
        # Innovation i_f = z_f - E[z_f if every estimate were s_f].
        values = np.zeros((len(sends), size))  # signals sent if this estimate were everybody's
        values[:m, 0] = c @ plant.noise.mean + sensor.noise.mean
        values[:m, rows] = c @ plant.matrix
        values[m:-1, rows] = np.tile(c, (len(network.relays), 1))
        values[-1, 0] = 1.0
        innovation = np.zeros((len(h.mean), size + update.shape[1]))
        innovation[:, :size], innovation[:, size:][:, mine] = -h.mean @ values, np.eye(len(h.mean))
        innovations.append(innovation)
        # Correction s_f+ = A s_f + K i_f.
        close[rows, rows] = plant.matrix - gain @ h.mean @ values[:, rows]
        close[rows, 0] = plant.noise.mean - gain @ h.mean @ values[:, 0]
        update[rows, mine] = gain
    full = np.concatenate([close, update], axis=1)
    results = [_correlation(errors[f] @ full, i, joint, received[f]) for f, i in enumerate(innovations)]
    return full @ joint @ full.T, results


def _joint(moved: np.ndarray, sends: np.ndarray, second: np.ndarray, received: list[_Observation]) -> np.ndarray:
    """E of (1, x+, s, z_1 .. z_F) squared; links to different listeners are independent given what is sent."""
    mean = np.concatenate([h.mean for h in received])
    zz = mean @ second @ mean.T
    place = 0
    for h in received:
        mine = slice(place, place + len(h.mean))
        place += len(h.mean)
        zz[mine, mine] = np.einsum("ijab,ab->ij", h.raw, second)
    cross = moved @ sends.T @ mean.T
    return np.block([[moved, cross], [cross.T, zz]])


def _receive(network: RelayNetwork, name: str, k: int, sent: int) -> _Observation:
    """Sum of the listener's links: raw moments add, products of different links' means are added twice."""
    slot = network.slots[k % len(network.slots)]
    size = network.received[network.filters.index(name)]
    total, raw = np.zeros((size, sent)), np.zeros((size, size, sent, sent))
    for sender, link in slot.get(name, {}).items():
        item: AbstractRandomAffine = at(link, k)
        moments = item.moments(2)
        columns = np.append((SENSOR, *network.relays).index(sender) * item.inputs + np.arange(item.inputs), sent - 1)
        mean = np.zeros((size, sent))
        mean[:, columns] = moments.mean[:-1]
        separate = moments.second
        rows = np.arange(size)
        raw[np.ix_(rows, rows, columns, columns)] += separate
        raw += np.einsum("ia,jb->ijab", total, mean) + np.einsum("ia,jb->ijab", mean, total)
        total += mean
    return _Observation(total, raw)


def _correlation(error: np.ndarray, innovation: np.ndarray, joint: np.ndarray, received: _Observation) -> float:
    """Return the largest |E e i'| relative to the root of E e e and E i i; zero for a filter that receives nothing."""
    if not np.any(received.raw):
        return 0.0
    cross = error @ joint @ innovation.T
    e, i = np.diag(error @ joint @ error.T), np.diag(innovation @ joint @ innovation.T)
    return float(np.max(np.abs(cross) / np.sqrt(np.outer(e, i))))
