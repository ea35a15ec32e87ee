"""`hg.design`: powers, relays, or other numbers, for a small error, or the least power for a target error."""

from math import ceil

import numpy as np

from heliograph.filters.linear.scheduled_gains import ScheduledFilter
from heliograph.model.relays import RECEIVER, SENSOR, RelayNetwork
from heliograph.numerics.check import check_count, check_seed, fail, instance, scalar, show_value
from heliograph.numerics.types import ArrayLike, Float
from heliograph.planning.design_problem import BudgetLike, Certificate, Designable, DesignProblem, Free, PowerDesign
from heliograph.planning.error_objective import Error
from heliograph.planning.free_numbers.design import design_numbers
from heliograph.planning.multihop_paths.design import design_paths
from heliograph.planning.multihop_paths.model import Paths
from heliograph.planning.multihop_paths.network_to_paths import paths_of
from heliograph.planning.multihop_paths.path_problem import make_power_task
from heliograph.planning.network_from_design import BEST, COVERED
from heliograph.planning.network_to_sum_of_links import is_sum_of_links
from heliograph.planning.plant_moments import measured_moment_with_one, steady_moment_with_one
from heliograph.planning.power_budget import make_budget, make_power_limits, make_unlimited
from heliograph.planning.sum_of_links_design import design_sum_of_links
from heliograph.planning.transmitters import find_free_transmitters
from heliograph.relays.design import given_design, relay_schedules
from heliograph.relays.periodic_steady_state import (
    periodic_behind_relays,
    periodic_given_design,
    periodic_local_error_design,
    periodic_relays_for_best_receiver,
)
from heliograph.relays.receiver import receiver_behind_relays
from heliograph.simulation.network import Network


def design(
    network: Designable,
    free: Free | None = None,
    error: Error | None = None,
    budget: BudgetLike | None = None,
    target_error: ArrayLike | None = None,
    starts: int = 64,
    seed: int = 0,
) -> PowerDesign:
    """Return the powers with which the best linear filter of all that the nodes receive has a small error.

    Relays amplify what they receive to their power, whatever those before them send. With one free hop a path the
    problem is convex, and the certificate is a gap. With more it is not: descents begin from every choice of the paths
    that send, if there are no more than `starts`, else from drawn ones, and the certificate is the global bound of the
    convex envelopes of each path's information.

    Where one node receives a sum of links (`superposed`) of one scalar signal, the best amplitudes are closed forms and
    the gap is 0; of several states they are searched, and no linear filter has less error than the bound, that of
    links apart with the whole budget each.

    Numbers of any kind are free where `network` is a function of them that returns a network. Channels may then share
    gains, have observed losses or modes, or uncertain probabilities: the error is an upper bound then, with "young"
    among the numbers, the scalar of Young's inequality in it (one for each step). Where powers are to differ from step
    to step, an array is free, and the function makes a channel of each entry (`hg.model.over_time`).

    Args:
        network: a network; independent paths from arrays (`hg.planning.independent_paths`); a function of free numbers;
            a `RelayNetwork`, whose relays' gains are free (they decide what each relay sends); or a whole
            `DesignProblem`, without further arguments.
        free: names of transmitters as `hg.power` lists them, or all before a dot ("north" means "north.hop1" and the
            others of that node), all unless given; the others keep their power. Of a function {name: (start, low,
            high)}, or none where `hg.free` marks the numbers in it.
        error: the error that is to be small; the steady trace unless given.
        budget: the total mean power, or a `Budget`; of relays that filter, what all together may send in each slot
            (default none).
        target_error: an error; then the least total mean power is sought that reaches it, within the budget if any
            (default none).
        starts: number of descents, where the problem is not convex (default 64).
        seed: of the starts that are drawn (default 0).

    Returns:
        The design, with its certificate.

    Raises:
        ValueError: a network that is not of independent paths of hops, an unstable plant without a horizon, nothing
            free, neither a budget nor a target error, a budget that cannot be met, an error that no power reaches.
    Source: for one hop, Lagrange's conditions are water filling; the gap is that of Frank and Wolfe (1956).
    """
    problem = DesignProblem(network, free, error, budget, target_error, starts, seed)
    if isinstance(network, DesignProblem):
        if problem != DesignProblem(network):
            raise fail("design of a DesignProblem", "no further arguments, which the problem holds", "some")
        problem = network
    if problem.error is not None:
        instance("error", problem.error, Error, "an Error")
    # One way for each kind of network.
    designable = problem.network
    if isinstance(designable, RelayNetwork):
        return design_relays(problem, designable)
    if isinstance(designable, Network | Paths):
        return _design_powers(problem)
    if callable(designable):
        return design_numbers(problem, designable)
    expected = "a Network, a RelayNetwork, Paths or a function that returns a Network"
    raise fail("network", expected, type(designable).__name__)


def _design_powers(problem: DesignProblem) -> PowerDesign:
    """Return the design of powers of a network of independent paths or a sum of links, or of paths from arrays.

    A design chooses the powers of transmitters, at each time, that minimise the error of the estimate within a budget
    of power, or the least power with which the error meets a target. A path is a chain of hops (amplifying
    transmitters) from one sensor output to the receiver; in a sum of links, all links add up in one received number.
    `problem` has the network (or the paths), the error to minimise, the budget or the target, and which transmitters
    are free.

    Raises:
        ValueError: neither a budget nor a target error; paths that were made for another error.
    """
    if problem.budget is None and problem.target_error is None:
        raise fail("design", "a budget of power or a target error", "neither")
    network, error = problem.network, problem.criterion
    if isinstance(network, Network) and is_sum_of_links(network):
        return design_sum_of_links(problem, network)
    # Paths, and the powers (time, hop) that are sent at present; paths from arrays have none yet.
    if isinstance(network, Network):
        paths, present_powers = paths_of(network, error)
        states = network.states
    else:
        assert isinstance(network, Paths)
        _check_paths(network, problem)
        paths, present_powers = network, np.zeros(network.kappa.shape)
        states = tuple(f"x{i}" for i in range(network.rows.shape[-1]))
    # Which transmitters are free, and the limits of their powers; without a budget there are none.
    free = find_free_transmitters(paths.names, problem.free)
    if problem.budget is None:
        limits = make_unlimited(error.steps, int(free.sum()))
    else:
        limits = make_power_limits(make_budget(problem.budget), paths.names, free, present_powers)
    starts = check_count("starts", problem.starts)
    seed = check_seed("seed", problem.seed)
    # A target error, or None: then the least error within the budget is sought.
    target = None if problem.target_error is None else float(scalar("target error", problem.target_error, 0.0))
    task = make_power_task(paths, error.criterion(states), limits, free, present_powers, starts, seed)
    sends_already = isinstance(network, Network)
    present_error = task.problem.compute_exact_error(present_powers[:, free]) if sends_already else float("nan")
    return design_paths(problem, task, target, present_error)


def _check_paths(paths: Paths, problem: DesignProblem) -> None:
    """Raise ValueError unless paths that were made from arrays fit the problem's error, and all powers are free.

    Args:
        paths: the paths, made for some number of steps.
        problem: the design problem, with its error.
    """
    error, steps = problem.criterion, len(paths.kappa)
    if error.steps != steps or (error.horizon is None) != (paths.plants.start is None):
        raise fail("error", f"that over {steps} steps for which the paths were made", f"{error.steps}")
    if problem.free is not None:
        raise fail("free powers of paths", "all of them", show_value(problem.free))


Gains = dict[str, Float[np.ndarray, "slots n _"]]


def design_relays(problem: DesignProblem, relays: RelayNetwork) -> PowerDesign:
    """Return the relays' gains with which the best linear receiver has a small steady error, averaged over the slots.

    A schedule of slots says who sends to whom; its slots are used in turn, one each step. A relay sends C s, with s
    its own linear estimate of the state, so the gains of its estimator decide what it sends: they are what is free.
    They are found by one descent through the fixed point of all second moments. The design's `present` error, to
    compare with, is that of gains with which each relay minimises the error of its own estimate.

    Args:
        problem: the design problem; its budget's total is the power that all relays together may send in each slot.
        relays: plant, sensor, relays, and the links of each slot.

    Raises:
        ValueError: another error than the steady trace, a target error, some relays free alone, limits of single ones.
    """
    power_limit = _find_relay_power_limits(problem)
    # The receiver's error covariances (slots, n, n) with the designed gains, and with those of the best own estimates.
    gains = periodic_relays_for_best_receiver(relays, power_limit=power_limit)
    local_gains = periodic_local_error_design(relays).gains
    covariance, local_covariance = (periodic_behind_relays(relays, design) for design in (gains, local_gains))
    value, present = (float(np.trace(p, axis1=1, axis2=2).mean()) for p in (covariance, local_covariance))
    # What relays send does not depend on the receiver, whose gains may be zero. The sensor sends in slots in which
    # anyone receives it, each time with the power E y'y.
    slots, n = len(relays.slots), len(relays.states)
    receiver_gains = {RECEIVER: np.zeros((slots, n, relays.received[-1]))}
    powers = periodic_given_design(relays, gains | receiver_gains).power
    measured = measured_moment_with_one(relays.sensor, steady_moment_with_one(relays.plant))  # E (y, 1)(y, 1)'
    sensor_sends = [any(SENSOR in links for links in slot.values()) for slot in relays.slots]
    # One descent of a problem that is not convex: no bound is known, and no tangent of the error is computed.
    certificate = Certificate(
        convex=False, value=value, bound=float("-inf"), stationarity=float("nan"), starts=1, unit="error"
    )
    return PowerDesign(
        problem=problem,
        powers={SENSOR: np.trace(measured[:-1, :-1]) * np.array(sensor_sends, dtype=float), **powers},
        error=value,
        certificate=certificate,
        present=present,
        covariance=np.asarray(covariance),
        sensitivity={name: float("nan") for name in powers},
        price=float("nan"),
        numbers=dict(gains),
        realised=_make_relay_network(relays, gains),
    )


def _find_relay_power_limits(problem: DesignProblem) -> float | None:
    """Return the total power that relays which filter may send in each slot, or None without a limit.

    The design of such relays minimises the trace of the steady error covariance, and knows no other limit.

    Raises:
        ValueError: another error to minimise, a target error, only some relays free, limits of single relays.
    """
    if problem.free is not None or problem.target_error is not None:
        raise fail("design of relays that filter", "all relays free, and a budget or none", "free or target_error")
    error = problem.criterion
    if error.weight is not None or error.worst or error.steps > 1 or error.horizon is not None:
        raise fail("error of relays that filter", "the steady trace (slots are the steps)", "another")
    limits = None if problem.budget is None else make_budget(problem.budget)
    if limits is not None and (limits.total is None or limits.per_transmitter is not None or limits.peak is not None):
        raise fail("budget of relays that filter", "a total for each slot", "other limits")
    return None if limits is None else limits.total


def _make_relay_network(relays: RelayNetwork, gains: Gains) -> Network:
    """Return a network of relays with gains by slot, and the best receiver for them, for at least COVERED steps.

    Args:
        relays: plant, sensor, relays, and the links of each slot.
        gains: {relay: gains of its estimator (slots, n, received)}.
    """
    slots, n = len(relays.slots), len(relays.states)
    # The slots of a period are repeated until COVERED steps are reached.
    times = ceil(COVERED / slots)
    over_time = {name: np.tile(gain, (times, 1, 1)) for name, gain in gains.items()}
    # `given_design` asks for gains of the receiver too. They are zeros, and their schedule is dropped: the receiver of
    # the network is the best filter behind these relays (`receiver_behind_relays`).
    receiver_gains = {RECEIVER: np.zeros((times * slots, n, relays.received[-1]))}
    schedules = relay_schedules(relays, given_design(relays, over_time | receiver_gains))
    schedules.pop(RECEIVER)
    return Network.of_relays(relays, schedules, {BEST: ScheduledFilter(receiver_behind_relays(relays, over_time))})
