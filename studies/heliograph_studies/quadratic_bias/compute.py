"""All numbers of the reproduction: designed covariances, Monte Carlo on the library's driver, bounds, one run."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from heliograph.filters.base import AbstractFilter
from heliograph.filters.mixture import mixture_filter
from heliograph.filters.polynomial import MemoryFilter, PolynomialFilter
from heliograph.filters.scheduled import ScheduledFilter
from heliograph.linear.comparison import skewness
from heliograph.linear.lift import lifted_system
from heliograph.linear.memory import memory_system
from heliograph.linear.recursion import lmmse
from heliograph.linear.schedule import Schedule
from heliograph.model.channel import Channel
from heliograph.model.over_time import first
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node
from heliograph.simulation.record import Record
from heliograph.simulation.reducer import AbstractReducer, trajectories_record
from heliograph.simulation.simulate import monte_carlo
from heliograph.simulation.statistics import ErrorStatistics
from heliograph.simulation.sums import Statistics
from heliograph_studies.quadratic_bias import setting
from heliograph_studies.quadratic_bias.bounds import Boundedness, boundedness
from heliograph_studies.quadratic_bias.printed import Printed, printed_quadratic

RUNS = 20_000
RESOLUTION = 0.01  # of z for the mixture filter, where a link that is off leaves z with a few exact values
DEGREES = {"linear": 1, "quadratic": 2, "cubic": 3, "quartic": 4}
NODE = "receiver"
CLAIMED, TRUE = "quadratic_printed_claimed", "quadratic_printed_true"


@dataclass(frozen=True)
class Model:
    """A plant with bias, its sensor and channel, how long it runs, and the first step whose errors are averaged."""

    plant: AnyPlant
    sensor: AnySensor
    channel: Channel
    horizon: int
    settled: int

    @property
    def states(self) -> tuple[str, ...]:
        """Names of state and bias."""
        names: tuple[str, ...] = first(self.plant).states
        return names


@dataclass(frozen=True)
class Designs:
    """Filters by name, and the covariances (time + 1, n, n) that are known before any run; entry 0 is the start."""

    filters: dict[str, AbstractFilter]
    covariance: dict[str, np.ndarray]
    skewness: float


@dataclass(frozen=True)
class Outcome:
    """Everything the report tells of one model: designs, statistics of all runs by filter, and the first run."""

    model: Model
    designs: Designs
    statistics: dict[str, ErrorStatistics]
    run: Record


@dataclass(frozen=True)
class Reproduction:
    """The paper's example, our scenario, and the example's bounds."""

    example: Outcome
    outage: Outcome
    bounds: Boundedness
    seed: int


def example() -> Model:
    """Section 4."""
    return Model(setting.plant(), setting.sensor(), setting.channel(), setting.HORIZON, setting.SETTLED)


def outage() -> Model:
    """Our scenario."""
    parts = setting.outage_plant(), setting.outage_sensor(), setting.outage_channel()
    return Model(*parts, setting.OUTAGE_HORIZON, setting.OUTAGE_SETTLED)


def design(model: Model, resolution: float) -> Designs:
    """All filters of a model; `resolution` is the mixture filter's."""
    parts = model.plant, model.sensor, model.channel
    systems = {name: lifted_system(*parts, degree, model.horizon) for name, degree in DEGREES.items()}
    schedules = {name: lmmse(system) for name, system in systems.items()}
    filters: dict[str, AbstractFilter] = {
        name: PolynomialFilter(ScheduledFilter(schedule), DEGREES[name]) for name, schedule in schedules.items()
    }
    memory = lmmse(memory_system(*parts, schedules["linear"]))
    linear = ScheduledFilter(schedules["linear"])
    filters["memory"] = MemoryFilter(linear=linear, products=ScheduledFilter(memory), claim="exact")
    printed = printed_quadratic(*parts, model.horizon)
    filters[TRUE] = PolynomialFilter(ScheduledFilter(printed.schedule), 2)
    filters["mixture"] = mixture_filter(*parts, resolution)
    covariance = _covariances(model, schedules | {"memory": memory}, printed)
    n, m = len(model.states), 1
    return Designs(filters, covariance, skewness(systems["quadratic"], n, m))


def _covariances(model: Model, schedules: Mapping[str, Schedule], printed: Printed) -> dict[str, np.ndarray]:
    start = first(model.plant).initial_covariance[None]
    found = {name: schedule.gains.covariance for name, schedule in schedules.items()}
    found |= {CLAIMED: printed.schedule.gains.covariance, TRUE: printed.true_covariance}
    return {name: np.concatenate([start, value]) for name, value in found.items()}


class StatisticsAndRun(AbstractReducer[tuple[dict[str, ErrorStatistics], Record]]):
    """Error statistics of all runs, and the trajectories of the first one."""

    statistics: Statistics

    def initial(self, shapes: PyTree) -> PyTree:
        """Zero sums, and room for one run."""
        return self.statistics.initial(shapes), jax.tree.map(lambda s: jnp.zeros(s.shape[1:], s.dtype), shapes)

    def reduce(self, carry: PyTree, batch: PyTree, runs: jax.Array, valid: jax.Array) -> tuple[PyTree, PyTree]:
        """Add the block, and keep run 0 when it is in it."""
        sums, kept = self.statistics.reduce(carry[0], batch, runs, valid)
        shown = jax.tree.map(lambda new, old: jnp.where(runs[0] == 0, new[0], old), batch, carry[1])
        return (sums, shown), kept

    def finish(self, carry: PyTree, collected: PyTree, network: Network) -> tuple[dict[str, ErrorStatistics], Record]:
        """Statistics of the one node by filter, and the run as a record."""
        found = self.statistics.finish(carry[0], collected, network)[NODE]
        time = np.arange(1, carry[1]["truth"].shape[0] + 1, dtype=np.float64)
        return found, trajectories_record(network, carry[1], time)


def simulate(model: Model, designs: Designs, runs: int, seed: int) -> tuple[dict[str, ErrorStatistics], Record]:
    """Every filter on the same runs: all have heard the same z. The record is the first run."""
    network = Network(model.plant, {NODE: Node(model.sensor, model.channel, designs.filters)})
    found: tuple[dict[str, ErrorStatistics], Record] = monte_carlo(
        network, model.horizon, runs, seed, keep=StatisticsAndRun(Statistics())
    )
    return found


def compute(runs: int, seed: int, advance: Callable[[str], None] = lambda what: None) -> Reproduction:
    """Design, simulate, and evaluate the bounds; `advance` is told what begins."""

    def outcome(name: str, model: Model, resolution: float) -> Outcome:
        advance(f"{name}: design")
        designs = design(model, resolution)
        advance(f"{name}: {runs:,} runs")
        return Outcome(model, designs, *simulate(model, designs, runs, seed))

    printed, ours = outcome("example", example(), 0.0), outcome("outages", outage(), RESOLUTION)
    advance("bounds")
    model = printed.model
    square = lifted_system(model.plant, model.sensor, model.channel, 2, model.horizon)
    return Reproduction(printed, ours, boundedness(square), seed)


def settled_mean(outcome: Outcome, name: str) -> np.ndarray:
    """Designed error variances averaged over the settled steps, (n,)."""
    after = outcome.designs.covariance[name][outcome.model.settled + 1 :]
    return np.asarray(np.diagonal(after, axis1=1, axis2=2).mean(axis=0))


def gain_percent(outcome: Outcome, name: str) -> np.ndarray:
    """100 (1 - ratio of the means) against the linear filter, (n,); from the simulation where nothing is designed."""
    if name in outcome.designs.covariance:
        return np.asarray(100 * (1 - settled_mean(outcome, name) / settled_mean(outcome, "linear")))
    measured = [simulated_mean(outcome, n)[0] for n in (name, "linear")]
    return np.asarray(100 * (1 - measured[0] / measured[1]))


def simulated_mean(outcome: Outcome, name: str, against: str | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Squared error averaged over runs and settled steps, and its standard error from batches of runs, (n,) each.

    `against`: the difference to another filter on the same runs, whose common part cancels.
    """
    squared, count = _batches(outcome, name)
    if against is not None:
        squared = squared - _batches(outcome, against)[0]
    mean = squared.sum(axis=0) / count.sum()
    used = count > 0
    batches = int(np.count_nonzero(used))
    scatter = np.sum((squared[used] - mean * count[used, None]) ** 2, axis=0) * batches / max(batches - 1, 1)
    return mean, np.sqrt(scatter) / count.sum()


def _batches(outcome: Outcome, name: str) -> tuple[np.ndarray, np.ndarray]:
    statistics = outcome.statistics[name]
    outer = statistics.outer[:, outcome.model.settled :]
    return np.diagonal(outer, axis1=2, axis2=3).mean(axis=1), statistics.count


def simulated_over_time(outcome: Outcome, name: str) -> np.ndarray:
    """Mean squared error over the runs at each step, (time, n)."""
    return np.asarray(np.diagonal(outcome.statistics[name].actual(), axis1=1, axis2=2))
