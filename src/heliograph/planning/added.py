"""Powers of transmitters whose signals add up: z = sum_i a_i g_i y_i + noise, with amplitudes a, errors and bounds.

With b_i = E[g_i] c_i (rows of B), D_ij = E[g_i] E[g_j] R_ij + (i = j) Var(g_i) t_i, t_i = E[y_i^2] and N the noise of
links and receiver, a step tells J = B' a a' B / (a' D a + N) of the state. Of one scalar signal x that is
j = (b' a)^2 / (a' D a + N), a generalised Rayleigh quotient:

- total power sum_i a_i^2 t_i = P: a ~ (D + N T / P)^-1 b, j = b' (D + N T / P)^-1 b;
- each a_i at most cap_i, D diagonal: a_i = min(theta b_i / D_i, cap_i), theta = (a' D a + N) / b' a;
- both: D + nu T and N - nu P in place of D and N, with nu >= 0 at which the power is P.

Of several states amplitudes are searched. No information is above B' (D + N T / P)^-1 B (Cauchy and Schwarz).
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np
import scipy

from heliograph.factors.roots import observe_information, roots_of
from heliograph.model.plant import LinearPlant
from heliograph.model.sensor import LinearSensor
from heliograph.numerics.check import check_count, check_seed, fail, scalar
from heliograph.numerics.types import Bool, Float
from heliograph.planning.budget import PowerLimits, check_budget, make_power_limits, make_unlimited
from heliograph.planning.moments import check_constant_noise, check_design_plant, measurement_moment, steady_moment
from heliograph.planning.network_of_design import add_best_filter
from heliograph.planning.problem import Certificate, DesignProblem, PowerDesign
from heliograph.planning.transmitters import amplify_transmitter, compute_sent_powers, find_free, transmitter_names
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.moments.second_moments import second_order
from heliograph.random_affine.noise import AbstractNoise
from heliograph.random_affine.superposed import Superposed
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node

Vector = Float[np.ndarray, "links"]
ALIKE = 1e-12  # relative: rows of one signal, noises that are independent
HALVINGS = 200  # of an interval that holds a multiplier or a power
SEARCHES = 30  # of a power that reaches a target: to 1e-9 of it
DOUBLINGS = 100  # of a power without limit, until it reaches a target


class SummedLinks(NamedTuple):
    """Links of a sum: rows B, noise D, power t of a unit amplitude, noise N, and the amplitudes at present."""

    rows: Float[np.ndarray, "links n"]
    noise: Float[np.ndarray, "links links"]
    unit: Vector
    floor: float
    present: Vector

    def information(self, amplitudes: Vector) -> Float[np.ndarray, "n n"]:
        """Return J of a step."""
        heard = amplitudes @ self.rows
        noise = float(amplitudes @ self.noise @ amplitudes) + self.floor
        return np.outer(heard, heard) / noise if noise > 0 else np.zeros((len(heard),) * 2)

    def best_information(self, total: float) -> Float[np.ndarray, "n n"]:
        """Return B' (D + N T / P)^-1 B, which no amplitudes of this total power exceed."""
        noise = self.noise + np.diag(self.floor * self.unit / total)
        bound: np.ndarray = self.rows.T @ np.linalg.solve(noise, self.rows)
        return bound


def adds_up(network: object) -> bool:
    """Decide whether the one node of a network receives a sum of links."""
    if not isinstance(network, Network) or network.relays is not None or network.common is not None:
        return False
    nodes = list(network.nodes.values())
    return len(nodes) == 1 and isinstance(nodes[0], Node) and isinstance(nodes[0].channel, Superposed)


class SumTask(NamedTuple):
    """What a design of a sum of links searches: amplitudes of the free links, within limits, for a small error.

    links: rows, noises and amplitudes at present. limits: of the free links' powers. free: which links are. covariance:
    of the steady error, from the information of a step; error: the criterion of it. starts, seed: of searches.
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
        """Largest amplitude of each link; of one that is not free the present one."""
        links = self.links
        caps: Vector = np.abs(links.present)
        caps[self.free] = np.sqrt(np.minimum(self.limits.peak[0], self.limits.mean) / links.unit[self.free])
        return caps

    @property
    def most(self) -> float:
        """Largest power of all free links together."""
        links = self.links
        return min(self.limits.total, float((self.caps**2 * links.unit)[self.free].sum()))

    def value(self, amplitudes: Vector) -> float:
        """Return the error with these amplitudes."""
        return self.error(self.covariance(self.links.information(amplitudes)))

    def bound(self, total: float) -> float:
        """Return the error that no amplitudes with this total power of the free links are below."""
        most = total + self.fixed
        least = self.links.best_information(most) if most > 0 else np.zeros((self.links.rows.shape[1],) * 2)
        return self.error(self.covariance(least))

    def closed(self, total: float) -> Vector | None:
        """Return the best amplitudes where a formula has them: of one signal, all links free."""
        return solve_closed_form(self.links, total, self.caps) if np.all(self.free) else None

    def search(self, total: float, starts: int, first: Vector | None = None) -> Vector:
        """Return the amplitudes of the least error that descents find; signs matter."""
        links, free = self.links, self.free
        unit = links.unit[free]
        generator, best, found = np.random.default_rng(self.seed), links.present, np.inf
        scale = np.minimum(self.caps[free], np.sqrt(total / unit))
        if not np.all(np.isfinite(scale)):
            raise fail("budget", "one that limits every transmitter", "no limit")

        def allowed(x: Vector) -> Vector:
            a = np.clip(x, -1, 1) * scale
            power = float(a**2 @ unit)
            whole = links.present.copy()
            whole[free] = a * np.sqrt(total / power) if power > total else a
            return whole

        def loss(x: Vector) -> float:
            return self.value(allowed(x))

        drawn = [generator.uniform(-1.0, 1.0, len(scale)) for _ in range(starts)]
        if first is not None:
            drawn = [np.divide(first[free], scale, out=np.zeros_like(scale), where=scale > 0), *drawn]
        for start in drawn:
            result = scipy.optimize.minimize(loss, start, method="L-BFGS-B", bounds=[(-1.0, 1.0)] * len(scale))
            if result.fun < found:
                best, found = allowed(np.asarray(result.x)), float(result.fun)
        return best


def design_added(problem: DesignProblem, network: Network) -> PowerDesign:
    """Return the powers of the least steady error within the budget, or the least power that reaches a target error.

    Closed forms where all links of one signal are free, else a search with a bound beside it.

    Raises:
        ValueError: parts that the formulas do not cover; `hg.design` of a function of free numbers does.
    """
    (name, node), error = next(iter(network.nodes.items())), problem.criterion
    assert isinstance(node, Node)
    assert isinstance(node.channel, Superposed)
    if error.steps > 1:
        raise fail("design of a sum of links", "the steady error", f"an error over {error.steps} steps")
    plant, process = check_constant_noise(check_design_plant(network.plant))
    links, unit_channel = links_of(node, np.asarray(measurement_moment(node.sensor, steady_moment(plant))))
    names = tuple(f"{name}.{hop}" for hop in transmitter_names(node.channel))
    task = _make_task(problem, plant, process, links, names)
    chosen, certificate = (
        _least_error(task, task.limits.total)
        if problem.target_error is None
        else _least_power(task, float(scalar("target error", problem.target_error, 0.0)))
    )
    # The network with these amplitudes.
    channel: AbstractRandomAffine = unit_channel
    for hop, amplitude in zip(transmitter_names(node.channel), chosen, strict=True):
        channel = amplify_transmitter(channel, hop, float(amplitude))
    return PowerDesign(
        problem=problem,
        powers={name: np.array([power]) for name, power in zip(names, chosen**2 * links.unit, strict=True)},
        error=task.value(chosen),
        certificate=certificate,
        present=task.value(links.present),
        covariance=task.covariance(links.information(chosen))[None],
        sensitivity=dict.fromkeys(names, float("nan")),
        price=float("nan"),
        numbers={},
        realised=Network(network.plant, {name: add_best_filter(network.plant, node, channel)}),
    )


def _make_task(
    problem: DesignProblem, plant: LinearPlant, process: AbstractNoise, links: SummedLinks, names: Sequence[str]
) -> SumTask:
    """Return what is searched: which links are free, the limits of their powers, and the error of an information."""
    free = find_free(names, problem.free)
    limits = make_unlimited(1, int(free.sum()))
    if problem.budget is not None:
        sent = links.present**2 * links.unit
        limits = make_power_limits(check_budget(problem.budget), names, free, sent[None])
    moves, noise = np.asarray(plant.matrix), np.asarray(process.covariance)
    criterion = problem.criterion.criterion(plant.states)
    return SumTask(
        links,
        limits,
        free,
        covariance=lambda information: steady_error(moves, noise, information),
        error=lambda covariance: criterion.exact(covariance[None]),
        starts=check_count("starts", problem.starts),
        seed=check_seed("seed", problem.seed),
    )


def _least_error(task: SumTask, total: float) -> tuple[Vector, Certificate]:
    """Return the amplitudes of the least error with a total power of the free links, and the certificate."""
    closed = task.closed(total)
    chosen = task.search(total, task.starts) if closed is None else closed
    found = task.value(chosen)
    bound = found if closed is not None else min(task.bound(min(total, task.most)), found)
    slope, starts = (np.nan, task.starts) if closed is None else (0.0, 1)
    return chosen, Certificate(closed is not None, found, bound, slope, starts, "error")


def _least_power(task: SumTask, target: float) -> tuple[Vector, Certificate]:
    """Return the amplitudes of the least power that reach a target error, by halving it, and the certificate.

    The least error falls with the power, and so does its bound: no power below that at which the bound reaches the
    target does. A search begins from what it found with more power.
    """
    chosen, certificate = _largest_needed(task, target)
    closed = certificate.convex
    high = float((chosen**2 * task.links.unit)[task.free].sum())
    low, most = 0.0, high
    for _ in range(HALVINGS if closed else SEARCHES):
        middle = (low + high) / 2
        tried = task.closed(middle) if middle > 0 else None
        if tried is None:
            tried = task.search(middle, 1, chosen) if middle > 0 else np.where(task.free, 0.0, task.links.present)
        if task.value(tried) <= target:
            high, chosen = middle, tried
        else:
            low = middle
        if high - low <= ALIKE * most:
            break
    needed = float((chosen**2 * task.links.unit).sum())
    bound = needed
    if not closed:
        low, high = 0.0, needed - task.fixed
        for _ in range(HALVINGS):
            middle = (low + high) / 2
            low, high = (low, middle) if task.bound(middle) <= target else (middle, high)
        bound = low + task.fixed
    return chosen, certificate._replace(value=needed, bound=bound, unit="power")


def _largest_needed(task: SumTask, target: float) -> tuple[Vector, Certificate]:
    """Return amplitudes that reach a target error within the limits, or with ever more power where there are none."""
    unlimited = not np.isfinite(task.most)
    total = max(float((task.links.present**2 * task.links.unit).sum()), task.links.floor) if unlimited else task.most
    chosen, certificate = _least_error(task, total)
    for _ in range(DOUBLINGS if unlimited else 0):
        if certificate.value <= target:
            break
        total = 2 * total
        chosen, certificate = _least_error(task, total)
    if certificate.value > target * (1 + ALIKE):
        within = "whatever the power" if unlimited else "within the budget"
        raise fail("target error", f"at least {certificate.value:.6g}, the least found {within}", f"{target:.6g}")
    return chosen, certificate


def links_of(node: Node, second: Float[np.ndarray, "m1 m1"]) -> tuple[SummedLinks, Superposed]:
    """Return the links of a node's sum, and the sum with all amplitudes 1."""
    sensor, channel = node.sensor, node.channel
    if not isinstance(sensor, LinearSensor) or sensor.circular:
        raise _unfit("a sensor that varies, is not linear or has angles")
    assert isinstance(channel, Superposed)
    if channel.outputs > 1 or channel.past or channel.remembers or channel.corner_count() > 1:
        raise _unfit("several outputs, delays, memory or uncertain probabilities")
    counts = [len(transmitter_names(link)) for link in channel.maps]
    if any(count != 1 for count in counts) or any(link.inputs > 1 for link in channel.maps):
        raise _unfit(f"{counts} hops and {[link.inputs for link in channel.maps]} numbers")
    unit = channel
    for hop in transmitter_names(channel):
        whole = amplify_transmitter(unit, hop, None)
        assert isinstance(whole, Superposed)
        unit = whole
    described, now = [second_order(link) for link in unit.maps], [second_order(link) for link in channel.maps]
    mean = np.array([float(d.mean_gain[0, 0]) for d in described])
    spread = np.array([float(d.nominal.center[0, 0, 0, 0]) for d in described])
    floor = sum(float(d.nominal.center[0, 0, -1, -1]) for d in described) + float(channel.noise.covariance[0, 0])
    places = [at[0] for at in channel.places]
    power = np.array(list(compute_sent_powers(unit, second).values()))
    shared = np.asarray(sensor.noise.covariance)[np.ix_(places, places)]
    noise = np.outer(mean, mean) * shared + np.diag(spread * power)
    present = np.sqrt(np.array(list(compute_sent_powers(channel, second).values())) / power)
    signs = np.array([np.sign(float(d.mean_gain[0, 0])) for d in now]) * np.sign(mean)
    rows = mean[:, None] * np.asarray(sensor.matrix)[places]
    return SummedLinks(rows, noise, power, floor, np.where(signs == 0, 1.0, signs) * present), unit


def _unfit(got: str) -> ValueError:
    expected = "links of one known hop each, for one number (else give a function of free numbers)"
    return fail("design of a sum of links", expected, got)


def steady_error(
    matrix: Float[np.ndarray, "n n"], process: Float[np.ndarray, "n n"], information: Float[np.ndarray, "n n"]
) -> Float[np.ndarray, "n n"]:
    """Return the steady covariance after each step of a filter that learns this information at each."""
    values, vectors = np.linalg.eigh(information)
    used = values > ALIKE * max(values[-1], 0.0)
    if not used.any():
        return np.asarray(scipy.linalg.solve_discrete_lyapunov(matrix, process))
    output = (vectors[:, used] * np.sqrt(values[used])).T
    prior = scipy.linalg.solve_discrete_are(matrix.T, output.T, process, np.eye(len(output)))
    return observe_information(roots_of(prior), information).covariance


def solve_closed_form(links: SummedLinks, total: float, caps: Vector) -> Vector | None:
    """Best amplitudes of one scalar signal under a total, or under limits of each where noises are independent."""
    _, sizes, right = np.linalg.svd(links.rows)
    if len(sizes) > 1 and sizes[1] > ALIKE * sizes[0]:
        return None
    b = links.rows @ right[0]
    if np.isfinite(total):
        free = np.linalg.solve(links.noise + np.diag(links.floor * links.unit / total), b)
        free = free * np.sqrt(total / (free**2 @ links.unit))
        if np.all(np.abs(free) <= caps):
            return np.asarray(free)
    diagonal = np.diagonal(links.noise)
    if np.any(np.abs(links.noise - np.diag(diagonal)) > ALIKE * np.sqrt(np.outer(diagonal, diagonal))):
        return None

    def at(nu: float) -> Vector:
        return np.asarray(
            np.sign(b) * _cap_amplitudes(np.abs(b), diagonal + nu * links.unit, links.floor - nu * total, caps)
        )

    best: np.ndarray = np.sign(b) * _cap_amplitudes(np.abs(b), diagonal, links.floor, caps)
    if best**2 @ links.unit <= total:
        return best
    low, high = 0.0, links.floor / total
    for _ in range(HALVINGS):
        nu = (low + high) / 2
        low, high = (nu, high) if at(nu) ** 2 @ links.unit > total else (low, nu)
    return at(high)


def _cap_amplitudes(b: Vector, noise: Vector, floor: float, caps: Vector) -> Vector:
    """Return a_i = min(theta b_i / D_i, cap_i) at the theta at which theta b' a = a' D a + N."""
    ratio = np.divide(b, noise, out=np.full_like(b, np.inf), where=noise > 0)

    def at(theta: float) -> Vector:
        return np.asarray(np.where(b > 0, np.minimum(theta * ratio, caps), 0.0))

    def excess(theta: float) -> float:
        a = at(theta)
        return theta * float(b @ a) - float(noise @ a**2) - floor

    low, high = 0.0, 1.0
    while excess(high) < 0:
        high *= 2
        if high > 1 / ALIKE**2:
            raise fail("budget", "one that limits every transmitter that helps", "no limit")
    for _ in range(HALVINGS):
        middle = (low + high) / 2
        low, high = (middle, high) if excess(middle) < 0 else (low, middle)
    return at(high)
