"""Six sensors of a plant of three states, over one hop or two, as paths from arrays; path loss d^3, noise 1."""

import numpy as np
from scipy.linalg import solve_discrete_are

from heliograph.planning import independent_paths
from heliograph.planning.multihop_paths.model import Paths

PLANT = (np.array([[0.95, 0.1, 0], [0, 0.9, 0.2], [0, -0.1, 0.8]]), np.diag([0.1, 0.05, 0.2]))
ROWS = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 0], [0, 1, -1], [1, 0, 1]], dtype=float)
NOISES = np.array([0.5, 0.4, 0.3, 0.6, 0.5, 0.8])
NEAR, FAR = np.array([1.2, 0.7, 1.9, 1, 1.5, 0.5]), np.array([0.8, 1.6, 0.6, 1.3, 0.9, 1.8])
KAPPA = np.array([1.02, 1.05, 1.02, 1.1, 1.02, 1.05])


def direct_paths(error=None) -> Paths:
    """Each sensor over a single hop."""
    return independent_paths(*PLANT, ROWS, NOISES, KAPPA, NEAR**3 / KAPPA, error)


def relayed_paths() -> Paths:
    """Each sensor through a relay."""
    return independent_paths(*PLANT, ROWS, NOISES, 1.02, np.stack([NEAR, FAR], axis=1) ** 3 / 1.02)


def random_paths(seed, n=3, sensors=5, error=None, unstable=False) -> Paths:
    """A stable plant (or one that grows) with process noise of rank 2, and sensors with all numbers drawn."""
    draw = np.random.default_rng(seed)
    a = draw.normal(size=(n, n))
    a *= (1.1 if unstable else draw.uniform(0.5, 0.98)) / np.abs(np.linalg.eigvals(a)).max()
    b = draw.normal(size=(n, 2))
    return independent_paths(
        a,
        b @ b.T,
        draw.normal(size=(sensors, n)),
        draw.uniform(0.1, 1.0, sensors),
        1 + draw.uniform(0, 0.3, sensors),
        draw.uniform(0.1, 3.0, sensors),
        error,
        draw.normal(size=n),
        np.eye(n) if unstable else None,
    )


def paths_in_two_units(seed) -> tuple[Paths, Paths, np.ndarray]:
    """Process noise of rank one; the same plant with states in units over eight decades, and these units."""
    draw = np.random.default_rng(seed)
    a = draw.normal(size=(3, 3))
    a *= 0.95 / np.abs(np.linalg.eigvals(a)).max()
    b, c, units = draw.normal(size=(3, 1)), draw.normal(size=(4, 3)), 10.0 ** draw.uniform(-4, 4, 3)
    rest = ([0.5, 0.4, 0.3, 0.6], 1.05, draw.uniform(0.1, 3.0, 4))
    plain = independent_paths(a, b @ b.T, c, *rest)
    scaled = independent_paths(a * units[:, None] / units, (b @ b.T) * np.outer(units, units), c / units, *rest)
    return plain, scaled, units


def powers_of(design) -> np.ndarray:
    """Powers (time, hop) of a design."""
    return np.transpose(list(design.powers.values()))


def steady(paths: Paths, powers):
    """Error covariance of one-hop paths at steady powers (M,), by SciPy from the noise of each path."""
    a, q, c = paths.plants.transition[0], paths.plants.process[0], paths.rows[0]
    s, t, kappa, alpha = paths.second[0], paths.signal[0], paths.kappa[0], paths.alpha[0]
    on = np.asarray(powers) > 0
    noise = np.diag(s[on] * kappa[on] * (1 + alpha[on] / np.asarray(powers)[on]) - t[on])
    predicted = solve_discrete_are(a.T, c[on].T, q, noise)
    gain = np.linalg.solve(c[on] @ predicted @ c[on].T + noise, c[on] @ predicted).T
    return predicted - gain @ c[on] @ predicted


def error_at(paths: Paths, powers) -> float:
    """Its trace."""
    return float(np.trace(steady(paths, powers)))
