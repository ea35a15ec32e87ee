"""Sensors that transmit at once, so that their signals add up on the way: a scalar state received as one number.

z = sum_i g_i a_i y_i + n of y_i = c_i x + v_i holds the information j = (b'a)^2 / (a' D a + n0) about x, with
b_i = E g_i c_i and D_i = (E g_i)^2 Var v_i + Var g_i E y_i^2. The power of per_sensor is s_i a_i^2, s_i = E y_i^2.
For any l >= 0, m >= 0 with sum l_i P_i + m P = 1, powers within these limits have a' diag(s (l + m)) a <= 1, and so
  j <= max_a (b'a)^2 / a' (D + n0 s (l + m)) a = sum_i b_i^2 / (D_i + n0 s_i (l_i + m)),
with equality at the best: the problem is convex and its dual has a closed form.
"""

from typing import NamedTuple

import numpy as np
from scipy.optimize import brentq

from heliograph.h_infinity.solver import run_solver, solvers
from heliograph.numerics.check import array, covariance, fail, instance, scalar
from heliograph.numerics.readable import readable
from heliograph.numerics.types import ArrayLike, Float
from heliograph.planning.moments import steady_covariance
from heliograph.planning.paths.model import at_least
from heliograph.planning.problem import Certificate

Sensors = Float[np.ndarray, "M"]


@readable
class CoherentSum(NamedTuple):
    """A scalar plant x+ = A x + w received as one sum: signal b, spread D, second moment s of each sensor; noise n0."""

    transition: float
    process: float
    signal: Sensors
    spread: Sensors
    second: Sensors
    noise: float

    def information(self, amplitudes: ArrayLike) -> float:
        """j of amplitudes (M,)."""
        a = array("amplitudes", amplitudes, (len(self.signal),))
        return float((self.signal @ a) ** 2 / (a @ (self.spread * a) + self.noise))

    def error(self, information: float) -> float:
        """Steady error variance P of the best linear filter: 1 / P = 1 / (A^2 P + Q) + j."""
        a2, q, j = self.transition**2, self.process, information
        b = 1 - a2 + q * j  # a2 j P^2 + b P - q = 0
        return 2 * q / (b + float(np.sqrt(b**2 + 4 * a2 * j * q)))


@readable
class CoherentDesign(NamedTuple):
    """Amplitudes with a certificate: `bound` is proven, no amplitudes within the limits have a smaller error."""

    amplitudes: Sensors
    powers: Sensors
    information: float
    error: float
    bound: float

    @property
    def gap(self) -> float:
        """By how much other amplitudes could be better at most."""
        return max(self.error - self.bound, 0.0)

    @property
    def words(self) -> str:
        """How good the amplitudes are, in a line."""
        return Certificate(True, self.error, self.bound, 0.0, 1, "error").words


def coherent_sum(
    transition: ArrayLike,
    process: ArrayLike,
    rows: ArrayLike,
    noises: ArrayLike,
    means: ArrayLike,
    variances: ArrayLike,
    noise: ArrayLike,
) -> CoherentSum:
    """Sensors c_i (M,) with Var v_i (M,) of a scalar plant, whose hops of mean E g_i and variance Var g_i add up.

    Raises:
        ValueError: wrong shapes, negative variances, a plant that is not stable, no noise at the receiver.
    """
    a, q = float(scalar("transition of a coherent sum", transition)), scalar("process noise", process, 0.0)
    c = array("rows of a coherent sum", rows, (None,))
    r, mu, spread = (
        array(f"{name} of a coherent sum", value, (len(c),))
        for name, value in (("noises", noises), ("mean gains", means), ("gain variances", variances))
    )
    for name, value in (("noises", r), ("gain variances", spread)):
        at_least(0.0, f"{name} of a coherent sum", value)
    second = float(steady_covariance(np.array([[a]]), covariance("process noise", [[q]]))[0, 0])
    n0 = float(scalar("noise of a coherent sum", noise, 0.0))
    if n0 == 0:
        raise fail("noise of a coherent sum", "a positive number", "0, with which any power does")
    s = c**2 * second + r
    return CoherentSum(a, float(q), mu * c, mu**2 * r + spread * s, s, n0)


def coherent_powers(
    received: CoherentSum, total: ArrayLike | None = None, per_sensor: ArrayLike | None = None
) -> CoherentDesign:
    """The best amplitudes under a limit of the total power, of each sensor's, (M,) or one number, or of both.

    a_i = min(theta b_i / (D_i + n0 s_i m), sqrt(P_i / s_i)); total power alone has m = 1 / P, limits of each m = 0 and
    theta = (a' D a + n0) / b'a, a scalar root.

    Raises:
        ValueError: no limit, a negative one.
    """
    instance("coherent sum", received, CoherentSum, "a CoherentSum")
    sum_, limit = _limits(received, total, per_sensor)
    count = len(received.signal)
    if sum_ == 0 or not np.any(limit * received.signal):
        return _design(received, np.zeros(count), 0.0)
    a, bound = _best(received, sum_, limit)
    return _design(received, np.sign(received.signal) * a, bound)


def coherent_least_power(received: CoherentSum, target: ArrayLike) -> CoherentDesign:
    """Amplitudes of the least total power that reach a target of the steady error; `bound` is that of this power.

    Raises:
        ValueError: an error that no power reaches, with the one that unlimited power leaves.
    """
    instance("coherent sum", received, CoherentSum, "a CoherentSum")
    target = float(scalar("target error", target, 0.0))
    b2 = received.signal**2
    loud = np.divide(b2, received.spread, out=np.where(b2 > 0, np.inf, 0.0), where=received.spread > 0).sum()
    limit = received.error(float(loud)) if np.isfinite(loud) else 0.0
    if target <= limit:
        raise fail("target error", f"one above {limit:.6g}, which unlimited power leaves", f"{target:.6g}")
    needed = 1 / target - 1 / (received.transition**2 * target + received.process)
    if needed <= 0:
        return _design(received, np.zeros(len(b2)), 0.0)

    def missing(log: float) -> float:
        return float((b2 / (received.spread + received.noise * received.second * np.exp(-log))).sum()) - needed

    low = high = 0.0
    while missing(high) < 0:
        high += 2.0
    while missing(low) > 0:
        low -= 2.0
    return coherent_powers(received, float(np.exp(brentq(missing, low, high, xtol=1e-14, rtol=1e-14))))


def coherent_programme(
    received: CoherentSum, total: ArrayLike | None = None, per_sensor: ArrayLike | None = None
) -> CoherentDesign:
    """The same by a second-order cone programme: min |(D^1/2 a, n0^1/2 t)| with b'a = 1 and |a_i| s_i^1/2 <= t P_i^1/2.

    Raises:
        ValueError: no limit, a negative one, a programme that the solver gives up.
        ModuleNotFoundError: cvxpy or clarabel is not installed (the extra `lmi`).
    """
    instance("coherent sum", received, CoherentSum, "a CoherentSum")
    cp = solvers()
    sum_, limit = _limits(received, total, per_sensor)
    unit = np.sqrt(received.second)
    b, d = received.signal / unit, received.spread / received.second
    size = min(sum_, float(limit.sum()))
    scale = float(np.linalg.norm(b))
    x, t = cp.Variable(len(b)), cp.Variable(nonneg=True)  # sent amplitudes, both over the power's root
    noise = np.append(np.sqrt(d), np.sqrt(received.noise / size))
    within = [b @ x / scale == 1]
    if np.isfinite(sum_):
        within.append(cp.norm(x) <= t * np.sqrt(sum_ / size))
    on = np.flatnonzero(np.isfinite(limit))
    if on.size:
        within.append(cp.abs(x[on]) <= t * np.sqrt(limit[on] / size))
    task = cp.Problem(cp.Minimize(cp.norm(cp.multiply(noise / noise.max(), cp.hstack([x, t])))), within)
    status = run_solver(task, "clarabel")
    if not status.startswith("optimal") or x.value is None:
        raise fail("cone programme", "a solution", status)
    sent = np.asarray(x.value) * float(np.sqrt(size) / t.value)
    sent *= min(1.0, float(np.sqrt(sum_ / (sent**2).sum())))
    a = np.clip(sent, -np.sqrt(limit), np.sqrt(limit)) / unit
    return _design(received, a, _best(received, sum_, limit)[1])


def _limits(received: CoherentSum, total: ArrayLike | None, per_sensor: ArrayLike | None) -> tuple[float, Sensors]:
    """The total and each sensor's, infinite where there is none."""
    count = len(received.signal)
    sum_ = np.inf if total is None else float(scalar("total power", total, 0.0))
    limit = np.full(count, np.inf)
    if per_sensor is not None:
        limit = at_least(
            0.0, "power per sensor", array("power per sensor", np.broadcast_to(per_sensor, count), (count,))
        )
    useful = limit[received.signal != 0]
    if not np.isfinite(sum_) and not np.all(np.isfinite(useful)):
        raise fail("limits of a coherent sum", "a total or the power per sensor", "none")
    return sum_, limit


def _design(received: CoherentSum, a: Sensors, bound: float) -> CoherentDesign:
    j = received.information(a)
    return CoherentDesign(a, received.second * a**2, j, received.error(j), received.error(max(bound, j)))


def _best(received: CoherentSum, total: float, limit: Sensors) -> tuple[Sensors, float]:
    """Amplitudes, for gains of positive mean, and the dual's bound of their information."""
    b, s, n0 = np.abs(received.signal), received.second, received.noise
    cap = np.sqrt(limit / s)
    if np.isfinite(total):
        a = b / (received.spread + n0 * s / total)
        a *= np.sqrt(total / (s * a**2).sum())
        if np.all(a <= cap):
            return a, float((b**2 / (received.spread + n0 * s / total)).sum())
    price = 0.0
    if not np.all(np.isfinite(cap[b > 0])) or _sent(received, cap, 0.0) > total:
        price = float(brentq(lambda m: _sent(received, cap, m) - total, 0.0, 1 / total, xtol=1e-16 / total, rtol=1e-15))
    theta = _theta(received, cap, price)
    a = _capped(received, cap, price, theta)
    worth = np.divide(theta * b, a, out=np.zeros_like(a), where=a > 0)
    multipliers = np.where(
        np.isfinite(limit) & (a > 0), np.maximum((worth - received.spread) / (n0 * s) - price, 0.0), 0.0
    )
    spent = float((multipliers * np.where(np.isfinite(limit), limit, 0.0)).sum()) + (price * total if price else 0.0)
    return a, float((b**2 / (received.spread + n0 * s * (multipliers + price) / spent)).sum())


def _capped(received: CoherentSum, cap: Sensors, price: float, theta: float) -> Sensors:
    cost = received.spread + received.noise * received.second * price
    b = np.abs(received.signal)
    return np.asarray(np.minimum(np.divide(theta * b, cost, out=np.where(b > 0, np.inf, 0.0), where=cost > 0), cap))


def _theta(received: CoherentSum, cap: Sensors, price: float) -> float:
    """theta = (a' D a + n0) / b'a, whose excess grows with theta."""

    def excess(log: float) -> float:
        a = _capped(received, cap, price, float(np.exp(log)))
        return float(np.exp(log) * (np.abs(received.signal) @ a) - a @ (received.spread * a) - received.noise)

    low = high = 0.0
    while excess(high) < 0:
        high += 2.0
    while excess(low) > 0:
        low -= 2.0
    return float(np.exp(brentq(excess, low, high, xtol=1e-15, rtol=1e-15)))


def _sent(received: CoherentSum, cap: Sensors, price: float) -> float:
    """Total power at a price of it."""
    a = _capped(received, cap, price, _theta(received, cap, price))
    return float((received.second * a**2).sum())
