"""The Monte Carlo runs behind every number of the reproduction."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import heliograph as hg
from heliograph.factors.covariance_factors import (
    WeightedColumns,
    decorrelate,
    join_columns,
)
from heliograph.factors.factored_gaussian import Gaussian
from heliograph.factors.pivots import reciprocal_or_zero, square_root
from heliograph.filters.base import AbstractFilter, Step, corrects, predicts
from heliograph.filters.gaussian.gaussian import GaussianFilter, correct_signal
from heliograph.filters.gaussian.moment_transforms import evaluate_beside_mean
from heliograph.filters.gaussian.signal_moments import ArrivedInnovation, Signal, condition_on_received
from heliograph.filters.gaussian.uncertain_channel_updates import AbstractUpdate
from heliograph.model.estimate import Claim, Estimate, Innovation
from heliograph.model.over_time import at
from heliograph.numerics.lapack import eigh
from heliograph.numerics.types import ArrayLike
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.moments.second_moments import SecondOrder
from heliograph_studies import Stages, Unlisted
from heliograph_studies.cubature_fusion.setting import (
    NODES,
    STATES,
    LooseInterval,
    Scenario,
    Setting,
    channel,
    cubature,
    filters,
    plant,
    sensor,
)


class AbstractReading(AbstractUpdate):
    """Another reading of the step in which `update` corrects; it describes the channel as that does."""

    update: AbstractUpdate

    def describe(self, channel: AbstractRandomAffine) -> SecondOrder:
        """As the update within."""
        return self.update.describe(channel)


class StepFourGain(AbstractReading):
    """The gain of Step 4, sqrt(mu) where Theorem 2 has mu: larger by `factor` = 1 / sqrt(mu). The bound stays (31)."""

    factor: float

    def correct(
        self, prior: jax.Array, signal: Signal, channel: SecondOrder, present: jax.Array
    ) -> tuple[jax.Array, jax.Array]:
        """Scale the gain, keep the bound."""
        gain, bound = self.update.correct(prior, signal, channel, present)
        return self.factor * gain, bound


class CentralMoment(AbstractReading):
    """The one symbol P^yy of (10) and Step 4 read as the covariance of the innovation in every term."""

    def condition(self, signal: Signal, channel: SecondOrder, z: ArrivedInnovation, nominal: Gaussian) -> Gaussian:
        """Take Cov(y) for E[y y']."""
        return _condition(self.update, signal._replace(second=signal.covariance), channel, z)


class RawMoment(AbstractReading):
    """The one symbol P^yy read as E[y y'] in every term."""

    def condition(self, signal: Signal, channel: SecondOrder, z: ArrivedInnovation, nominal: Gaussian) -> Gaussian:
        """Take E[y y'] for Cov(y): E y (E y)' is one more column of its noise."""
        noise = join_columns(signal.noise, WeightedColumns(signal.mean[:, None], jnp.ones(1)))
        return _condition(self.update, signal._replace(noise=noise), channel, z)


def _condition(update: AbstractUpdate, signal: Signal, channel: SecondOrder, z: ArrivedInnovation) -> Gaussian:
    """Condition on a signal that is read in another way."""
    return update.condition(signal, channel, z, condition_on_received(signal, channel, z)[0])


class Propagated(NamedTuple):
    """A belief, and half the differences and the means (n, n) of the pairs of points that were moved to predict it."""

    gaussian: Gaussian
    ahead: jax.Array
    behind: jax.Array


class MixedCross(AbstractFilter):
    """Step 3's P^xy: propagated points on one side, redrawn points on the other."""

    base: GaussianFilter
    claim: Claim = eqx.field(static=True)

    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    received: int = eqx.field(static=True)

    def __init__(self, base: GaussianFilter):
        self.base, self.claim = base, "nominal"
        self.states, self.inputs, self.received = base.states, base.inputs, base.received

    def init(self) -> Propagated:
        """The prior."""
        start = self.base.init()
        none = jnp.zeros((len(start.mean), len(start.mean)))
        return Propagated(start, none, none)

    @predicts
    def predict(self, state: Propagated, u: ArrayLike = (), k: Step = 0) -> Propagated:
        """Move the points, and keep them."""
        plant, x = at(self.base.plant, k), state.gaussian
        moved = evaluate_beside_mean(
            lambda x: plant.transition(x, jnp.asarray(u)), x, square_root(len(x.mean) * x.variances)
        )
        return Propagated(self.base.predict(x, u, k), *moved)

    @corrects
    def correct(self, state: Propagated, z: ArrayLike, k: Step = 0) -> tuple[Propagated, Innovation]:
        """Redraw for y only, correct."""
        sensor, channel, x = at(self.base.sensor, k), at(self.base.channel, k), state.gaussian
        ahead, behind = evaluate_beside_mean(sensor.measure, x, square_root(len(x.mean) * x.variances))
        y = jnp.concatenate([ahead, behind], axis=1)
        points = jnp.concatenate([state.ahead, state.behind], axis=1)
        mean, count = jnp.mean(y, axis=1), y.shape[1]
        apart = y - mean[:, None]
        spread = apart @ apart.T / count + sensor.noise.covariance
        cross = (points - x.mean[:, None]) @ apart.T / count
        # What of Cov y is not by these slopes may be less than nothing: the reading is of no joint law.
        slopes = decorrelate(x.root, cross).T * reciprocal_or_zero(x.variances)
        weights, vectors = eigh(spread - (slopes * x.variances) @ slopes.T)
        second = spread + jnp.outer(mean, mean)
        signal = Signal(x, mean, slopes, WeightedColumns(vectors, weights), second, jnp.diagonal(second))
        after, innovation = correct_signal(signal, channel, self.base.rule, jnp.asarray(z))
        return state._replace(gaussian=after), innovation

    def estimate(self, state: Propagated) -> Estimate:
        """The belief."""
        return Estimate(state.gaussian.mean, state.gaussian.covariance, self.claim)


def variants(s: Scenario, node: int) -> dict[str, AbstractFilter]:
    """The literal readings of one node, all with the scenario's fixed scalars."""
    printed, polytope = (rule(hg.filters.Scalars(*s.beta)) for rule in (LooseInterval, hg.filters.Polytope))
    return {
        "step_four_gain": cubature(s, node, StepFourGain(printed, s.mean_gain**-0.5)),
        "mixed_cross": MixedCross(cubature(s, node, polytope)),
        "central_moment": cubature(s, node, CentralMoment(polytope)),
        "raw_moment": cubature(s, node, RawMoment(polytope)),
    }


if TYPE_CHECKING:
    import xarray

Statistics = dict[str, dict[str, hg.simulation.ErrorStatistics]]


@dataclass(frozen=True)
class Runs:
    """One scenario: error statistics by node ("fused" last) and filter, and one run in full."""

    scenario: Scenario
    statistics: Statistics
    shown: hg.Record

    @property
    def steps(self) -> int:
        """Number of steps."""
        return len(self.shown.time)

    @property
    def runs(self) -> int:
        """Number of runs."""
        return next(iter(self.statistics[NODES[0]].values())).runs

    def pooled(self, name: str) -> hg.simulation.ErrorStatistics:
        """A filter's statistics over all nodes, steps of node 1 first; a fused one's as they are."""
        if name in self.statistics["fused"]:
            return self.statistics["fused"][name]
        return hg.simulation.pool([self.statistics[node][name] for node in NODES])

    def rmse(self, name: str) -> np.ndarray:
        """Root mean squared error over time, (node, time)."""
        return np.array([self.statistics[node][name].rmse_over_time() for node in NODES])

    def claimed_trace(self, name: str) -> np.ndarray:
        """Mean claimed trace over time, (node, time)."""
        claimed = np.array([self.statistics[node][name].claimed() for node in NODES])
        return np.asarray(np.trace(claimed, axis1=-2, axis2=-1))


@dataclass(frozen=True)
class Outcome:
    """Numbers by scenario and filter, of the nodes together; early: the first steps of the strong scenario."""

    rmse_is: str
    scenarios: dict[str, dict[str, Any]]
    strong_first_steps: dict[str, Any]
    seed: int
    runs: int
    printed: Unlisted[Runs]
    strong: Unlisted[Runs]
    early: Unlisted[Runs]

    @property
    def both(self) -> tuple[Runs, Runs]:
        """Both scenarios, in order."""
        return self.printed, self.strong


def network(s: Scenario) -> hg.Network:
    """Four nodes with all filters, and what is made of them together."""
    optimal = hg.CovarianceIntersection()
    fused: dict[str, hg.Fusion | hg.filters.AbstractFilter] = {
        "ci_printed": hg.Fusion("cubature_printed_fixed", optimal),
        "ci_open_loop": hg.Fusion("open_loop", optimal),
        "central_polytope": central(s, hg.filters.Polytope()),
    }
    return _assemble(s, [filters(s, i) for i in range(len(NODES))], {**zero_mean_fusion(s), **fused})


def zero_mean_fusion(s: Scenario) -> dict[str, hg.Fusion | hg.filters.AbstractFilter]:
    """What is made of the zero-mean filter's estimates, and the central filter with its update."""
    return {
        "ci_optimal": hg.Fusion("cubature_zero_mean", hg.CovarianceIntersection()),
        "ci_equal": hg.Fusion("cubature_zero_mean", hg.fusion.EqualIntersection()),
        "central": central(s, hg.filters.ZeroMean()),
    }


def central(s: Scenario, update: AbstractUpdate) -> hg.filters.AbstractFilter:
    """All nodes' measurements in turn, each used as that node's filter would."""
    return hg.filters.sequential_filter([cubature(s, i, update) for i in range(len(NODES))])


def _only(s: Scenario, name: str) -> list[dict[str, hg.filters.AbstractFilter]]:
    return [{name: filters(s, i)[name]} for i in range(len(NODES))]


def _assemble(
    s: Scenario,
    parts: list[dict[str, hg.filters.AbstractFilter]],
    fused: Mapping[str, hg.Fusion | hg.filters.AbstractFilter],
) -> hg.Network:
    nodes = {name: hg.Node(sensor(s, i), channel(s), parts[i]) for i, name in enumerate(NODES)}
    return hg.Network(plant(s), nodes, fused)


def compute(setting: Setting, stages: Stages) -> Outcome:
    """Run everything, all networks of a scenario on the same data."""

    def runs(s: Scenario, networks: dict[str, hg.Network], horizon: int, count: int) -> Runs:
        statistics: Statistics = {}
        for what, network in networks.items():
            work = partial(simulate, network, horizon, count, setting.seed, stages)
            for node, by_name in stages(f"{s.name}: {what}", work).items():
                statistics.setdefault(node, {}).update(by_name)
        papers = {"ci_printed": hg.Fusion("cubature_printed_fixed", hg.CovarianceIntersection())}
        shown = _assemble(s, _only(s, "cubature_printed_fixed"), papers)
        return Runs(s, statistics, hg.monte_carlo(shown, horizon, 1, setting.seed))

    def both(s: Scenario) -> Runs:
        literal = _assemble(s, [variants(s, i) for i in range(len(NODES))], {})  # the nodes receive the same
        return runs(s, {"filters": network(s), "literal readings": literal}, s.horizon, setting.runs)

    printed, strong, s = both(setting.printed), both(setting.strong), setting.strong
    first = {"first steps": _assemble(s, _only(s, "cubature_zero_mean"), zero_mean_fusion(s))}
    early = runs(s, first, setting.early, setting.early_factor * setting.runs)
    return outcome(setting, printed, strong, early)


def simulate(network: hg.Network, horizon: int, runs: int, seed: int, stages: Stages) -> Statistics:
    """Error statistics of a network by node and filter."""
    sums = hg.monte_carlo(network, horizon, runs, seed, hg.Statistics(), progress=stages.progress)
    return {node: dict(by_name) for node, by_name in sums.items()}


def outcome(setting: Setting, printed: Runs, strong: Runs, early: Runs) -> Outcome:
    """The numbers of what was run."""
    return Outcome(
        rmse_is="root of the mean over runs, nodes and steps 1..T of the squared error summed over the state",
        scenarios={o.scenario.name: numbers(o) for o in (printed, strong)},
        strong_first_steps={"runs": early.runs, "steps": early.steps, **numbers(early)},
        seed=setting.seed, runs=setting.runs, printed=printed, strong=strong, early=early,
    )  # fmt: skip


def numbers(o: Runs) -> dict[str, Any]:
    """Of every filter and of every fused estimate: RMSE, claimed trace, and where the claim is exceeded most."""

    def of(name: str) -> dict[str, Any]:
        pooled = o.pooled(name)
        worst = pooled.worst_direction()
        node = "fused" if name in o.statistics["fused"] else NODES[worst.step // o.steps]
        direction = {"ratio": worst.ratio, "standard_error": worst.standard_error, "z": worst.z,
                     "step": worst.step % o.steps + 1, "node": node}  # fmt: skip
        rmse, error = pooled.rmse()
        return {"rmse": rmse, "rmse_se": error, "mean_trace": pooled.mean_trace(), "worst_direction": direction}

    kinds = {"filters": NODES[0], "fused": "fused"}
    return {kind: {name: of(name) for name in o.statistics[node]} for kind, node in kinds.items()}


def write_record(result: Outcome, folder: Path) -> None:
    """RMSE, claimed trace and ratio of both scenarios over time as NetCDF; NaN after a scenario's last step."""
    import xarray

    length = max(o.steps for o in result.both)
    parts = [_scenario_record(o, length) for o in result.both]
    about = {"seed": result.seed, "runs": result.runs, "largest_ratio": "searched at each step, so biased upwards"}
    joined = xarray.concat(parts, "scenario")
    joined = joined.assign_coords(scenario=[o.scenario.name for o in result.both])
    joined.assign_attrs(about).to_netcdf(folder / "record.nc", engine="h5netcdf")


def _scenario_record(o: Runs, length: int) -> "xarray.Dataset":
    import xarray

    local = {name: [o.statistics[node][name] for node in NODES] for name in o.statistics[NODES[0]]}
    fused = {name: [item] for name, item in o.statistics["fused"].items()}
    data = {}
    for prefix, items, axes in (("", local, ("filter", "node")), ("fused_", fused, ("fused",))):
        for name, values in _over_time([s for group in items.values() for s in group]).items():
            shaped = values.reshape(len(items), *([len(NODES)] if not prefix else []), *values.shape[1:])
            data[prefix + name] = ((*axes, "time", *(("state",) if values.ndim == 3 else ())), shaped)
    coordinates = {"filter": list(local), "node": list(NODES), "fused": list(fused), "state": list(STATES),
                   "time": o.shown.time.astype(int)}  # fmt: skip
    return xarray.Dataset(data, coordinates).reindex(time=np.arange(1, length + 1))


def _over_time(statistics: list[hg.simulation.ErrorStatistics]) -> dict[str, np.ndarray]:
    """Quantities by name, (item, time) or (item, time, state)."""
    actual = np.array([s.actual() for s in statistics])
    claimed = np.array([s.claimed() for s in statistics])
    factor = np.linalg.inv(np.linalg.cholesky(claimed))
    return {
        "rmse": np.sqrt(np.trace(actual, axis1=-2, axis2=-1)),
        "claimed_trace": np.trace(claimed, axis1=-2, axis2=-1),
        "largest_ratio": np.linalg.eigvalsh(factor @ actual @ np.swapaxes(factor, -1, -2))[..., -1],
        "mean_squared_error": np.diagonal(actual, axis1=-2, axis2=-1),
        "claimed_variance": np.diagonal(claimed, axis1=-2, axis2=-1),
    }
