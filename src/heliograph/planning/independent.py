"""Independent paths from plain arrays: a linear plant, its sensors, and the fading and noise of their hops."""

from collections.abc import Sequence

import numpy as np

from heliograph.numerics.check import array, covariance, fail, instance, names, rank
from heliograph.numerics.types import ArrayLike, Float
from heliograph.planning.adjoint import Plants
from heliograph.planning.criterion import Error
from heliograph.planning.lyapunov import steady_moment
from heliograph.planning.paths import Paths


def independent_paths(
    transition: ArrayLike,
    process: ArrayLike,
    rows: ArrayLike,
    noises: ArrayLike,
    kappa: ArrayLike,
    alpha: ArrayLike,
    error: Error | None = None,
    initial_mean: ArrayLike | None = None,
    initial_covariance: ArrayLike | None = None,
    names_: Sequence[str] | None = None,
) -> Paths:
    """The plant x+ = A x + w and sensors y_i = c_i x + v_i, each heard over hops of its own.

    A hop delivers g sent + m: kappa = E g^2 / (E g)^2, and alpha = Var m / E g^2 is its noise in units of sent power.
    Relays amplify what they hear. `error` says over which steps: steady unless it has a period or a horizon, which
    starts from the law of x_0.

    Shapes: transition A, process Q (n, n), rows (M, n), noises Var v (M,), alpha (M,) for one hop or (M, H),
    kappa alike or one number. Hops are listed path by path, `names_` too.

    Raises:
        ValueError: wrong shapes, kappa below 1, negative variances, a plant that settles nowhere, no law of x_0.
    """
    error = instance("error", Error() if error is None else error, Error, "an Error")
    a = array("transition of paths", transition, (None, None))
    n, hops = len(a), 1 if rank("alpha of paths", alpha) < 2 else np.shape(alpha)[1]
    a, q = array("transition of paths", a, (n, n)), covariance("process noise of paths", process, n)
    c = array("rows of paths", rows, (None, n))
    r = at_least(0.0, "noises of paths", array("noises of paths", noises, (len(c),)))
    fading = at_least(1.0, "kappa of paths", array("kappa of paths", _by_hop(kappa, len(c), hops), (len(c), hops)))
    costs = at_least(0.0, "alpha of paths", array("alpha of paths", _by_hop(alpha, len(c), hops), (len(c), hops)))
    steps = error.steps
    start = None
    if error.horizon is not None:
        if initial_covariance is None:
            raise fail("paths over a horizon", "initial_covariance", "none")
        start = covariance("initial covariance of paths", initial_covariance, n)
    mean = array("initial mean of paths", np.zeros(n) if initial_mean is None else initial_mean, (n,))
    second = np.broadcast_to(steady_moment(a, q), (steps, n, n)) if start is None else moments(a, q, mean, start, steps)
    signal = np.einsum("in,tnm,im->ti", c, second, c)
    return Paths(
        plants=Plants(np.tile(a, (steps, 1, 1)), np.tile(q, (steps, 1, 1)), start),
        rows=np.tile(c, (steps, 1, 1)),
        second=signal + r,
        signal=signal,
        path=np.repeat(np.arange(len(c)), hops),
        kappa=np.tile(fading.ravel(), (steps, 1)),
        alpha=np.tile(costs.ravel(), (steps, 1)),
        names=names("names of transmitters", names_, len(c) * hops, "sender"),
    )


def moments(
    transition: Float[np.ndarray, "n n"],
    process: Float[np.ndarray, "n n"],
    mean: Float[np.ndarray, "n"],
    start: Float[np.ndarray, "n n"],
    steps: int,
) -> Float[np.ndarray, "time n n"]:
    """E[x_k x_k'] at k = 1 .. steps, the mean included."""
    found = [start + np.outer(mean, mean)]
    for _ in range(steps):
        found.append(transition @ found[-1] @ transition.T + process)
    return np.array(found[1:])


def at_least(least: float, name: str, value: Float[np.ndarray, "*n"]) -> Float[np.ndarray, "*n"]:
    """Numbers, none below `least`.

    Raises:
        ValueError: one that is.
    """
    if value.size and np.min(value) < least:
        raise fail(name, f"numbers of at least {least:g}", f"{np.min(value):g}")
    return value


def _by_hop(value: ArrayLike, sensors: int, hops: int) -> Float[np.ndarray, "..."]:
    """Numbers (M, H) as given, from (M,) for one hop, or from one number for all."""
    given = np.asarray(value)
    if given.ndim == 0:
        return np.broadcast_to(given, (sensors, hops))
    return given[:, None] if given.ndim == 1 and hops == 1 else given
