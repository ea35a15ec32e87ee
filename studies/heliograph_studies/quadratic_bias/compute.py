"""All numbers of the reproduction: designed covariances, Monte Carlo on the library's driver, bounds, one run."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import heliograph as hg
from heliograph.filters import AbstractFilter, PolynomialFilter, ScheduledFilter
from heliograph.filters.linear.memory_filter import MemoryFilter
from heliograph.linear.lmmse_recursion import lmmse, true_covariance
from heliograph.linear.monomial_lifted_system import lifted_system
from heliograph.linear.polynomial_filter_errors import quadratic_system_with_linear_estimate, skewness
from heliograph.linear.system import LinearSystem, Schedule, state_moments
from heliograph.model.channel import Channel
from heliograph.model.over_time import first
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor
from heliograph.random_affine.hop import known
from heliograph.simulation import ErrorStatistics
from heliograph_studies import Inline, Stages, Unlisted
from heliograph_studies.quadratic_bias.bounds import Boundedness, boundedness
from heliograph_studies.quadratic_bias.setting import Model, Setting


class Printed(NamedTuple):
    """The printed filter: its gains with what it claims, and the covariance (time, n, n) that it has."""

    schedule: Schedule
    true_covariance: np.ndarray


def printed_quadratic(plant: AnyPlant, sensor: AnySensor, channel: Channel, horizon: int) -> Printed:
    """Gains, claimed covariance (36) and true covariance of (14) with (30), (31) and (35), Lemma 4 corrected."""
    square = lifted_system(plant, sensor, channel, 2, horizon)
    schedule = lmmse(believed(square, lifted_system(plant, sensor, channel, 1, horizon)), "nominal")
    return Printed(schedule, true_covariance(square, schedule))


def believed(square: LinearSystem, linear: LinearSystem) -> LinearSystem:
    """The system that the paper believes in, from the true one of degree 2 and that of degree 1.

    E[z z' | x] is taken as (mean gain)^2 x x' plus a constant (printed: theta^2 mu^2, true: theta^2 E[l m]). What is
    left over, D Y + V with D = C - C_printed, has the right covariance D Cov(Y) D' + Cov(V), but it is no longer
    uncorrelated with Y.
    """
    before, s = state_moments(square), linear.steps
    output = np.array([known(c, o).moments(2).matrix[:-1, :-1] for c, o in zip(s.output, s.offset, strict=True)])
    gap = square.steps.output - output
    offset = square.steps.offset + np.einsum("tij,tj->ti", gap, before.mean[1:])
    noise = square.steps.noise + gap @ before.covariance[1:] @ np.swapaxes(gap, 1, 2)
    steps = square.steps._replace(output=output, offset=offset, noise=noise)
    return LinearSystem(steps, square.mean, square.covariance, square.projection, square.rounding)


RESOLUTION = 0.01  # of z for the mixture filter, where a link that is off leaves z with a few exact values
DEGREES = {"linear": 1, "quadratic": 2, "cubic": 3, "quartic": 4}
NODE = "receiver"
CLAIMED, TRUE = "quadratic_printed_claimed", "quadratic_printed_true"

ByState = dict[str, float]


@dataclass(frozen=True)
class Numbers:
    """What is found of one model: variances designed and simulated by filter and state.

    covariance: error variances at t = 0 ... horizon; mean_covariance: their means over the steps that count.
    gain_percent: 100 (1 - ratio of the means) against the linear filter; simulated where nothing is designed.
    monte_carlo: mean squared errors, and their differences to the linear filter on the same runs, with standard errors.
    designed: covariances (time + 1, n, n); errors: mean squared error at each step, (time, n).
    """

    covariance: dict[str, dict[str, np.ndarray]]
    mean_covariance: dict[str, ByState]
    gain_percent: dict[str, ByState]
    monte_carlo: dict[str, dict[str, Any]]
    skewness: float
    model: Unlisted[Model]
    designed: Unlisted[dict[str, np.ndarray]]
    errors: Unlisted[dict[str, np.ndarray]]


@dataclass(frozen=True)
class Outcome:
    """The publication's example, our scenario, and the example's bounds and first run."""

    seed: int
    runs: int
    averaged: str
    gain_percent_is: str
    outage: Numbers
    example: Inline[Numbers]
    bounds: Unlisted[Boundedness]
    run: Unlisted[hg.Record]


class Designs(NamedTuple):
    """Filters by name, and the covariances (time + 1, n, n) that are known before any run; entry 0 is the start."""

    filters: dict[str, AbstractFilter]
    covariance: dict[str, np.ndarray]
    skewness: float

    def network(self, model: Model) -> hg.Network:
        """Return the network of a receiver with all filters."""
        return hg.Network(model.plant, {NODE: hg.Node(model.sensor, model.channel, self.filters)})


def compute(setting: Setting, stages: Stages) -> Outcome:
    """Design, simulate, and evaluate the bounds."""
    example, outage = setting.example(), setting.outage()
    printed, shown = stages("the example", lambda: _with_a_run(example, setting, stages))
    ours = stages("outages", lambda: numbers(outage, design(outage, RESOLUTION), setting, stages))
    square = lifted_system(*example[:3], 2, example.horizon)
    return Outcome(
        seed=setting.seed,
        runs=setting.runs,
        averaged=f"t = {example.begin + 1} ... {example.horizon}",
        gain_percent_is="100 (1 - ratio of the means of the error variances) against the linear filter",
        outage=ours,
        example=printed,
        bounds=stages("bounds", lambda: boundedness(square)),
        run=shown,
    )


def design(model: Model, resolution: float) -> Designs:
    """All filters of a model; `resolution` is the mixture filter's."""
    parts = model.plant, model.sensor, model.channel
    systems = {name: lifted_system(*parts, degree, model.horizon) for name, degree in DEGREES.items()}
    schedules = {name: lmmse(system) for name, system in systems.items()}
    filters: dict[str, AbstractFilter] = {
        name: PolynomialFilter(ScheduledFilter(schedule), DEGREES[name]) for name, schedule in schedules.items()
    }
    memory = lmmse(quadratic_system_with_linear_estimate(*parts, schedules["linear"]))
    linear = ScheduledFilter(schedules["linear"])
    filters["memory"] = MemoryFilter(linear=linear, products=ScheduledFilter(memory), claim="exact")
    printed = printed_quadratic(*parts, model.horizon)
    filters[TRUE] = PolynomialFilter(ScheduledFilter(printed.schedule), 2)
    filters["mixture"] = hg.filters.mixture_filter(*parts, resolution)
    # What is known before any run, from the covariance of the initial state on.
    steps = {name: schedule.gains.covariance for name, schedule in (schedules | {"memory": memory}).items()}
    steps |= {CLAIMED: printed.schedule.gains.covariance, TRUE: printed.true_covariance}
    start = first(model.plant).initial_covariance[None]
    covariance = {name: np.concatenate([start, value]) for name, value in steps.items()}
    return Designs(filters, covariance, skewness(systems["quadratic"], len(model.states), 1))


def _with_a_run(model: Model, setting: Setting, stages: Stages) -> tuple[Numbers, hg.Record]:
    designs = design(model, 0.0)
    judged = numbers(model, designs, setting, stages)
    return judged, hg.monte_carlo(designs.network(model), model.horizon, 1, setting.seed)


def numbers(model: Model, designs: Designs, setting: Setting, stages: Stages) -> Numbers:
    """Run all filters of a model on the same data."""
    network = designs.network(model)
    sums = hg.monte_carlo(network, model.horizon, setting.runs, setting.seed, hg.Statistics(), progress=stages.progress)

    def named(values: np.ndarray, suffix: str = "") -> dict[str, float]:
        return {f"{state}{suffix}": value.tolist() for state, value in zip(model.states, values, strict=True)}

    # Designed: variances over time, and their means over the steps that count.
    variances = {name: np.diagonal(value, axis1=1, axis2=2) for name, value in designs.covariance.items()}
    means = {name: value[model.begin + 1 :].mean(axis=0) for name, value in variances.items()}
    # Simulated on the same runs, and their differences to the linear filter.
    squares = {name: _mean_square(part, None, model.begin) for name, part in sums[NODE].items()}
    simulated: dict[str, dict[str, Any]] = {}
    for name, part in sums[NODE].items():
        difference = _mean_square(part, sums[NODE]["linear"], model.begin)
        minus_linear = {**named(difference[0]), **named(difference[1], "_se")}
        simulated[name] = {**named(squares[name][0]), **named(squares[name][1], "_se"), "minus_linear": minus_linear}
    gains = {name: 100 * (1 - mean / means["linear"]) for name, mean in means.items() if name != "linear"}
    gains["mixture"] = 100 * (1 - squares["mixture"][0] / squares["linear"][0])
    return Numbers(
        covariance={name: dict(zip(model.states, value.T, strict=True)) for name, value in variances.items()},
        mean_covariance={name: named(mean) for name, mean in means.items()},
        gain_percent={name: named(gain) for name, gain in gains.items()},
        monte_carlo=simulated,
        skewness=designs.skewness,
        model=model,
        designed=designs.covariance,
        errors={name: np.diagonal(part.actual(), axis1=1, axis2=2) for name, part in sums[NODE].items()},
    )


def _mean_square(part: ErrorStatistics, against: ErrorStatistics | None, begin: int) -> tuple[np.ndarray, np.ndarray]:
    """Squared error averaged over runs and the steps that count, and its standard error from batches, (n,) each.

    `against`: the difference to another filter on the same runs, whose common part cancels.
    """

    def squared(statistics: ErrorStatistics) -> np.ndarray:
        return np.asarray(np.diagonal(statistics.outer[:, begin:], axis1=2, axis2=3).mean(axis=1))

    values, count = squared(part), part.count
    if against is not None:
        values = values - squared(against)
    mean = values.sum(axis=0) / count.sum()
    used = count > 0
    batches = int(np.count_nonzero(used))
    scatter = np.sum((values[used] - mean * count[used, None]) ** 2, axis=0) * batches / max(batches - 1, 1)
    return mean, np.sqrt(scatter) / count.sum()


def write_record(outcome: Outcome, folder: Path) -> None:
    """Covariances and mean squared errors over time of the example, and its run, as NetCDF."""
    import xarray

    example, run = outcome.example, outcome.run
    truth, estimates = run.truth, run.estimates[NODE]
    assert truth is not None
    data = {
        "covariance": (("design", "time", "state", "state_2"), np.array(list(example.designed.values()))),
        "mean_squared_error": (("filter", "step", "state"), np.array(list(example.errors.values()))),
        "truth": (("step", "state"), truth[0]),
        "measurement": (("step",), run.measurements[NODE][0, :, 0]),
        "estimate": (("filter", "step", "state"), np.array([e.mean[0] for e in estimates.values()])),
    }
    coordinates = {
        "design": list(example.designed),
        "filter": list(example.errors),
        "state": list(example.model.states),
        "time": np.arange(example.model.horizon + 1),
        "step": np.arange(1, example.model.horizon + 1),
    }
    about = {"seed": outcome.seed, "runs": outcome.runs}
    xarray.Dataset(data, coordinates, about).to_netcdf(folder / "record.nc", engine="h5netcdf")
