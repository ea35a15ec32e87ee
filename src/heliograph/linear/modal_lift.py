"""A linear model behind links that remember, lifted to monomials and to the modes: again one linear system."""

from collections.abc import Sequence

import numpy as np

from heliograph.linear.moments_over_time import EPS, SteadyMoments, check_moments
from heliograph.linear.system import LinearSystem, Steps, over_horizon
from heliograph.numerics.types import Float
from heliograph.random_affine.atoms import GainAndNoise
from heliograph.random_affine.modes import JointModes
from heliograph.random_affine.moments.push import push, second_moments


def lifted_modes(
    plants: Sequence[GainAndNoise],
    measurements: Sequence[JointModes],
    degree: int,
    moments: Float[np.ndarray, " monomials"],
    projection: Float[np.ndarray, "n L"],
) -> LinearSystem:
    """The system of Y 1{mode} for every mode, Y = (monomials of x up to `degree`, 1), measured by those of z.

    E[Y+ 1{j}] = sum_i Pi_ij M Y 1{i} and E[Z | Y, modes] = sum_j K_j Y 1{j}, with M and K_j the moments of the plant
    and of the route in mode j. Noises, with B = E[Y Y']:
    Cov(w) = sum_i p_i (diag(Pi_i) - Pi_i' Pi_i) x M B M' + diag(p+) x (B+ - M B M'),
    Cov(v) = sum_j p_j (E[Z Z' | j] - K_j B+ K_j').

    `plants` and `measurements` (from x+ to z) of each step; `moments` of x_0 up to 2 degree; `projection` reads x off
    Y.
    """
    n, modes = plants[0].inputs, len(measurements[0].initial)
    law, rows = np.asarray(measurements[0].initial), np.eye(modes)
    before = second_moments(moments, n + 1, degree)
    mean = np.kron(law, before[:, -1])
    start = np.kron(np.diag(law), before) - np.outer(mean, mean)
    parts, rounding, earlier = [], [], law
    distinct = {id(measurement): measurement for measurement in measurements}
    of_modes = {place: item.moments(degree) for place, item in distinct.items()}
    of_plant = {place: np.asarray(p.moments(degree).matrix) for place, p in {id(p): p for p in plants}.items()}
    # Where nothing varies, and the moments and the law have come to stay, all later steps are as the last, to rounding.
    steady = SteadyMoments(np.asarray(plants[0].matrix), 2 * degree, varies=len(of_modes) > 1 or len(of_plant) > 1)
    for k, (plant, measurement) in enumerate(zip(plants, measurements, strict=True)):
        if steady.stays(moments) and np.array_equal(law, earlier) and k > 1:
            break
        earlier = law
        moved, means = of_plant[id(plant)], of_modes[id(measurement)]
        with np.errstate(over="ignore", invalid="ignore"):  # what overflows is refused
            moments = np.asarray(push(plant, 2 * degree, moments))
        check_moments(moments, k, 2 * degree)
        after, carried = second_moments(moments, n + 1, degree), moved @ before @ moved.T
        chosen = np.einsum("i,ij,ijl->jl", law, rows, np.eye(modes)[None] - rows[:, None, :])
        law = _stays(law, law @ rows)
        process = np.kron(chosen, carried) + np.kron(np.diag(law), after - carried)
        noise = np.zeros((1, 1))
        for p, matrix, route in zip(law, means, measurement.maps, strict=True):
            arrives = second_moments(push(route, 2 * degree, moments), route.outputs + 1, degree)
            noise = noise + p * (np.asarray(arrives) - matrix @ after @ matrix.T)
        output = np.concatenate(list(means), axis=1)[:-1]
        zero = np.zeros(len(mean)), np.zeros(len(output))
        parts.append((np.kron(rows.T, moved), zero[0], process, output, zero[1], noise[:-1, :-1]))
        rounding.append(EPS * np.kron(law, np.diag(after)))
        before, rows = after, np.asarray(measurement.transition)
    steps = Steps(*(over_horizon(part, len(plants)) for part in zip(*parts, strict=True)))
    return LinearSystem(steps, mean, start, np.tile(projection, (1, modes)), over_horizon(rounding, len(plants)))


def _stays(law: Float[np.ndarray, " modes"], after: Float[np.ndarray, " modes"]) -> Float[np.ndarray, " modes"]:
    """The law after a step; itself where it only flips last bits."""
    return law if np.allclose(law, after, rtol=4 * EPS, atol=0) else after
