"""Powers of transmitters whose signals add up at a receiver: designs for a small error, or for a small power.

Of one scalar signal the best amplitudes have closed forms (`summed_links`); of several states they are searched, beside
a bound.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy

from heliograph.model.plant import LinearPlant
from heliograph.numerics.check import check_count, check_seed, fail, scalar
from heliograph.numerics.types import Bool
from heliograph.planning.design_problem import Certificate, DesignProblem, PowerDesign
from heliograph.planning.network_from_design import add_best_filter
from heliograph.planning.network_to_sum_of_links import find_links_of_sum, steady_covariance_with_information
from heliograph.planning.plant_moments import (
    measured_moment_with_one,
    require_constant_noise,
    require_design_plant,
    steady_moment_with_one,
)
from heliograph.planning.power_budget import PowerLimits, make_budget, make_power_limits, make_unlimited
from heliograph.planning.sum_of_links import (
    BISECTIONS,
    RELATIVE_ROUNDING,
    SummedLinks,
    Vector,
    find_amplitudes_by_formula,
)
from heliograph.planning.transmitters import (
    amplify_transmitter,
    find_free_transmitters,
    require_plain_senders,
    transmitter_names,
)
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.noises.noise import AbstractNoise
from heliograph.random_affine.sum_of_maps import Superposed
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node

BISECTIONS_BY_SEARCH = 30  # of a power that reaches a target: to 1e-9 of it
DOUBLINGS = 100  # of a power without limit, until it reaches a target


class SumOfLinksTask(NamedTuple):
    """What a design of a sum of links searches: amplitudes of the free links, within limits, for a small error.

    An amplitude is the factor by which a link's transmitter multiplies what it measures.

    Args:
        links: what the links carry, their noises and their amplitudes at present.
        limits: limits of the free links' powers.
        free: which links are free (links,).
        covariance: function of the information J of a step (n, n) that returns the steady error covariance (n, n).
        error: function of the error covariance that returns the number to be small.
        starts: number of starts of a search.
        seed: of the starts that are drawn.
    """

    links: SummedLinks
    limits: PowerLimits
    free: Bool[np.ndarray, "links"]
    covariance: Callable[[np.ndarray], np.ndarray]
    error: Callable[[np.ndarray], float]
    starts: int
    seed: int

    @property
    def fixed(self) -> float:
        """Power of the links that are not free."""
        links = self.links
        return float((links.present**2 * links.unit)[~self.free].sum())

    @property
    def caps(self) -> Vector:
        """Largest amplitude a of each link: the power a^2 t stays below peak and mean limit for a free link.

        Other links keep their present amplitude (`links.present`). t is `links.unit`, the power at amplitude 1. Limits
        have one step, since the error is steady.
        """
        links = self.links
        caps: Vector = np.abs(links.present)
        caps[self.free] = np.sqrt(np.minimum(self.limits.peak[0], self.limits.mean) / links.unit[self.free])
        return caps

    @property
    def largest_total(self) -> float:
        """Largest power sum_i caps_i^2 t_i of all free links: t_i (`unit`) at amplitude 1, caps_i^2 t_i at most."""
        links = self.links
        return min(self.limits.total, float((self.caps**2 * links.unit)[self.free].sum()))

    def compute_error(self, amplitudes: Vector) -> float:
        """Return the error with these amplitudes of all links."""
        return self.error(self.covariance(self.links.information(amplitudes)))

    def bound_error(self, total: float) -> float:
        """Return a lower bound of the error for all amplitudes with this total power of the free links.

        It is the error with an information that none of them exceeds. The links that are not free send the power
        `self.fixed` besides.
        """
        total_of_all_links = total + self.fixed
        states = self.links.rows.shape[1]
        information = np.zeros((states, states))
        if total_of_all_links > 0:
            information = self.links.best_information(total_of_all_links)
        return self.error(self.covariance(information))

    def find_amplitudes_by_formula(self, total: float) -> Vector | None:
        """Return the best amplitudes by a formula, None where there is none: it needs one signal and all links free."""
        return find_amplitudes_by_formula(self.links, total, self.caps) if np.all(self.free) else None

    def search_amplitudes(self, total: float, starts: int, first: Vector | None = None) -> Vector:
        """Return the amplitudes (links,) of the least error that descents find from `first` and from drawn starts.

        The receiver gets the sum of all links' signals, each times its amplitude. Amplitudes may be negative: their
        signs matter where noises of links are correlated. The error is not convex in them, hence several starts.

        Args:
            total: power that the free links may send together.
            starts: number of starts that are drawn.
            first: amplitudes at which the first descent begins (links,); none unless given.
        """
        links, free = self.links, self.free
        # The free amplitudes a are searched as x = a / scale in [-1, 1], the scale being the most that limits allow.
        scale = np.minimum(self.caps[free], np.sqrt(total / links.unit[free]))
        if not np.all(np.isfinite(scale)):
            raise fail("budget", "one that limits every transmitter", "no limit")

        def amplitudes_at(x: Vector) -> Vector:
            """Return the amplitudes of all links at x, with the free ones scaled down if they exceed the total power.

            x: amplitudes of the free links in units of `scale`, from -1 to 1. Other links keep their present
            amplitudes. `links.unit`: the power at amplitude 1.
            """
            a = np.clip(x, -1, 1) * scale
            power = float(a**2 @ links.unit[free])
            amplitudes = links.present.copy()
            amplitudes[free] = a * np.sqrt(total / power) if power > total else a
            return amplitudes

        def error_at(x: Vector) -> float:
            """Return the error with the amplitudes at x."""
            return self.compute_error(amplitudes_at(x))

        # Descend from `first`, if it is given, and from uniform draws in the box; keep the best end.
        generator = np.random.default_rng(self.seed)
        points = [generator.uniform(-1.0, 1.0, len(scale)) for _ in range(starts)]
        if first is not None:
            points = [np.divide(first[free], scale, out=np.zeros_like(scale), where=scale > 0), *points]
        best, least = links.present, np.inf
        for point in points:
            result = scipy.optimize.minimize(error_at, point, method="L-BFGS-B", bounds=[(-1.0, 1.0)] * len(scale))
            if result.fun < least:
                best = amplitudes_at(np.asarray(result.x))
                least = float(result.fun)
        return best


def design_sum_of_links(problem: DesignProblem, network: Network) -> PowerDesign:
    """Return the powers of the least steady error within the budget, or the least power that reaches a target error.

    By closed forms where all links of one signal are free, else by a search with a bound beside it.

    Args:
        problem: budget, error or target error, and which transmitters are free.
        network: of one node, which receives a sum of links (`superposed`).

    Raises:
        ValueError: parts that the formulas do not cover; `hg.design` of a function of free numbers does.
    """
    require_plain_senders("a design", network.nodes)
    ((name, node),) = network.nodes.items()
    error = problem.criterion
    assert isinstance(node, Node)  # by `is_sum_of_links`
    assert isinstance(node.channel, Superposed)
    if error.steps > 1:
        raise fail("design of a sum of links", "the steady error", f"an error over {error.steps} steps")
    plant, process = require_constant_noise(require_design_plant(network.plant))
    measured = np.asarray(measured_moment_with_one(node.sensor, steady_moment_with_one(plant)))  # E (y, 1)(y, 1)'
    links, unit_channel = find_links_of_sum(node, measured)
    names = tuple(f"{name}.{hop}" for hop in transmitter_names(node.channel))
    task = _make_task(problem, plant, process, links, names)
    # The best amplitudes, for the error within the budget or for the power at the target.
    if problem.target_error is None:
        amplitudes, certificate = _find_least_error_amplitudes(task, task.limits.total)
    else:
        target = float(scalar("target error", problem.target_error, 0.0))
        amplitudes, certificate = _find_least_power_amplitudes(task, target)
    # The channel with these: the one of unit amplitudes, amplified.
    channel: AbstractRandomAffine = unit_channel
    for hop, amplitude in zip(transmitter_names(node.channel), amplitudes, strict=True):
        channel = amplify_transmitter(channel, hop, float(amplitude))
    return PowerDesign(
        problem=problem,
        powers={name: np.array([power]) for name, power in zip(names, amplitudes**2 * links.unit, strict=True)},
        error=task.compute_error(amplitudes),
        certificate=certificate,
        present=task.compute_error(links.present),
        covariance=task.covariance(links.information(amplitudes))[None],
        sensitivity=dict.fromkeys(names, float("nan")),
        price=float("nan"),
        numbers={},
        realised=Network(network.plant, {name: add_best_filter(network.plant, node, channel)}),
    )


def _make_task(
    problem: DesignProblem, plant: LinearPlant, process: AbstractNoise, links: SummedLinks, names: Sequence[str]
) -> SumOfLinksTask:
    """Return the search: which links are free, the limits of their powers, and the error by a step's information.

    Args:
        problem: budget, error or target error, and which transmitters are free.
        plant: the plant.
        process: its noise.
        links: the links, with their present amplitudes.
        names: names of the links' transmitters, in the order of the links.
    """
    free = find_free_transmitters(names, problem.free)
    limits = make_unlimited(1, int(free.sum()))
    if problem.budget is not None:
        sent = links.present**2 * links.unit
        limits = make_power_limits(make_budget(problem.budget), names, free, sent[None])
    transition = np.asarray(plant.matrix)
    noise = np.asarray(process.covariance)
    criterion = problem.criterion.criterion(plant.states)
    return SumOfLinksTask(
        links=links,
        limits=limits,
        free=free,
        covariance=lambda information: steady_covariance_with_information(transition, noise, information),
        error=lambda covariance: criterion.compute_exact_error(covariance[None]),
        starts=check_count("starts", problem.starts),
        seed=check_seed("seed", problem.seed),
    )


def _find_least_error_amplitudes(task: SumOfLinksTask, total: float) -> tuple[Vector, Certificate]:
    """Return the amplitudes (links,) of least error at a total power of the free links, and their certificate.

    A formula gives them if it holds; otherwise they are searched for.

    Args:
        task: the links, their limits and the error.
        total: power that the free links may send together.
    """
    solution = task.find_amplitudes_by_formula(total)
    if solution is not None:
        error = task.compute_error(solution)
        return solution, Certificate(convex=True, value=error, bound=error, stationarity=0.0, starts=1, unit="error")
    amplitudes = task.search_amplitudes(total, task.starts)
    error = task.compute_error(amplitudes)
    bound = min(task.bound_error(min(total, task.largest_total)), error)
    return amplitudes, Certificate(
        convex=False, value=error, bound=bound, stationarity=np.nan, starts=task.starts, unit="error"
    )


def _find_least_power_amplitudes(task: SumOfLinksTask, target: float) -> tuple[Vector, Certificate]:
    """Return the amplitudes (links,) of the least power that reach a target error, and the certificate.

    By bisection of the power of the free links, since the least error falls with it.

    Args:
        task: the links, their limits and the error.
        target: the target error.
    """
    best, certificate = _find_amplitudes_that_reach(task, target)
    largest = float((best**2 * task.links.unit)[task.free].sum())
    low, high = 0.0, largest
    for _ in range(BISECTIONS if certificate.convex else BISECTIONS_BY_SEARCH):
        middle = (low + high) / 2
        tried = _find_best_at_power(task, middle, best)
        if task.compute_error(tried) <= target:
            high, best = middle, tried
        else:
            low = middle
        if high - low <= RELATIVE_ROUNDING * largest:
            break
    needed = float((best**2 * task.links.unit).sum())
    bound = needed if certificate.convex else _bound_least_power(task, target, needed)
    return best, certificate._replace(value=needed, bound=bound, unit="power")


def _find_best_at_power(task: SumOfLinksTask, power: float, near: Vector) -> Vector:
    """Return the best amplitudes at a power of the free links: by formula if it holds, else by descent from `near`.

    Args:
        task: the links, their limits and the error.
        power: power that the free links send together.
        near: amplitudes at which a descent begins (links,).
    """
    if not power > 0:
        return np.where(task.free, 0.0, task.links.present)
    solution = task.find_amplitudes_by_formula(power)
    return solution if solution is not None else task.search_amplitudes(power, 1, near)


def _bound_least_power(task: SumOfLinksTask, target: float, needed: float) -> float:
    """Return the total power at which the lower bound of the error reaches the target; no less power can reach it.

    It is found by bisection of the free links' power, up to the total power `needed` that is known to reach the target.

    Args:
        task: the links, their limits and the error; `fixed` is the power of the links that are not free.
        target: the target error.
        needed: a total power of all links that reaches it.
    """
    low, high = 0.0, needed - task.fixed
    for _ in range(BISECTIONS):
        middle = (low + high) / 2
        low, high = (low, middle) if task.bound_error(middle) <= target else (middle, high)
    return low + task.fixed


def _find_amplitudes_that_reach(task: SumOfLinksTask, target: float) -> tuple[Vector, Certificate]:
    """Return amplitudes that reach a target error: with all power within the limits, or doubled where none limits.

    Args:
        task: the links, their limits and the error.
        target: the target error.

    Raises:
        ValueError: a target that is not reached.
    """
    unlimited = not np.isfinite(task.largest_total)
    total = task.largest_total
    if unlimited:  # a power to begin doubling with: that sent at present, or the receiver's noise
        total = max(float((task.links.present**2 * task.links.unit).sum()), task.links.floor)
    found, certificate = _find_least_error_amplitudes(task, total)
    for _ in range(DOUBLINGS if unlimited else 0):
        if certificate.value <= target:
            break
        total = 2 * total
        found, certificate = _find_least_error_amplitudes(task, total)
    if certificate.value > target * (1 + RELATIVE_ROUNDING):
        within = "whatever the power" if unlimited else "within the budget"
        raise fail("target error", f"at least {certificate.value:.6g}, the least found {within}", f"{target:.6g}")
    return found, certificate
