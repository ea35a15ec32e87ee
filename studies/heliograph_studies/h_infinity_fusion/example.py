"""The example's networks and runs: the paper's filters and what they are compared with, fused and quantized."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

import heliograph as hg
from heliograph.filters.gaussian import GaussianFilter
from heliograph.filters.prediction import prediction_of
from heliograph.fusion.quantizer import Quantizer
from heliograph_studies.h_infinity_fusion import setting
from heliograph_studies.h_infinity_fusion.zoom_quantizer import ZoomQuantizer

RECURSIVE = "recursive_trace"  # the paper's filters, at its levels
QUANTIZERS: dict[str, Quantizer | None] = {
    "none": None,
    "dynamic": ZoomQuantizer(setting.SEGMENTS, setting.AMPLITUDE, setting.DECAY, setting.ZOOM),
    "static": hg.fusion.UniformQuantizer(setting.SEGMENTS, setting.AMPLITUDE),
}
MORE_QUANTIZERS: dict[str, Quantizer | None] = {
    "dynamic_decodable": hg.fusion.EscapeQuantizer(setting.SEGMENTS + 1, setting.AMPLITUDE, setting.DECAY, 0.6, 1e-3),
    "static_p41": hg.fusion.UniformQuantizer(setting.SEGMENTS + 1, setting.AMPLITUDE),
}


@dataclass(frozen=True)
class Outcome:
    """The runs of one network, with the names of its filters."""

    record: hg.Record
    filters: tuple[str, ...]

    @property
    def runs(self) -> int:
        """Number of runs."""
        return len(self.errors(self.filters[0], "none"))

    def errors(self, name: str, quantizer: str) -> np.ndarray:
        """Norm of the fused error, (run, time)."""
        return np.asarray(np.linalg.norm(self.record.errors("fused", fused_name(name, quantizer)), axis=-1))

    def mean_error(self, name: str, quantizer: str) -> tuple[float, float]:
        """Mean norm of the fused error over runs and steps, and its standard error."""
        return mean_and_error(self.errors(name, quantizer).mean(axis=1))

    def estimates(self, name: str) -> np.ndarray:
        """Local estimates (run, node, time, n)."""
        return np.stack([np.asarray(self.record.estimates[n][name].mean) for n in setting.NODES], axis=1)

    @property
    def truth(self) -> np.ndarray:
        """The state (time, n), the same in all runs."""
        assert self.record.truth is not None
        return np.asarray(self.record.truth[0])


def mean_and_error(values: np.ndarray) -> tuple[float, float]:
    """Mean of independent values (run,) and its standard error."""
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))


def fused_name(name: str, quantizer: str) -> str:
    """Under which name the fused estimate of a filter behind a quantizer stands."""
    return f"{name}.{quantizer}"


def simulate(designs: Mapping[str, list[hg.h_infinity.HInfinityDesign]], runs: int, seed: int) -> Outcome:
    """All filters of one record but those that are told of losses; `designs` by name, one for each node."""
    nodes = {
        node: hg.Node(setting.disturbed_sensor(i), setting.disturbed_channel(), filters(i, designs))
        for i, node in enumerate(setting.NODES)
    }
    return _run(nodes, runs, seed)


def filters(
    node: int, designs: Mapping[str, list[hg.h_infinity.HInfinityDesign]]
) -> dict[str, hg.filters.AbstractFilter]:
    """The filters of one node that hear the losses as they are."""
    return {
        **h_infinity_filters(node, designs),
        "open_loop": hg.filters.open_loop_filter(believed_plant(), *start(node)),
        "ekf_ignoring": prediction_of(extended(node, setting.lossless)),
        "ekf_statistics": prediction_of(extended(node, setting.lossy)),
    }


def h_infinity_filters(
    node: int, designs: Mapping[str, list[hg.h_infinity.HInfinityDesign]]
) -> dict[str, hg.filters.AbstractFilter]:
    """The designed filters of one node."""
    parts = setting.plant(False), setting.sensor(node, 0.0), setting.system(node)
    return {
        name: hg.filters.h_infinity_filter(*parts, each[node], setting.GUESSES[node]) for name, each in designs.items()
    }


def simulate_told(runs: int, seed: int) -> Outcome:
    """Extended Kalman filters told of each loss, in a network whose losses are erasures; other draws."""
    nodes = {
        node: hg.Node(
            setting.disturbed_sensor(i),
            setting.disturbed_channel(setting.told),
            {"ekf_told": prediction_of(extended(i, setting.lossless))},
        )
        for i, node in enumerate(setting.NODES)
    }
    return _run(nodes, runs, seed)


def believed_plant() -> hg.Plant:
    """v as white noise, as strong as v_s in the mean over the horizon."""
    return setting.plant(False, float(np.mean(setting.DISTURBANCES**2)))


def start(node: int) -> tuple[np.ndarray, np.ndarray]:
    """First estimate of a node and the covariance believed of it."""
    return setting.GUESSES[node], setting.INITIAL_VARIANCE * np.eye(2)


def extended(node: int, hop: setting.Hop) -> GaussianFilter:
    """An extended Kalman filter of one node, which believes in links of one kind and in white noises."""
    noise = float(setting.FEEDTHROUGH[node] ** 2 * np.mean(setting.DISTURBANCES**2))
    return hg.extended_filter(
        believed_plant(), setting.sensor(node, noise), setting.white_channel(hop), None, *start(node)
    )


def _run(nodes: dict[str, hg.Node], runs: int, seed: int) -> Outcome:
    names = tuple(next(iter(nodes.values())).filters)
    rule = hg.fusion.WeightedFusion(hg.fusion.level_weights(setting.LEVELS))
    fused = {fused_name(n, q): hg.Fusion(n, rule, each) for n in names for q, each in QUANTIZERS.items()}
    if RECURSIVE in names:
        fused |= {fused_name(RECURSIVE, q): hg.Fusion(RECURSIVE, rule, each) for q, each in MORE_QUANTIZERS.items()}
    network = hg.Network(setting.plant(), nodes, fused)
    record = hg.monte_carlo(network, setting.STEPS, runs, seed, inputs=setting.inputs())
    return Outcome(record, names)
