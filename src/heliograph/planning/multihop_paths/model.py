"""Independent paths of hops: the information a receiver gains over each from the powers of its transmitters.

A path carries c x + v over hops `received = g sent + m`, each of which amplifies its input to its power p. Its noise,
received over its mean gain less c x, is s K / F - t with s = E y^2, t = s - Var v, K the product of
kappa = E g^2 / (E g)^2 and F that of p / (p + alpha), alpha = Var m / E g^2. So it carries the information
    j = F / (s K - t F),   dj/dp_h = s K / (s K - t F)^2 dF/dp_h:
nothing is divided by a power, which may be zero.

The best linear filter in information form has P_k^-1 = X_k^-1 + J_k, X_k = A P_{k-1} A' + Q. For a cost
sum_k <W_k, P_k> the adjoint L_k = W_k + Phi_{k+1}' L_{k+1} Phi_{k+1}, Phi_k = (I - P_k J_k) A_k, gives
d cost = - sum_k <P_k L_k P_k, dJ_k>: one backward recursion, or one Lyapunov equation, for any number of parameters.
"""

from functools import reduce
from typing import NamedTuple

import numpy as np
from typing_extensions import TypeAliasType

from heliograph.factors.square_root_update import covariance_of_root, observe_information, roots_of
from heliograph.linear.jump_system import JumpSystem
from heliograph.model.plant import LinearPlant
from heliograph.numerics.check import array, covariance, fail, instance, names, rank
from heliograph.numerics.module import readable
from heliograph.numerics.types import ArrayLike, Float, Int
from heliograph.planning.error_objective import Error
from heliograph.planning.plant_moments import moments_with_one_over, steady_moment_with_one

DOUBLINGS = 60
CONVERGED = 1e-16  # relative change of the fixed point by a doubling: rounding

Matrices = Float[np.ndarray, "time n n"]


class PlantSteps(NamedTuple):
    """Linear plant x+ = A x + w, Cov w = Q, at each step.

    Args:
        transition: A (time, n, n).
        process: Q (time, n, n).
        start: error covariance before the first step (n, n); None where the steps repeat for ever.
    """

    transition: Matrices
    process: Matrices
    start: Float[np.ndarray, "n n"] | None


class RiccatiMap(NamedTuple):
    """Map X -> A X (I + G X)^-1 A' + H of predicted covariances over one step of the filter, or over several."""

    a: Float[np.ndarray, "n n"]
    g: Float[np.ndarray, "n n"]
    h: Float[np.ndarray, "n n"]


def compose_steps(first: RiccatiMap, second: RiccatiMap) -> RiccatiMap:
    """Return the map of two filter steps, `first` and then `second`, as one map X -> A X (I + G X)^-1 A' + H.

    Maps of this form are closed under composition, so that one of many steps is found by doubling.
    """
    inner = np.linalg.inv(np.eye(len(first.h)) + first.h @ second.g)
    through = inner @ first.a
    g = first.g + first.a.T @ second.g @ through
    h = second.h + second.a @ inner @ first.h @ second.a.T
    return RiccatiMap(a=second.a @ through, g=(g + g.T) / 2, h=(h + h.T) / 2)


def solve_fixed_point(step: RiccatiMap) -> Float[np.ndarray, "n n"]:
    """Return the limit X of X+ = A X (I + G X)^-1 A' + H from X = 0, by doubling: k doublings make 2^k steps.

    It is reached when a doubling changes H by at most the share CONVERGED. `step`: A, G and H.

    Raises:
        ValueError: covariances that grow without limit.
    """
    with np.errstate(over="ignore", invalid="ignore"):
        for _ in range(DOUBLINGS):
            twice = compose_steps(step, step)
            if not np.all(np.isfinite(twice.h)):
                break
            if np.abs(twice.h - step.h).max() <= CONVERGED * np.abs(twice.h).max():
                return twice.h
            step = twice
    raise fail("steady error", "one that converges (the plant is unstable in a state that nobody receives)", "growth")


def compute_covariances(plants: PlantSteps, information: Matrices) -> Matrices:
    """Return the posterior covariance P_k of each step (time, n, n) under the information J_k received at each step.

    Args:
        plants: A and Q of each step, and the covariance before the first, if any.
        information: J_k (time, n, n).

    Raises:
        ValueError: steps that repeat for ever, under which the error grows without limit.
    """
    a, q = plants.transition, plants.process
    # Predicted covariance of the first step: fixed point over the period, or from the start. Each map of the period
    # takes in step k - 1's information and moves to step k.
    if plants.start is None:
        steps = [RiccatiMap(a=a[k], g=information[k - 1], h=q[k]) for k in (*range(1, len(a)), 0)]
        predicted = solve_fixed_point(reduce(compose_steps, steps))
    else:
        predicted = a[0] @ plants.start @ a[0].T + q[0]
    # The recursion through the steps, on roots.
    root = roots_of(predicted)
    process = roots_of(q)
    posteriors = list[np.ndarray]()
    for k, received in enumerate(information):
        if k:  # the first step is predicted already
            root = np.concatenate([a[k] @ root, process[k]], axis=1)
        root = observe_information(root, received).root
        posteriors.append(covariance_of_root(root))
    return np.array(posteriors)


def compute_adjoint(plants: PlantSteps, information: Matrices, p: Matrices, weights: Matrices) -> Matrices:
    """Return the adjoint L_k (time, n, n): the gradient of the cost by P_k, through P_k itself and all later steps.

    Args:
        plants: A and Q of each step.
        information: J_k, the information received at each step (time, n, n).
        p: P_k, the error covariance after each step (time, n, n).
        weights: W_k, the derivative of the cost by P_k alone (time, n, n).
    """
    # From step to step the filter's error is multiplied by phi, and its covariance moves by X+ = phi X phi'.
    phi = (np.eye(p.shape[-1]) - p @ information) @ plants.transition
    one_mode_always = np.ones((len(p), 1, 1))
    no_noise = np.zeros_like(phi[:, None])
    system = JumpSystem(one_mode_always, phi[:, None], no_noise)
    return system.adjoint(weights, plants.start is None)[:, 0]


Powers = Float[np.ndarray, "time hop"]
PathValues = Float[np.ndarray, "time path"]
Matrix = TypeAliasType("Matrix", Float[ArrayLike, "_ _"])
Vector = TypeAliasType("Vector", Float[ArrayLike, " _"])
ByHop = TypeAliasType("ByHop", Float[ArrayLike, "..."])  # (M, H); (M,) of one hop a path; one number for all


@readable
class Paths(NamedTuple):
    """Linear plant measured over independent paths, each of which carries y = c x + v over a chain of hops.

    Arrays have a leading axis of the steps of a period or a horizon.

    Args:
        plants: A and Q of each step.
        rows: c of each path (time, path, n).
        second: s = E y^2 of each path (time, path).
        signal: t = s - Var v (time, path).
        path: number of the path of each hop, in the order of the hops (hop,).
        kappa: E g^2 / (E g)^2 of each hop's random gain g (time, hop).
        alpha: noise variance over E g^2 of each hop (time, hop).
        names: names of the hops' transmitters.
    """

    plants: PlantSteps
    rows: Float[np.ndarray, "time path n"]
    second: PathValues
    signal: PathValues
    path: Int[np.ndarray, "hop"]
    kappa: Powers
    alpha: Powers
    names: tuple[str, ...]


class PathInformation(NamedTuple):
    """Information j of each path at each step, and its derivative by the power of each hop."""

    information: PathValues
    slope: Powers


def independent_paths(
    transition: Matrix,
    process: Matrix,
    rows: Matrix,
    noises: Vector,
    kappa: ByHop,
    alpha: ByHop,
    error: "Error | None" = None,
    initial_mean: Vector | None = None,
    initial_covariance: Matrix | None = None,
    transmitters: tuple[str, ...] | None = None,
) -> "Paths":
    """Return the paths of a plant x+ = A x + w and sensors y_i = c_i x + v_i, each measured over hops of its own.

    A hop delivers g sent + m; relays amplify what they receive, noise included. Hops are listed path by path.

    Args:
        transition: A, shape (n, n).
        process: Q = Cov w, shape (n, n).
        rows: c_i, shape (M, n).
        noises: Var v_i, shape (M,).
        kappa: E g^2 / (E g)^2 of each hop, shape (M,) for one hop a path, (M, H) for several, or one number.
        alpha: Var m / E g^2 of each hop, the noise in units of sent power, shaped likewise.
        error: over which steps: steady unless it has a period or a horizon.
        initial_mean: mean of x_0, shape (n,), zero unless given; used over a horizon.
        initial_covariance: covariance of x_0, shape (n, n), needed over a horizon (default none).
        transmitters: names of the transmitters, "sender0" and so on unless given.

    Returns:
        The paths, which `hg.design` takes in place of a network.

    Raises:
        ValueError: wrong shapes, kappa below 1, negative variances, a plant that is not stable without a horizon, no
            law of x_0 with one.
    """
    error = instance("error", Error() if error is None else error, Error, "an Error")
    steps = error.steps
    a = array("transition of paths", transition, ("states", "states"))
    n = len(a)
    a = array("transition of paths", a, (n, n))
    q = covariance("process noise of paths", process, n)
    c = array("rows of paths", rows, (None, n))
    r = require_at_least(0.0, "noises of paths", array("noises of paths", noises, (len(c),)))
    # kappa and alpha of all hops (sensors, hops of each); one of alpha without a second axis.
    sensors = len(c)
    hops_each = 1 if rank("alpha of paths", alpha) < 2 else np.shape(alpha)[1]
    hop_kappa = _read_hop_numbers("kappa of paths", kappa, (sensors, hops_each), least=1.0)
    hop_alpha = _read_hop_numbers("alpha of paths", alpha, (sensors, hops_each), least=0.0)
    mean = array("initial mean of paths", np.zeros(n) if initial_mean is None else initial_mean, (n,))
    start = None
    if error.horizon is not None:
        if initial_covariance is None:
            raise fail("paths over a horizon", "initial_covariance", "none")
        start = covariance("initial covariance of paths", initial_covariance, n)
    # E (c x)^2 of each sensor from the second moment of the state, its mean included: E (x, 1)(x, 1)' without the 1.
    plant = LinearPlant(a, q, mean, np.eye(n) if start is None else start)
    seconds = [steady_moment_with_one(plant)] * steps if start is None else moments_with_one_over(plant, steps)
    signal = np.einsum("in,tnm,im->ti", c, np.array(seconds)[:, :-1, :-1], c)
    return Paths(
        plants=PlantSteps(np.tile(a, (steps, 1, 1)), np.tile(q, (steps, 1, 1)), start),
        rows=np.tile(c, (steps, 1, 1)),
        second=signal + r,
        signal=signal,
        path=np.repeat(np.arange(sensors), hops_each),
        kappa=np.tile(hop_kappa.ravel(), (steps, 1)),
        alpha=np.tile(hop_alpha.ravel(), (steps, 1)),
        names=names("names of transmitters", transmitters, sensors * hops_each, "sender"),
    )


def require_at_least(least: float, name: str, value: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Return the numbers of this name, none below `least`; ValueError if some are."""
    if value.size and np.min(value) < least:
        raise fail(name, f"numbers of at least {least:g}", f"{np.min(value):g}")
    return value


def _read_hop_numbers(
    name: str, value: ArrayLike, shape: tuple[int, int], least: float
) -> Float[np.ndarray, "sensors hops"]:
    """Return a number for each hop, of this shape (sensors, hops of each), none below `least`.

    Args:
        name: name of the numbers, for messages.
        value: numbers of that shape, one for all hops, or one for each sensor if all have one hop.
        shape: (sensors, hops of each).
        least: the least value that is allowed.
    """
    numbers = np.asarray(value)
    if numbers.ndim == 0:
        numbers = np.broadcast_to(numbers, shape)
    elif numbers.ndim == 1 and shape[1] == 1:
        numbers = numbers[:, None]
    return require_at_least(least, name, array(name, numbers, shape))


def compute_path_kappas(paths: Paths) -> PathValues:
    """Return K (time, path), the product of kappa = E g^2 / (E g)^2 of the hops along each path."""
    kappas, _ = _arrange_by_position(paths, paths.kappa)  # (time, path, position along the path)
    return np.asarray(kappas.prod(axis=-1))


def _arrange_by_position(
    paths: Paths, values: Powers
) -> tuple[Float[np.ndarray, "time path position"], Int[np.ndarray, "hop"]]:
    """Return the values of hops as (time, path, position along the path), and the position of each hop on its path.

    Where a path is shorter than the longest, the value is 1.

    Args:
        paths: the paths, each a chain of hops.
        values: a number of each hop at each step (time, hop).
    """
    order = np.argsort(paths.path, kind="stable")
    hop_counts = np.bincount(paths.path, minlength=paths.second.shape[1])
    first_hops = np.cumsum(hop_counts) - hop_counts  # of each path, in the order by paths
    positions = np.empty_like(paths.path)
    positions[order] = np.arange(len(order)) - np.repeat(first_hops, hop_counts)
    arranged = np.ones((len(values), len(hop_counts), max(1, int(hop_counts.max(initial=1)))))
    arranged[:, paths.path, positions] = values
    return arranged, positions


def share_of_signal(powers: Powers, alpha: Powers) -> Powers:
    """Return the share of signal p / (p + alpha) in what each hop delivers (time, hop), with alpha in sent power.

    Args:
        powers: what each hop sends, p (time, hop).
        alpha: noise of each hop in units of sent power (time, hop).
    """
    total = powers + alpha
    # A hop without noise and power has the share 1: without noise any power will do.
    return np.asarray(np.divide(powers, total, out=np.ones_like(powers), where=total > 0))


def compute_path_information(paths: Paths, powers: Powers) -> PathInformation:
    """Return the information j of each path at each step, and dj/dp of each hop, at these powers (time, hop).

    j = F / (s K - t F) and dj/dp_h = s K / (s K - t F)^2 dF/dp_h. F is the product of p / (p + alpha) over the hops of
    a path, with alpha = (noise variance) / E g^2 and g a hop's gain; K is the product of kappa = E g^2 / (E g)^2.
    s = E y^2 (`paths.second`) is the power of the measurement, and t (`paths.signal`) is s less its noise variance.
    """
    shares = share_of_signal(powers, paths.alpha)
    factors, positions = _arrange_by_position(paths, shares)  # factors (time, path, position)
    F = factors.prod(axis=-1)
    sK = paths.second * compute_path_kappas(paths)
    denominator = sK - paths.signal * F
    # dF/dp_h is the product of the other hops' factors times alpha / (p + alpha)^2.
    products_of_others = [np.delete(factors, k, axis=-1).prod(axis=-1) for k in range(factors.shape[-1])]
    product_of_others = np.stack(products_of_others, axis=-1)[:, paths.path, positions]
    total = powers + paths.alpha
    slope_of_factor = np.divide(paths.alpha, total**2, out=np.zeros_like(powers), where=total > 0)
    slope = (sK / denominator**2)[:, paths.path] * product_of_others * slope_of_factor
    return PathInformation(F / denominator, slope)


def compute_information_matrix(paths: Paths, information: PathValues) -> Float[np.ndarray, "time n n"]:
    """Return the information J = sum_i j_i c_i' c_i of each step (time, n, n), from j of each path (time, path)."""
    return np.asarray(np.swapaxes(paths.rows, 1, 2) @ (information[:, :, None] * paths.rows))


def compute_error_covariances(paths: Paths, information: PathValues) -> Float[np.ndarray, "time n n"]:
    """Return the error covariance of the best linear filter after each step (time, n, n), from j of each path."""
    return compute_covariances(paths.plants, compute_information_matrix(paths, information))


def compute_path_sensitivities(
    paths: Paths,
    information: PathValues,
    p: Float[np.ndarray, "time n n"],
    weights: Float[np.ndarray, "time n n"],
) -> PathValues:
    """Return -d cost / d j = c P L P c' of each path at each step, (time, path), with c its row and L the adjoint.

    Args:
        paths: the paths.
        information: j of each path (time, path).
        p: the error covariance P after each step.
        weights: the derivative of the cost by each step's P.
    """
    L = compute_adjoint(paths.plants, compute_information_matrix(paths, information), p, weights)
    c_P = paths.rows @ p  # row i: c_i P (time, path, n)
    return np.asarray(np.sum((c_P @ L) * c_P, axis=-1))
