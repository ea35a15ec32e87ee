"""The powers of a network chosen for a small error, or the least power for a wanted one, with what certifies them."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import numpy as np

from heliograph.model.relays import RelayNetwork
from heliograph.numerics.check import check_count, check_seed, fail, instance, items, scalar, shown
from heliograph.numerics.types import ArrayLike, Bool, Float
from heliograph.planning.budget import MET, Allowed, Budget, allowed, as_budget
from heliograph.planning.certificate import Certificate, least_total, lower_bound
from heliograph.planning.criterion import Error
from heliograph.planning.free_numbers import Build
from heliograph.planning.numbers_design import design_numbers
from heliograph.planning.objective import Objective, of_hops
from heliograph.planning.outcome import NetworkDesign
from heliograph.planning.paths import Paths
from heliograph.planning.reading import paths_of
from heliograph.planning.relaxation import relaxed
from heliograph.planning.relays_design import design_relays
from heliograph.planning.search import is_convex, least_power, search, supports
from heliograph.planning.transmitters import selected
from heliograph.simulation.network import Network

UNLIMITED = 1e13  # times alpha: more changes nothing but rounding
REACHED = 1e-9  # relative: an error so near to what unlimited power leaves is not reached


class _Task(NamedTuple):
    """What is to be designed: an objective, what is allowed, which hops are free and what the others send."""

    paths: Paths
    objective: Objective
    limits: Allowed
    free: Bool[np.ndarray, "hop"]
    held: Float[np.ndarray, "time hop"]
    starts: list[Float[np.ndarray, "time free"]]


def design(
    network: Network | RelayNetwork | Build,
    free: Sequence[str] | Mapping[str, object] | None = None,
    error: Error | None = None,
    budget: Budget | ArrayLike | None = None,
    wanted: ArrayLike | None = None,
    starts: int = 64,
    seed: int = 0,
) -> NetworkDesign:
    """Powers of the transmitters with which the best linear filter of all that the nodes receive has a small error.

    `free` names transmitters as `power` lists them, or all before a dot ("north" means "north.hop1" and the others of
    that node); all unless given. The others keep their power, and relays amplify what they hear to their power,
    whatever those before them send. `error` is the steady trace unless given; `budget` a number (the total mean power)
    or a `Budget`. With an error `wanted`, the least total mean power is sought that reaches it (within the budget, if
    one is given too).

    Numbers of any kind are free where `network` is a function of them that returns a network, and `free` says
    {name: (start, low, high)}: amplifications, weights, places; or of a function without arguments in which `hg.free`
    marks them. Channels may then share gains, tell of their modes or losses, or have uncertain probabilities: the error
    is an upper bound then, with "young" among the numbers found, the scalar in it (one for each step). Where powers are
    to differ from step to step, an array is free, and the function makes a channel of each entry
    (`hg.model.over_time`).

    Of a `RelayNetwork` the gains are free with which its relays filter what they hear; they decide what each relay
    sends, and the budget is what all relays together may send in each slot.

    With one free hop a path the problem is convex, and the certificate is a gap. With more it is not: descents begin
    from every choice of the paths that send, if there are no more than `starts`, else from drawn ones (`seed`), and the
    certificate is the global bound of the convex envelopes.

    Raises:
        ValueError: a network that is not of independent paths of hops, an unstable plant without a horizon, nothing
            free, neither a budget nor a wanted error, a budget that cannot be met, an error that no power reaches.
    Source: for one hop, Lagrange's conditions are water-filling; the gap is that of Frank and Wolfe (1956).
    """
    error = Error() if error is None else instance("error", error, Error, "an Error")
    if not isinstance(network, Network) and callable(network):
        count, draws = check_count("starts", starts), check_seed("seed", seed)
        return design_numbers(network, free, error, budget, wanted, count, draws)
    if isinstance(network, RelayNetwork):
        return design_relays(network, free, error, budget, wanted)
    instance("network", network, Network, "a Network, a RelayNetwork or a function that returns a Network")
    if budget is None and wanted is None:
        raise fail("design", "a budget of power or a wanted error", "neither")
    if isinstance(free, Mapping):
        raise fail("free", "names of transmitters (numbers are free of a function that returns a network)", shown(free))
    task = _task(network, error, free, budget, check_count("starts", starts), check_seed("seed", seed))
    least = None if wanted is None else float(scalar("wanted error", wanted, 0.0))
    found, certificate = _best(task) if least is None else _least(task, least)
    return _designed(network, error, task, found, certificate)


def _designed(
    network: Network, error: Error, task: _Task, found: Float[np.ndarray, "time free"], certificate: Certificate
) -> NetworkDesign:
    whole = task.held.copy()
    whole[:, task.free] = found
    names = task.paths.names
    every = of_hops(task.paths, error, task.objective.weighing.weight[0], np.ones(len(names), dtype=bool), whole)
    gradient = every.value_and_gradient(whole)[1]
    return NetworkDesign(
        powers=dict(zip(names, whole.T, strict=True)),
        error=task.objective.exact(found),
        present=every.exact(task.held),
        covariance=task.objective.covariances(found),
        sensitivity=dict(zip(names, gradient.sum(axis=0).tolist(), strict=True)),
        price=float(np.max(-gradient[:, task.free] * len(gradient), initial=0.0)),
        certificate=certificate,
        given=network,
        asked=error,
        numbers={},
    )


def _task(
    network: Network,
    error: Error,
    free: Sequence[str] | None,
    budget: Budget | ArrayLike | None,
    starts: int,
    seed: int,
) -> _Task:
    paths, present = paths_of(network, error)
    names = (
        paths.names if free is None else tuple(items("free", free if not isinstance(free, str) else [free], "names"))
    )
    chosen = selected(paths.names, names, "free")
    if not np.any(chosen):
        raise fail("free", f"at least one transmitter of {list(paths.names)}", "none: nothing is free")
    weight = error.matrix(network.states)
    objective = of_hops(paths, error, weight, chosen, present)
    if budget is None:
        limits = Allowed(np.full((error.steps, int(chosen.sum())), np.inf), np.full(int(chosen.sum()), np.inf), np.inf)
    else:
        limits = allowed(as_budget(budget), paths.names, chosen, present)
    masks = supports(paths.path[chosen], error.steps, starts, seed)
    within = limits if np.isfinite(limits.total) else limits._replace(total=_scale(paths, limits))
    return _Task(paths, objective, limits, chosen, present, [within.even(mask) for mask in masks])


def _scale(paths: Paths, limits: Allowed) -> float:
    """A total to begin with where none is given: that of the limits, or so much that a hop's noise hardly counts."""
    each = np.minimum(limits.peak.mean(axis=0), limits.each)
    return float(np.where(np.isfinite(each), each, 10 * max(paths.alpha.max(), np.finfo(float).tiny)).sum())


def _best(task: _Task) -> tuple[Float[np.ndarray, "time free"], Certificate]:
    """The least error found within the limits."""
    found = search(task.objective, task.limits, task.starts)
    value, own = task.objective.exact(found.powers), lower_bound(task.objective, task.limits, found.powers)
    touching = task.objective.weighted(found.powers).value(found.powers)
    convex, bound = is_convex(task.paths.path[task.free]), own
    if not convex:
        objective, limits = relaxed(task.paths, task.objective, task.limits, task.free, task.held)
        beginning = [_of_paths(task, found.powers), limits.even(np.ones((len(task.held), limits.peak.shape[1]), bool))]
        bound = lower_bound(objective, limits, search(objective, limits, beginning[:1]).powers)
    stationarity = max(touching - own, 0.0) / value
    return found.powers, Certificate(convex, value, min(bound, value), stationarity, len(task.starts), "error")


def _least(task: _Task, wanted: float) -> tuple[Float[np.ndarray, "time free"], Certificate]:
    """The least power found that reaches the wanted error."""
    _check_reachable(task, wanted)
    limits = task.limits._replace(total=np.inf)
    found = least_power(task.objective, limits, wanted, task.starts)
    held = float(task.held[:, ~task.free].mean(axis=0).sum())
    if found is None:
        raise fail("wanted error", "one that some start reaches (give more starts)", f"{wanted:.6g}")
    if found.error > task.limits.total * (1 + MET):
        least = _best(task)[1].value
        raise fail("wanted error", f"at least {least:.6g}, the least found within the budget", f"{wanted:.6g}")
    convex, (objective, own) = is_convex(task.paths.path[task.free]), (task.objective, limits)
    near = found.powers
    stationarity = 1 - least_total(objective, own, near, wanted) / found.error if found.error > 0 else 0.0
    if not convex:
        objective, own = relaxed(task.paths, task.objective, limits, task.free, task.held)
        lower = least_power(objective, own, wanted, [_of_paths(task, near)])
        near = _of_paths(task, near) if lower is None else lower.powers
    bound = min(least_total(objective, own, near, wanted), found.error)
    return found.powers, Certificate(
        convex, found.error + held, bound + held, max(stationarity, 0.0), len(task.starts), "power"
    )


def _check_reachable(task: _Task, wanted: float) -> None:
    """Raise ValueError where the wanted error is not above what remains however much is sent."""
    most = np.minimum(task.limits.peak, UNLIMITED * np.maximum(task.paths.alpha[:, task.free], 1.0))
    bounded = np.any(np.isfinite(task.limits.peak)) or np.any(np.isfinite(task.limits.each))
    if np.any(np.isfinite(task.limits.each)):
        most = np.minimum(most, task.limits.each * len(most))  # of the mean: all in one step
    left = task.objective.exact(most)
    if wanted <= left * (1 + REACHED):
        what = "power at its limits" if bounded else "unlimited power"
        raise fail("wanted error", f"more than {left:.6g}: {what} leaves {left:.6g}", f"{wanted:.6g}")


def _of_paths(task: _Task, powers: Float[np.ndarray, "time free"]) -> Float[np.ndarray, "time path"]:
    """What the free hops of each path send together."""
    total = np.zeros((len(powers), task.paths.second.shape[1]))
    np.add.at(total.T, task.paths.path[task.free], powers.T)
    return total
