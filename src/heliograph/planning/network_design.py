"""`hg.design`: powers, or other numbers, for a small error, or the least power for a target error."""

from collections.abc import Mapping, Sequence

import numpy as np

from heliograph.model.relays import RelayNetwork
from heliograph.numerics.check import check_count, check_seed, fail, instance, items, scalar, shown
from heliograph.numerics.types import ArrayLike, Bool
from heliograph.planning.budget import as_budget, power_limits, unlimited
from heliograph.planning.error import Error
from heliograph.planning.numbers.design import design_numbers
from heliograph.planning.paths.design import design_paths, power_task
from heliograph.planning.paths.model import Paths
from heliograph.planning.paths.networks import paths_of
from heliograph.planning.problem import BudgetLike, Designable, DesignProblem, Free, PowerDesign
from heliograph.planning.relay_design import design_relays
from heliograph.planning.transmitters import selected
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
    """Powers of the transmitters with which the best linear filter of all that the nodes receive has a small error.

    Relays amplify what they receive to their power, whatever those before them send. With one free hop a path the
    problem is convex, and the certificate is a gap. With more it is not: descents begin from every choice of the paths
    that send, if there are no more than `starts`, else from drawn ones, and the certificate is the global bound of the
    convex envelopes of each path's information.

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
        budget: the total mean power, or a `Budget`; of relays that filter, what all together may send in each slot.
        target_error: an error; then the least total mean power is sought that reaches it, within the budget if any.
        starts: number of descents, where the problem is not convex.
        seed: of the starts that are drawn.

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
    item = problem.network
    if isinstance(item, RelayNetwork):
        return design_relays(problem, item)
    if isinstance(item, Network | Paths):
        return _design_powers(problem)
    if callable(item):
        return design_numbers(problem, item)
    raise fail("network", "a Network, a RelayNetwork, Paths or a function that returns a Network", type(item).__name__)


def _design_powers(problem: DesignProblem) -> PowerDesign:
    """Design of the powers of a network of independent paths, or of paths from arrays, all of whose powers are free."""
    if problem.budget is None and problem.target_error is None:
        raise fail("design", "a budget of power or a target error", "neither")
    if isinstance(problem.free, Mapping):
        expected = "names of transmitters (numbers are free of a function that returns a network)"
        raise fail("free", expected, shown(problem.free))
    starts, seed = check_count("starts", problem.starts), check_seed("seed", problem.seed)
    target = None if problem.target_error is None else float(scalar("target error", problem.target_error, 0.0))
    error, item = problem.criterion, problem.network
    # Paths, and what is sent at present.
    if isinstance(item, Network):
        paths, fixed = paths_of(item, error)
        states = item.states
    else:
        assert isinstance(item, Paths)
        paths, fixed, states = item, np.zeros(item.kappa.shape), tuple(f"x{i}" for i in range(item.rows.shape[-1]))
        if error.steps != len(paths.kappa) or (error.horizon is None) != (paths.plants.start is None):
            raise fail("error", f"that over {len(paths.kappa)} steps for which the paths were made", f"{error.steps}")
        if problem.free is not None:
            raise fail("free powers of paths", "all of them", shown(problem.free))
    # What is free, and its limits.
    chosen = _free(paths, problem.free)
    if problem.budget is None:
        limits = unlimited(error.steps, int(chosen.sum()))
    else:
        limits = power_limits(as_budget(problem.budget), paths.names, chosen, fixed)
    criterion = error.criterion(states)
    task = power_task(paths, criterion, limits, chosen, fixed, starts, seed)
    present = task.problem.exact(fixed[:, chosen]) if isinstance(item, Network) else float("nan")
    return design_paths(problem, task, target, present)


def _free(paths: Paths, free: Sequence[str] | None) -> Bool[np.ndarray, "hop"]:
    """Mask of the free transmitters."""
    if free is None:
        names: Sequence[str] = paths.names
    else:
        names = tuple(items("free", free if not isinstance(free, str) else [free], "names"))
    chosen = selected(paths.names, names, "free")
    if not np.any(chosen):
        raise fail("free", f"at least one transmitter of {list(paths.names)}", "none: nothing is free")
    return chosen
