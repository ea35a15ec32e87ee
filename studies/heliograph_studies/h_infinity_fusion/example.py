"""The example's networks and runs, what a = 0.7 is worth where these go, the indices J_1 and J_2, and the quantizer."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import jax.numpy as jnp
import numpy as np

import heliograph as hg
from heliograph.filters.gaussian.gaussian import GaussianFilter
from heliograph.filters.wrappers.fed_back import prediction_of
from heliograph.fusion.quantizer import Quantizer
from heliograph_studies import sampled
from heliograph_studies.h_infinity_fusion.setting import NODES, PAPER_FUSED_LEVEL, Hop, Setting, dynamics
from heliograph_studies.h_infinity_fusion.worst_disturbance import World, Worst, worst_disturbance

RECURSIVE = "recursive_trace"  # the paper's filters, at its levels
QUANTIZERS = "none", "dynamic", "static"
MORE_QUANTIZERS = "dynamic_decodable", "static_odd"  # of the paper's filters only


def zoom(setting: Setting) -> hg.fusion.ZoomQuantizer:
    """The paper's dynamic quantizer."""
    return hg.fusion.ZoomQuantizer(setting.segments, setting.amplitude, setting.decay, setting.zoom)


def quantizers(setting: Setting) -> dict[str, Quantizer | None]:
    """All of them by name; `static_odd` and what can be decoded have one level more where the paper's are even."""
    odd, size = setting.segments | 1, setting.amplitude  # of levels: with an odd number zero is one
    return {
        "none": None,
        "dynamic": zoom(setting),
        "static": hg.fusion.UniformQuantizer(setting.segments, size),
        "dynamic_decodable": hg.fusion.EscapeQuantizer(odd, size, setting.decay, 0.6, 1e-3),
        "static_odd": hg.fusion.UniformQuantizer(odd, size),
    }


@dataclass(frozen=True)
class Runs:
    """The runs of one network, with the names of its filters."""

    setting: Setting
    record: hg.Record
    filters: tuple[str, ...]

    @property
    def runs(self) -> int:
        """Number of runs."""
        return len(self.errors(self.filters[0], "none"))

    def errors(self, name: str, quantizer: str) -> np.ndarray:
        """Norm of the fused error, (run, time)."""
        return np.asarray(np.linalg.norm(self.record.errors("fused", fused_name(name, quantizer)), axis=-1))

    def mean_error(self, name: str, quantizer: str) -> "Mean":
        """Mean norm of the fused error over runs and steps, and its standard error."""
        return Mean(*sampled(self.errors(name, quantizer).mean(axis=1)))

    def estimates(self, name: str) -> np.ndarray:
        """Local estimates (run, node, time, n)."""
        return np.stack([np.asarray(self.record.estimates[n][name].mean) for n in NODES], axis=1)

    @property
    def truth(self) -> np.ndarray:
        """The state (time, n), the same in all runs."""
        assert self.record.truth is not None
        return np.asarray(self.record.truth[0])


class Mean(NamedTuple):
    """A mean over runs and its standard error."""

    mean: float
    se: float


Designs = Mapping[str, list[hg.h_infinity.HInfinityDesign]]  # by name, one for each node


def fused_name(name: str, quantizer: str) -> str:
    """Under which name the fused estimate of a filter behind a quantizer stands."""
    return f"{name}.{quantizer}"


def simulate(setting: Setting, designs: Designs) -> Runs:
    """All filters of one record but those that know of losses; `designs` by name, one for each node."""
    nodes = {
        node: hg.Node(setting.disturbed_sensor(i), setting.disturbed_channel(), filters(setting, i, designs))
        for i, node in enumerate(NODES)
    }
    return _run(setting, nodes)


def filters(setting: Setting, node: int, designs: Designs) -> dict[str, hg.filters.AbstractFilter]:
    """The filters of one node that receive the losses as they are."""
    return {
        **h_infinity_filters(setting, node, designs),
        "open_loop": hg.filters.open_loop_filter(believed_plant(setting), *start(setting, node)),
        "ekf_ignoring": prediction_of(extended(setting, node, setting.lossless)),
        "ekf_statistics": prediction_of(extended(setting, node, setting.lossy)),
    }


def h_infinity_filters(setting: Setting, node: int, designs: Designs) -> dict[str, hg.filters.AbstractFilter]:
    """The designed filters of one node."""
    parts = setting.plant(False), setting.sensor(node, 0.0), setting.system(node)
    return {
        name: hg.h_infinity.h_infinity_filter(*parts, design[node], setting.guesses[node])
        for name, design in designs.items()
    }


def simulate_known(setting: Setting) -> Runs:
    """Extended Kalman filters that know of each loss, in a network whose losses are erasures; other draws."""
    nodes = {
        node: hg.Node(
            setting.disturbed_sensor(i),
            setting.disturbed_channel(setting.known),
            {"ekf_known": prediction_of(extended(setting, i, setting.lossless))},
        )
        for i, node in enumerate(NODES)
    }
    return _run(setting, nodes)


def believed_plant(setting: Setting) -> hg.Plant:
    """v as white noise, as strong as v_s in the mean over the horizon."""
    return setting.plant(False, float(np.mean(setting.disturbances**2)))


def start(setting: Setting, node: int) -> tuple[np.ndarray, np.ndarray]:
    """First estimate of a node and the covariance believed of it."""
    return np.array(setting.guesses[node]), setting.initial_variance * np.eye(2)


def extended(setting: Setting, node: int, hop: Hop) -> GaussianFilter:
    """An extended Kalman filter of one node, which believes in links of one kind and in white noises."""
    noise = float(setting.feedthrough[node] ** 2 * np.mean(setting.disturbances**2))
    return hg.extended_filter(
        believed_plant(setting), setting.sensor(node, noise), setting.white_channel(hop), None, *start(setting, node)
    )


def _run(setting: Setting, nodes: dict[str, hg.Node]) -> Runs:
    names = tuple(next(iter(nodes.values())).filters)
    rule = hg.fusion.WeightedFusion(hg.fusion.level_weights(setting.levels))
    available = quantizers(setting)
    pairs = [(name, quantizer) for name in names for quantizer in QUANTIZERS]
    if RECURSIVE in names:
        pairs += [(RECURSIVE, quantizer) for quantizer in MORE_QUANTIZERS]
    fused = {fused_name(n, q): hg.Fusion(n, rule, available[q]) for n, q in pairs}
    network = hg.Network(setting.plant(), nodes, fused)
    record = hg.monte_carlo(network, setting.steps, setting.runs, setting.seed, inputs=setting.inputs())
    return Runs(setting, record, names)


def arrivals(outcome: Runs) -> np.ndarray:
    """beta_1, beta_2, beta_3 of each run, node and step, (run, node, time, 3).

    r = beta_2 (beta_1 y + C_1 rho_1) + C_2 rho_2 and y_2 = sqrt(E_3) beta_3 y + C_3 rho_3, each the nearest of the two
    values that it can have; beta_1 is NaN where beta_2 = 0, since then nobody can tell.
    """
    setting = outcome.setting
    z = np.stack([outcome.record.measurements[n] for n in NODES], axis=1)
    n1, n2, n3 = (np.array(setting.noise_gain) * setting.channel_noises).T
    sensing, through = np.array(setting.sensing)[:, None], np.array(setting.feedthrough)[:, None]
    y = sensing * outcome.truth.sum(axis=1) + through * setting.disturbances
    second = z[..., 0] != n2
    first = np.abs(z[..., 0] - n2 - n1) > np.abs(z[..., 0] - n2 - n1 - y)
    direct = np.abs(z[..., 1] - n3) > np.abs(z[..., 1] - n3 - np.sqrt(setting.powers[2]) * y)
    return np.stack([np.where(second, first, np.nan), second, direct], axis=-1).astype(float)


MARGIN = 0.1  # of the box's width, added on each side
ENERGIES = (5e4, 1e5, 2e5)  # starts of some 60, where the cosine of f changes its sign
SEARCH_DRAWS, JUDGE_DRAWS = 4, 2_000
RANGE = 2.0  # |x_j| <= 2: the range over which the paper's figures run


@dataclass(frozen=True)
class Growth:
    """Findings about a = 0.7: at each step in the box visited there, and at the last step over the whole range.

    size: whether |f(x)| <= 0.7 |x| there. secant (time,): the largest |f(x) - f(xhat)| / |x - xhat| that happened.
    """

    visited: list[hg.h_infinity.GrowthFinding]
    whole: hg.h_infinity.GrowthFinding
    size: hg.h_infinity.GrowthFinding
    secant: np.ndarray

    @property
    def slopes(self) -> np.ndarray:
        """Largest slope at each step, (time,)."""
        return np.array([finding.slope for finding in self.visited])


def growth(outcome: Runs) -> Growth:
    """Search around the truth and the paper's filters' estimates of these runs."""
    setting, estimates, truth, visited = outcome.setting, outcome.estimates(RECURSIVE), outcome.truth, []
    for s in range(setting.steps):
        points = np.concatenate([estimates[:, :, s].reshape(-1, 2), truth[s : s + 1]])
        low, high = points.min(axis=0), points.max(axis=0)
        pad = MARGIN * (high - low)
        visited.append(hg.h_infinity.check_growth(dynamics(s), setting.growth, low - pad, high + pad, f"f at s = {s}"))
    side, last = np.full(2, RANGE), setting.steps - 1
    f = dynamics(last)
    whole = hg.h_infinity.check_growth(f, setting.growth, -side, side, f"f at s = {last}")
    size = hg.h_infinity.check_growth(f, setting.growth, -side, side, f"|f| at s = {last}", differences=False)
    return Growth(visited, whole, size, _secant(truth, estimates))


def _secant(truth: np.ndarray, estimates: np.ndarray) -> np.ndarray:
    s = np.arange(len(truth))

    def f(x: np.ndarray) -> np.ndarray:
        return 0.7 * np.stack([x[..., 0] * np.cos(0.1 * x[..., 1]), x[..., 1] * np.sin(s * x[..., 0])], axis=-1)

    moved = np.linalg.norm(f(truth) - f(estimates), axis=-1)
    result: np.ndarray = (moved / np.linalg.norm(truth - estimates, axis=-1)).max(axis=(0, 1))
    return result


def violation(setting: Setting, node: int, design: hg.h_infinity.HInfinityDesign) -> Worst:
    """The worst disturbance found for a node's filter; where its level is above the design's, the theorem is broken."""
    believed, sensor = setting.plant(False), setting.sensor(node, 0.0)
    item = hg.h_infinity.h_infinity_filter(believed, sensor, setting.system(node), design)
    judges = setting.draws(SEARCH_DRAWS, 1), setting.draws(JUDGE_DRAWS, 2)
    return worst_disturbance(item, world(setting, node), *judges, ENERGIES, starts=16)


def world(setting: Setting, node: int) -> World:
    """The example for a search for the worst disturbance."""
    sensing = setting.sensing[node]
    return World(
        lambda x, k: dynamics(k)(x),
        lambda x: sensing * jnp.sum(x, keepdims=True),
        setting.B,
        np.array([[setting.feedthrough[node]]]),
        setting.M,
        setting.weight * np.eye(4),
        setting.inputs(),
    )


ZERO = "zero_estimate"  # xhat = 0


@dataclass(frozen=True)
class Indices:
    """By filter: J_1 of each node, and J_2 of the fused estimate behind the dynamic quantizer."""

    local: dict[str, np.ndarray]
    fused: dict[str, float]
    fused_energy: dict[str, float]


@dataclass(frozen=True)
class Replayed:
    """The dynamic quantizer replayed on the paper's estimates: amplitudes, errors (run, node, time, n).

    excess: largest |mu| p / d, which (13) says is at most 1. astray: largest |d' - d| / d of a receiver that drives its
    own amplitude d' by (12) with what it gets. broken (time,): share of runs in which (35) fails at
    some node, and in which (36) fails.
    """

    amplitude: np.ndarray
    error: np.ndarray
    excess: float
    astray: float
    broken_local: np.ndarray
    broken_fused: np.ndarray


def indices(outcome: Runs, replayed: Replayed) -> Indices:
    """J_1 (9) and J_2 (17) at the levels that the paper states, for three filters."""
    setting, local, fused, energy = outcome.setting, {}, {}, {}
    v, rho = float(np.sum(setting.disturbances**2)), float(np.sum(setting.channel_noises**2))
    offsets = 2 * len(NODES) * np.sum(_allowance(setting, replayed.amplitude)) / outcome.runs
    for name in (RECURSIVE, "zero_gain", ZERO):
        separate, joint, starts = _outputs(outcome, name)
        start = setting.weight * np.sum(starts**2, axis=1)
        local[name] = separate - np.array(setting.levels) ** 2 * (v + rho + start)
        total = v + len(NODES) * rho + float(start.sum())
        energy[name] = joint
        fused[name] = joint - PAPER_FUSED_LEVEL**2 * total - (offsets if name == RECURSIVE else 0.0)
    return Indices(local, fused, energy)


def _outputs(outcome: Runs, name: str) -> tuple[np.ndarray, float, np.ndarray]:
    """Energies of M e of the nodes and fused, and the stacked first (x_0, e_0) (node, 4)."""
    setting, truth = outcome.setting, outcome.truth
    M = setting.M
    if name == ZERO:
        same = float(np.sum((truth @ M.T) ** 2))
        return np.full(4, same), same, np.tile(np.concatenate([truth[0]] * 2), (4, 1))
    errors = (truth - outcome.estimates(name)) @ M.T
    fused = outcome.record.errors("fused", fused_name(name, "dynamic")) @ M.T
    starts = np.concatenate([np.tile(setting.start, (4, 1)), np.array(setting.start) - setting.guesses], axis=1)
    return np.sum(errors**2, axis=(2, 3)).mean(axis=0), float(np.sum(fused**2, axis=(1, 2)).mean()), starts


def _allowance(setting: Setting, amplitude: np.ndarray) -> np.ndarray:
    """Lambda of (17) with u = 1: tr(M'M) sum_j d_j^2 / p^2, by node and step."""
    trace = float(np.sum(setting.M**2))
    result: np.ndarray = trace * np.sum(amplitude**2, axis=-1) / setting.segments**2
    return result


def replay(outcome: Runs) -> Replayed:
    """The quantizer again, since a record keeps neither amplitudes nor errors of single nodes."""
    setting, estimates = outcome.setting, outcome.estimates(RECURSIVE)
    quantizer = zoom(setting)
    d, amplitude, error, astray = np.full_like(estimates[:, :, 0], setting.amplitude), [], [], 0.0
    local = d
    for s in range(setting.steps):
        x = estimates[:, :, s]
        following, sent = quantizer.step(d, x)  # every component on its own, whatever the shape
        amplitude.append(d)
        error.append(np.asarray(sent.value) - x)
        astray = max(astray, float(np.max(np.abs(local - d) / d)))
        received = np.asarray(quantizer.step(local, x)[1].value)
        d, local = np.asarray(following), np.asarray(quantizer.decay * local + quantizer.growth * received**2)
    d, mu = np.stack(amplitude, axis=2), np.stack(error, axis=2)
    return Replayed(d, mu, float(np.max(np.abs(mu) * setting.segments / d)), astray, *_broken(outcome, d, mu))


def _broken(outcome: Runs, amplitude: np.ndarray, error: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Shares of runs in which |M mu_i|^2 <= Lambda_i fails at a node, and
    |M e_fused|^2 <= 2 N sum c_i^2 (|M e_i|^2 + Lambda_i), by step."""
    setting = outcome.setting
    c, n, allowance = hg.fusion.level_weights(setting.levels), len(NODES), _allowance(setting, amplitude)
    off = np.sum((error @ setting.M.T) ** 2, axis=-1) > allowance
    local = (outcome.truth - outcome.estimates(RECURSIVE)) @ setting.M.T
    fused = outcome.record.errors("fused", fused_name(RECURSIVE, "dynamic")) @ setting.M.T
    bound = 2 * n * np.einsum("i,rit->rt", c**2, np.sum(local**2, axis=-1) + allowance)
    return off.any(axis=1).mean(axis=0), (np.sum(fused**2, axis=-1) > bound).mean(axis=0)
