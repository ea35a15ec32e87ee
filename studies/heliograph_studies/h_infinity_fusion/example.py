"""The example's networks and runs: the paper's filters and what they are compared with, fused and quantized."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

import heliograph as hg
from heliograph.filters.gaussian.gaussian import GaussianFilter
from heliograph.filters.wrappers.fed_back import prediction_of
from heliograph.fusion.quantizer import Quantizer
from heliograph_studies import sampled
from heliograph_studies.h_infinity_fusion.setting import NODES, Hop, Setting, ZoomQuantizer

RECURSIVE = "recursive_trace"  # the paper's filters, at its levels
QUANTIZERS = "none", "dynamic", "static"
MORE_QUANTIZERS = "dynamic_decodable", "static_p41"  # of the paper's filters only


def zoom(setting: Setting) -> ZoomQuantizer:
    """The paper's dynamic quantizer."""
    return ZoomQuantizer(setting.segments, setting.amplitude, setting.decay, setting.zoom)


def quantizers(setting: Setting) -> dict[str, Quantizer | None]:
    """All of them by name."""
    odd, size = setting.segments + 1, setting.amplitude
    return {
        "none": None,
        "dynamic": zoom(setting),
        "static": hg.fusion.UniformQuantizer(setting.segments, size),
        "dynamic_decodable": hg.fusion.EscapeQuantizer(odd, size, setting.decay, 0.6, 1e-3),
        "static_p41": hg.fusion.UniformQuantizer(odd, size),
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
        name: hg.filters.h_infinity_filter(*parts, design[node], setting.guesses[node])
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
