"""The paper's indices J_1 and J_2 on the runs, and what its quantizer did in them."""

from dataclasses import dataclass

import numpy as np

import heliograph as hg
from heliograph_studies.h_infinity_fusion.example import RECURSIVE, Runs, fused_name, zoom
from heliograph_studies.h_infinity_fusion.setting import NODES, PAPER_FUSED_LEVEL, Setting

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
