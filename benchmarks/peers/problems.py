"""The problems that every program solves, drawn with a fixed seed, and the least work that a step of each needs."""

from typing import Any, NamedTuple

import numpy as np

Arrays = dict[str, np.ndarray]


class Problem(NamedTuple):
    """Arrays for the programs' input file, and the least arithmetic (flops) and traffic (bytes) of a step of a run."""

    title: str
    arrays: Arrays
    flops: int
    bytes: int


def kalman(runs: int = 10_000, steps: int = 100) -> Problem:
    """x+ = A x + w, z = diag(g) C x + n with n = 4, m = 2; gains g known to the filter, others at each step and run."""
    draw = np.random.default_rng(20)
    n, m = 4, 2
    a = draw.normal(size=(n, n))
    a *= 0.95 / np.abs(np.linalg.eigvals(a)).max()
    c, q, r = draw.normal(size=(m, n)), 0.1 * np.eye(n), 0.2 * np.eye(m)
    gains = draw.rayleigh(np.sqrt(0.5), size=(runs, steps, m))
    z, x = np.empty((runs, steps, m)), draw.normal(size=(runs, n))
    for k in range(steps):
        x = x @ a.T + np.sqrt(0.1) * draw.normal(size=(runs, n))
        z[:, k] = gains[:, k] * (x @ c.T) + np.sqrt(0.2) * draw.normal(size=(runs, m))
    arrays = {"A": a, "C": c, "Q": q, "R": r, "mean": np.zeros(n), "covariance": np.eye(n), "gains": gains, "z": z}
    title = f"Kalman step, {n} states, {m} measurements, a known random gain at each step and run"
    return Problem(title, arrays, kalman_flops(n, m), 8 * (m + m + n))


def kalman_flops(n: int, m: int) -> int:
    """Multiplications and additions of a textbook step, of symmetric results one half: prediction, then update."""
    half = n * (n + 1)  # twice the entries of a symmetric matrix: one multiplication and one addition each
    prediction = 2 * n**2 + 2 * n**3 + half * n + half // 2  # A m, A P, (A P) A', + Q
    innovation = m * n + 2 * m * n**2 + m * (m + 1) * n + m  # diag(g) C = H, H P, (H P) H', + R
    gain = m**3 // 3 + 2 * m**2 * n  # factor, and two triangular solves with n right-hand sides
    return prediction + innovation + gain + 4 * m * n + half * m  # z - H m, m + K (...), P - K (H P)


def smoothing(runs: int = 10_000, steps: int = 100, gains_differ: bool = True) -> Problem:
    """The Kalman problem's states given all data of their run; with `gains_differ` False all gains are 1."""
    title, arrays, flops, bytes_ = kalman(runs, steps)
    if gains_differ:
        title = title.replace("Kalman step", "Kalman smoothing")
        return Problem(title, arrays, flops + smoothing_flops(4, 2), bytes_)
    arrays["gains"] = np.ones_like(arrays["gains"])
    title = "Kalman smoothing, 4 states, 2 measurements, gains that are the same in every run"
    return Problem(title, arrays, smoothed_mean_flops(4, 2), 8 * (2 + 4))


def filtering_planned(runs: int = 10_000, steps: int = 100) -> Problem:
    """Filtering of the smoothing problem whose gains do not differ: one covariance for all runs, means for each."""
    arrays = smoothing(runs, steps, gains_differ=False).arrays
    title = "Kalman filtering, 4 states, 2 measurements, gains that are the same in every run"
    n, m = 4, 2
    return Problem(title, arrays, 2 * n * n + 4 * n * m + m + n, 8 * (m + n))  # A m, z - C m, m + K e


def smoothing_flops(n: int, m: int) -> int:
    """A sweep back in the form of Bryson and Frazier after a filter: adjoint vector and matrix, and their use."""
    half = n * (n + 1)
    update = 2 * n * n + 2 * n * m + 2 * n**3 + half * n + m * half + half // 2  # B' l - W e, B' L B + W H
    transition, use = 2 * n * n + 2 * n**3 + half * n, 2 * n * n + n + 2 * n**3 + half * n + half // 2
    return update + transition + use


def smoothed_mean_flops(n: int, m: int) -> int:
    """Means alone, forward and back: A m, z - C m, m + K e; (B A)' l - (W A)' e, m - P l."""
    return 2 * n * n + 4 * n * m + 2 * n * n + 2 * n * m + 2 * n * n + n


def modes(runs: int = 10_000, steps: int = 100) -> Problem:
    """The Kalman problem's plant behind a link that is good or bad for a while, two gains of one Markov chain."""
    draw = np.random.default_rng(22)
    p = kalman(1, 1).arrays
    gains, chain = np.array([0.2, 1.0]), np.array([[0.95, 0.05], [0.03, 0.97]])
    n, m = 4, 2
    z, x = np.empty((runs, steps, m)), draw.normal(size=(runs, n))
    mode = draw.integers(2, size=runs)
    for k in range(steps):
        mode = (draw.random(runs) > chain[mode, 0]).astype(int)
        x = x @ p["A"].T + np.sqrt(0.1) * draw.normal(size=(runs, n))
        z[:, k] = gains[mode][:, None] * (x @ p["C"].T) + np.sqrt(0.2) * draw.normal(size=(runs, m))
    arrays = {name: p[name] for name in ("A", "C", "Q", "R", "mean", "covariance")}
    arrays |= {"gains": gains, "chain": chain, "law": np.array([0.5, 0.5]), "z": z}
    title = f"Interacting multiple models, 2 modes, {n} states, {m} measurements"
    return Problem(title, arrays, modes_flops(n, m, 2), 8 * (m + n))


def motion(runs: int = 10_000, steps: int = 100) -> Problem:
    """The Kalman problem's plant that is slower and five times as noisy for a while, two laws of one Markov chain."""
    draw = np.random.default_rng(23)
    p = kalman(1, 1).arrays
    laws, noises = np.array([p["A"], 0.8 * p["A"]]), np.array([p["Q"], 5.0 * p["Q"]])
    chain = np.array([[0.95, 0.05], [0.1, 0.9]])
    n, m = 4, 2
    z, x = np.empty((runs, steps, m)), draw.normal(size=(runs, n))
    mode = draw.integers(2, size=runs)
    for k in range(steps):
        mode = (draw.random(runs) > chain[mode, 0]).astype(int)
        moved = np.einsum("rij,rj->ri", laws[mode], x)
        x = moved + np.sqrt(noises[mode][:, 0, 0])[:, None] * draw.normal(size=(runs, n))
        z[:, k] = x @ p["C"].T + np.sqrt(0.2) * draw.normal(size=(runs, m))
    arrays = {name: p[name] for name in ("C", "R", "mean", "covariance")}
    arrays |= {"laws": laws, "noises": noises, "chain": chain, "law": np.array([0.5, 0.5]), "z": z}
    title = f"Interacting multiple models, 2 laws of motion, {n} states, {m} measurements"
    return Problem(title, arrays, modes_flops(n, m, 2), 8 * (m + n))


def modes_flops(n: int, m: int, count: int) -> int:
    """A Kalman step for each mode, its likelihood, and the moments of `count` mixtures of `count` Gaussians."""
    mixture = count * (2 * n + n + n * (n + 1))  # means, what is apart, their squares and covariances
    likelihood = 2 * m**2 + m + 2
    return count * (kalman_flops(n, m) + likelihood + 3) + count * count + count * mixture + mixture


# The induction machine of the cubature fusion paper, one node, in the strong scenario with known laws of the gains.
MACHINE = {"h": 0.1, "k1": 2.0, "k2": 2.0, "b1": -0.186, "b2": -1.778, "b3": 6.125, "b4": -6.234, "b5": 0.081}
START = np.array([0.25, -0.55, -0.4, 0.2, 0.15])
SENSOR_GAINS, RELAY_GAINS = ([0.7, 0.85, 1.0], [0.3, 0.3, 0.4]), ([0.8, 0.9, 1.0], [0.2, 0.3, 0.5])
AMPLITUDE, PROCESS, NOISE = 2.0, 1e-5, 1e-3  # NOISE: of sensor, relay and receiver


def transition(x: Any) -> list[Any]:
    """One Euler step of the machine; components first, so x may be one state or many."""
    h, k1, k2, b1, b2, b3, b4, b5 = MACHINE.values()
    slip = k1 - x[4]
    return [
        x[0] + h * (b1 * x[0] + k1 * x[1] + b2 * x[2] + k2),
        x[1] + h * (b1 * x[1] - k1 * x[0] + b2 * x[3]),
        x[2] + h * (b3 * x[0] + b4 * x[2] + slip * x[3]),
        x[3] + h * (b3 * x[1] - slip * x[2] + b4 * x[3]),
        x[4] + h * b5 * (x[0] * x[3] - x[1] * x[2]),
    ]


def moment(law: tuple[list[float], list[float]], order: int) -> float:
    """E g^order."""
    return float(np.asarray(law[1]) @ np.asarray(law[0]) ** order)


def cubature(runs: int = 20_000, steps: int = 40) -> Problem:
    """z = a xi gamma y + a xi m + n with y = C x + v: five states, two measurements, gains of known law alone."""
    draw = np.random.default_rng(21)
    c = np.array([[-4.448, 0, 1.11, 0, 0], [0, -4.448, 0, 1.11, 0]])
    x = START[:, None] + np.sqrt(0.02) * draw.normal(size=(5, runs))
    z = np.empty((runs, steps, 2))
    for k in range(steps):
        x = np.array(transition(x)) + np.sqrt(PROCESS) * draw.normal(size=x.shape)
        v, relay, receiver = np.sqrt(NOISE) * draw.normal(size=(3, 2, runs))
        gamma, xi = (draw.choice(law[0], size=runs, p=law[1]) for law in (SENSOR_GAINS, RELAY_GAINS))
        z[:, k] = (AMPLITUDE * xi * (gamma * (c @ x + v) + relay) + receiver).T
    mean = AMPLITUDE * moment(SENSOR_GAINS, 1) * moment(RELAY_GAINS, 1)
    power = AMPLITUDE**2 * moment(SENSOR_GAINS, 2) * moment(RELAY_GAINS, 2)
    noise = (AMPLITUDE**2 * moment(RELAY_GAINS, 2) + 1) * NOISE
    arrays = {
        "C": c, "Q": PROCESS * np.eye(5), "R": NOISE * np.eye(2), "gain": np.array(mean),
        "gain_variance": np.array(power - mean**2), "noise": noise * np.eye(2), "mean": START,
        "covariance": 0.02 * np.eye(5), "z": z,
    }  # fmt: skip
    title = "Cubature filter with relay gains, 5 states, 2 measurements"
    return Problem(title, arrays, cubature_flops(5, 2, 35), 8 * (2 + 5))


def cubature_flops(n: int, m: int, function: int) -> int:
    """As `kalman_flops`: factor and points, 2 n values of a function of so many flops, their moments, then the update.

    The sensor is linear, so its moments are products with C and no second factor is needed.
    """
    factor, points = n**3 // 3 + n**2, n * (n + 1) // 2 + 2 * n * (n + 1) // 2
    moments = 2 * n * n + 2 * n * n + 2 * n * n * (n + 1) + n
    sensor = 2 * m * n + 2 * m * n**2 + m * (m + 1) * n + m
    relay = 5 * m * (m + 1) // 2  # Omega = var g (Pyy + y y') + mu^2 Pyy + N
    update = m * n + m**3 // 3 + 2 * m**2 * n + 2 * m + 2 * m * n + n * (n + 1) * m
    return factor + points + 2 * n * function + moments + sensor + relay + update
