"""The oracle's systems with bias and relay as heliograph models, and the half-vectorised part of its covariances."""

from typing import NamedTuple

import numpy as np

import heliograph as hg
from tests.oracles import quadratic_bias as oracle


class Model(NamedTuple):
    """Plant with bias, sensor and relay."""

    plant: hg.model.OverTime
    sensor: hg.LinearSensor
    channel: hg.random_affine.AbstractRandomAffine


def support(law):
    return hg.random_affine.FiniteSupport(law.points, law.chance)


def powers(law):
    return hg.Discrete(np.sqrt(law.points[:, 0]), law.chance)


def model(s: oracle.System, horizon: int, initial=None) -> Model:
    """`initial`: law or covariance of x_0 in place of the oracle's."""
    n, extra = s.C.shape[1], len(s.F)
    bias = hg.LinearPlant(s.F, support(s.xi), np.zeros(extra), support(s.eps0))
    start = support(s.x0) if initial is None else initial
    measuring = hg.LinearSensor(s.C, hg.random_affine.Shaped(s.D, support(s.v)))

    def at_time(t):
        state = hg.LinearPlant(s.A(t), hg.random_affine.Shaped(s.B, support(s.w)), np.zeros(n), start)
        return hg.model.with_bias(state, measuring, bias, coupling=s.E(t))

    plants, (sensor, *_) = zip(*(at_time(t) for t in range(horizon)), strict=True)
    plant = hg.model.over_time(plants)
    first = hg.random_affine.GainAndNoise(powers(s.l), s.Phi, support(s.varpi))
    second = hg.random_affine.GainAndNoise(powers(s.m), s.theta * s.Psi, support(s.sigma))
    return Model(plant, sensor, hg.amplify_and_forward([first, second]))


def half(d: int) -> tuple[np.ndarray, np.ndarray]:
    """Where each monomial y_i y_j or y_i 1 of the library stands in the oracle's [y; y (x) y], and its duplicates."""
    places, weights = [], []
    for i in range(d):
        for j in range(i, d):
            places.append(d + d * i + j)
            weights.append((d + d * i + j, d + d * j + i))
        places.append(i)
        weights.append((i, i))
    spread = np.zeros((d + d * d, len(places)))
    for column, (a, b) in enumerate(weights):
        spread[a, column] = spread[b, column] = 1.0
    return np.array(places), spread


def random_law(generator, dimension, atoms):
    points, chance = generator.normal(size=(atoms, dimension)), generator.dirichlet(np.ones(atoms))
    return oracle.Atoms(points - chance @ points, chance)


def two_sensors() -> oracle.System:
    """Time-varying, every dimension above 1 but the bias, correlated vector noises, a sensor that is off at times."""
    g = np.random.default_rng(0)

    def varying(t, rows, columns):
        return np.random.default_rng(t).normal(size=(rows, columns)) * 0.6

    return oracle.System(
        A=lambda t: varying(t, 2, 2), E=lambda t: varying(t + 50, 2, 1), B=g.normal(size=(2, 2)), F=np.array([[0.4]]),
        C=g.normal(size=(2, 2)), D=g.normal(size=(2, 2)), Phi=np.diag([0.7, 1.2]), Psi=np.diag([1.1, 0.6]), theta=1.3,
        l=oracle.Atoms(np.array([[0.0], [1.0], [2.0]]), np.array([0.3, 0.3, 0.4])),
        m=oracle.Atoms(np.array([[0.5], [1.5]]), np.array([0.4, 0.6])),
        x0=random_law(g, 2, 4), eps0=random_law(g, 1, 3), w=random_law(g, 2, 4), xi=random_law(g, 1, 3),
        v=random_law(g, 2, 4), varpi=random_law(g, 2, 3), sigma=random_law(g, 2, 4),
    )  # fmt: skip


def scalar_system() -> oracle.System:
    """Two values for everything, so that all paths of two steps can be listed."""
    return oracle.System(
        A=lambda t: np.array([[0.8 + 0.1 * t]]), E=lambda t: np.array([[0.5]]), B=np.eye(1), F=np.array([[0.6]]),
        C=np.array([[1.0]]), D=np.array([[0.3]]), Phi=np.eye(1), Psi=np.eye(1), theta=1.2,
        l=oracle.Atoms(np.array([[0.25], [1.0]]), np.array([0.4, 0.6])),
        m=oracle.Atoms(np.array([[0.81], [1.44]]), np.array([0.5, 0.5])),
        x0=oracle.two_point(-0.5, 1.0, 2 / 3), eps0=oracle.two_point(-0.6, 0.2, 0.25),
        w=oracle.two_point(1.2, -0.3, 0.2), xi=oracle.two_point(-0.4, 0.6, 0.6), v=oracle.two_point(0.7, -1.3, 0.65),
        varpi=oracle.two_point(-0.9, 0.1, 0.1), sigma=oracle.two_point(-0.35, 0.15, 0.3),
    )  # fmt: skip
