"""The designs of each node, what they certify, and the smallest levels under several readings."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import product
from typing import NamedTuple

import numpy as np

import heliograph as hg
from heliograph.h_infinity.certificate import make_theorem_matrix
from heliograph.h_infinity.solver import Objective
from heliograph.numerics.check import fail
from heliograph.numerics.types import Float
from heliograph_studies.h_infinity_fusion.setting import NODES, Constant, Setting

OBJECTIVES: tuple[Objective, ...] = ("trace", "log_determinant", "largest_eigenvalue")
LARGER_GROWTH = 1.1
ACCURACY = 1e-10  # relative, of a level found by bisection


@dataclass(frozen=True)
class NodeDesigns:
    """One node: the recursive design at the paper's level with its certificate, and what else can be had.

    failed: the step at which each objective finds no gain at the paper's level (None: it finds all). smallest: the
    smallest level of the recursion by objective, with P_0 free.
    """

    paper: hg.h_infinity.HInfinityDesign
    certificate: hg.h_infinity.HInfinityCertificate
    failed: dict[Objective, int | None]
    smallest: dict[Objective, float]
    horizon: hg.h_infinity.HInfinityDesign
    horizon_certificate: hg.h_infinity.HInfinityCertificate
    separate: hg.h_infinity.HInfinityDesign
    zero_gain: hg.h_infinity.HInfinityDesign
    without_measurements: float


@dataclass(frozen=True)
class Readings:
    """Smallest levels over the horizon of readings of the example, common to all nodes or of node 1.

    fixed_start: with P_0 = 10 I. larger_growth: with a = 1.1, (node, 2) for one and separate multipliers. lossless: of
    node 1 with every arrival certain. without_feedthrough: of node 1 with D = 0, best gains and K = 0.
    """

    fixed_start: float
    larger_growth: np.ndarray
    lossless: float
    without_feedthrough: tuple[float, float]


def node_designs(setting: Setting, node: int) -> NodeDesigns:
    """All of one node."""
    system, level = setting.system(node), setting.levels[node]
    start = setting.initial * np.eye(4)
    # The recursion (32) at the paper's level, by what picks one of its solutions.
    tried = {o: hg.h_infinity.recursive_design(system, level, start, o, search=False) for o in (*OBJECTIVES, "none")}
    paper, horizon = tried["trace"], hg.h_infinity.horizon_design(system)
    if not paper.feasible:
        raise fail(f"design of node {node + 1}", "one that is feasible at the paper's level", paper.status)
    # And at its smallest level, over the whole horizon, and with K = 0.
    return NodeDesigns(
        paper,
        certify(system, paper),
        {o: design.failed_step for o, design in tried.items()},
        {o: hg.h_infinity.recursive_design(system, objective=o).level for o in OBJECTIVES},
        horizon,
        certify(system, horizon),
        hg.h_infinity.horizon_design(system, separate=True),
        without_gain(system),
        level_without_measurements(system),
    )


def level_without_measurements(system: hg.h_infinity.GrowthSystem) -> float:
    """Compute the smallest level that Theorem 1 proves for K = 0, the filter that ignores what it receives.

    P+ = (I / lambda + [B; B][B; B]' / level^2)^-1 with the largest lambda for which
    P - diag(0, M'M) - lambda diag(a^2 I, a~^2 I) stays positive; the channel plays no part. A design is worth its
    measurements where its level is below this one.

    Args:
        system: a system from `growth_system` whose dynamics are all in f, with growth constants above zero.

    Raises:
        ValueError: a system with a linear part A, or with a growth constant of zero.
    Source: H-infinity fusion over amplify-and-forward relays, Theorem 1 with K = 0 (closed form not in the paper).
    """
    if np.any(system.transition):
        raise fail("level without measurements", "a system whose dynamics are all in f", "one with a linear part A")
    growth = np.stack([system.growth.state, system.growth.error], axis=1)
    if np.any(growth == 0):
        raise fail("level without measurements", "growth constants above zero", "a zero")
    scale = np.repeat(growth, system.states, axis=1)
    low, high = 0.0, 1.0
    while not _survives(system, scale, high):
        low, high = high, 2 * high
    while high - low > ACCURACY * high:
        middle = (low + high) / 2
        low, high = (low, middle) if _survives(system, scale, middle) else (middle, high)
    return high


def _survives(system: hg.h_infinity.GrowthSystem, scale: Float[np.ndarray, "steps _"], level: float) -> bool:
    """Decide whether the recursion for K = 0 stays positive over the whole horizon at this level."""
    n = system.states
    weight = level**2 * system.initial_weight
    for k in range(system.steps):
        reduced = weight.copy()
        reduced[n:, n:] -= system.target[k].T @ system.target[k]
        multiplier = np.linalg.eigvalsh(reduced / np.outer(scale[k], scale[k]))[0]
        if multiplier <= 0:
            return False
        both = np.concatenate([system.disturbance[k]] * 2)
        weight = np.linalg.inv(np.eye(2 * n) / multiplier + both @ both.T / level**2)
    return True


def certify(
    system: hg.h_infinity.GrowthSystem,
    design: hg.h_infinity.HInfinityDesign,
    growth: Sequence[hg.h_infinity.GrowthFinding] = (),
) -> hg.h_infinity.HInfinityCertificate:
    """Check a design by Theorem 1."""
    return hg.h_infinity.certify_level(system, design.gains, design.weights, design.multipliers, design.level, growth)


def without_gain(system: hg.h_infinity.GrowthSystem, separate: bool = False) -> hg.h_infinity.HInfinityDesign:
    """The smallest level that can be proven for K = 0."""
    nothing = np.zeros((system.steps, system.states, system.received))
    return hg.h_infinity.horizon_design(system, separate, gains=nothing)


def readings(setting: Setting) -> Readings:
    """Levels of the example read in other ways."""
    larger = [
        [hg.h_infinity.horizon_design(setting.system(i, LARGER_GROWTH), s).level for s in (False, True)]
        for i in range(len(NODES))
    ]
    first = setting.system(0)
    plain = first._replace(feedthrough=np.zeros_like(first.feedthrough))
    return Readings(
        hg.h_infinity.horizon_design(first, initial=setting.initial * np.eye(4)).level,
        np.array(larger),
        hg.h_infinity.horizon_design(setting.system(0, hop=setting.lossless)).level,
        (hg.h_infinity.horizon_design(plain).level, without_gain(plain).level),
    )


@dataclass(frozen=True)
class TrueGrowth:
    """Levels (node, 2), for one and separate multipliers, with growth constants that the search did not refute.

    constant: the largest slope for f and f~; differences: 0.7 for f and the largest slope for f~; each_step: 0.7 for
    f and each step's slope for f~. certified: whether every one of them is.
    """

    constant: np.ndarray
    differences: np.ndarray
    each_step: np.ndarray
    certified: bool


def true_growth(setting: Setting, findings: list[hg.h_infinity.GrowthFinding]) -> TrueGrowth:
    """Design with the slopes found in the boxes of the steps, and certify with the findings."""
    allowed = [f._replace(constant=f.slope * (1 + 1e-6)) for f in findings]  # rounding of the largest ratio
    slopes = np.array([f.constant for f in allowed])
    largest = float(slopes.max())
    nominal = np.full(len(slopes), setting.growth)
    given: list[Constant | tuple[Constant, Constant]]
    given = [largest, (setting.growth, largest), (hg.model.OverTime(nominal), hg.model.OverTime(slopes))]
    levels, certified = np.zeros((3, len(NODES), 2)), True
    for i, growth in enumerate(given):
        for node in range(len(NODES)):
            system = setting.system(node, growth)
            for separate in (False, True):
                design = hg.h_infinity.horizon_design(system, separate)
                certified &= certify(system, design, allowed).certified
                levels[i, node, int(separate)] = design.level
    return TrueGrowth(levels[0], levels[1], levels[2], certified)


def published_fused_level(levels: Sequence[float], weights: Sequence[float] | np.ndarray) -> float:
    """sqrt(2 N sum c_i^2 gamma_i^2) for N filters; it exceeds every local level where those are alike.

    `hg.fusion.level_weights` are its minimum on the simplex. A strict matrix inequality has that minimum as its infimum
    only, so solvers approach it without reaching it.

    Source: H-infinity quantized fusion over amplify-and-forward relays, equation (33).
    """
    c, gamma = np.asarray(weights), np.asarray(levels)
    return float(np.sqrt(2 * len(gamma) * np.sum((c * gamma) ** 2)))


WIDTHS = (2, 2, 2, 2, 1, 1, 1, 3)  # x, e, f, f~, h, h~, v, rho
POINTS = 50  # for each node


class Trial(NamedTuple):
    """Gains, weights of this step and the next, and multipliers, all random; (18) is an identity in them."""

    gain: np.ndarray
    weight: np.ndarray
    following: np.ndarray
    multipliers: np.ndarray


def enumeration_gap(setting: Setting, node: int, seed: int = 0) -> float:
    """Largest difference between eta' Phi eta and the same from (1) to (6), relative to the size of its terms."""
    system, random, worst, level = setting.system(node), np.random.default_rng(seed), 0.0, setting.levels[node]
    for _ in range(POINTS):
        weights = np.zeros((2, 4, 4))
        for block in (slice(0, 2), slice(2, 4)):
            root = random.normal(size=(2, 2, 2))
            weights[:, block, block] = root @ np.swapaxes(root, 1, 2)
        trial = Trial(random.normal(size=(2, 2)), weights[0], weights[1], random.uniform(size=2))
        eta = random.normal(size=sum(WIDTHS))
        phi = make_theorem_matrix(system, 0, *trial[:3], np.repeat(trial.multipliers, 2), level)
        counted, size = _counted(setting, node, trial, np.split(eta, np.cumsum(WIDTHS)[:-1]))
        worst = max(worst, abs(float(eta @ phi @ eta) - counted) / size)
    return worst


def _counted(setting: Setting, node: int, trial: Trial, parts: list[np.ndarray]) -> tuple[float, float]:
    """E V(next) - V + |M e|^2 - gamma^2 (|v|^2 + |rho|^2) + sum lambda (...) from the equations, and its size."""
    x, e, f, df, h, dh, v, rho = parts
    lam, a, b, expected = trial.multipliers, setting.growth, setting.output_growth(node), 0.0
    for outcome in product((0, 1), repeat=3):
        chance = float(np.prod([p if b else 1 - p for p, b in zip(setting.arrival, outcome, strict=True)]))
        driven = setting.B @ v
        after = np.concatenate(
            [f + driven, df + driven - trial.gain @ _innovation(setting, node, outcome, h, dh, v, rho)]
        )
        expected += chance * float(after @ trial.following @ after)
    xi, missed = np.concatenate([x, e]), setting.M @ e
    terms = [
        expected, -xi @ trial.weight @ xi, missed @ missed, -(setting.levels[node] ** 2) * (v @ v + rho @ rho),
        lam[0] * (a**2 * xi @ xi - f @ f - df @ df), lam[1] * (b**2 * xi @ xi - h @ h - dh @ dh),
    ]  # fmt: skip
    return float(sum(terms)), float(sum(map(abs, terms)))


def _innovation(
    setting: Setting, node: int, outcome: tuple[int, ...], h: np.ndarray, dh: np.ndarray, v: np.ndarray, rho: np.ndarray
) -> np.ndarray:
    """Received less expected, (3) to (6), for one outcome of the losses."""
    (b1, b2, b3), (p1, p2, p3), e = outcome, setting.arrival, np.sqrt(setting.powers)
    y, n = h + setting.feedthrough[node] * v, np.array(setting.noise_gain) * rho
    r = e[1] * b2 * (e[0] * b1 * y + n[0]) + n[1]
    direct = e[2] * b3 * y + n[2]
    result: np.ndarray = np.concatenate([r - e[0] * e[1] * p1 * p2 * (h - dh), direct - e[2] * p3 * (h - dh)])
    return result
