"""Identifiability of a network's free numbers, by second moments of its routes and by a recording, in words."""

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.learning.free_parameters import Parameters
from heliograph.learning.likelihood.data import LikelihoodData
from heliograph.learning.likelihood.objective import Objective, join_all_nodes, make_objectives
from heliograph.learning.likelihood.surface import LikelihoodSurface
from heliograph.learning.long_run_covariance import student_quantile
from heliograph.learning.parametric_network import Build, describe
from heliograph.learning.told_numbers import find_told_filter
from heliograph.learning.unidentified_directions import (
    WEAK_INFORMATION,
    ConfoundedNumbers,
    InformationRank,
    find_confounded,
    find_information_rank,
    format_product,
    format_sum,
)
from heliograph.model.channel import Channel
from heliograph.model.over_time import OverTime, first
from heliograph.model.sensor import AbstractSensor
from heliograph.numerics.check import check_count, check_seed, fail
from heliograph.numerics.float64 import quickly_compiled
from heliograph.numerics.linalg import cholesky, contract
from heliograph.numerics.module import readable
from heliograph.numerics.types import Array, ArrayLike, Float, PyTree
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.moments.second_moments import second_order

if TYPE_CHECKING:
    from heliograph.learning.estimate_table import Solution

KINDS_OF_MOMENTS = ("mean gain", "gain variance", "noise")
POINTS_NEAR_START = 3
LARGEST_DISTANCE = 0.5  # how far from the start, in each coordinate


@readable
@dataclass(frozen=True)
class Identifiability:
    """Identifiability: names that the data identify alone, groups of which they identify combinations, and sentences.

    Args:
        parameters: the free numbers.
        groups: groups of numbers that the data do not separate.
        ridges: number of directions in which the likelihood does not change.
        weakest: least eigenvalue of the information above zero, with each number in units of its standard error; small
            where two numbers are hard to separate.
        sentences: all this in words.
    """

    parameters: Parameters
    groups: tuple[ConfoundedNumbers, ...]
    ridges: int
    weakest: float
    sentences: tuple[str, ...]

    @property
    def identified(self) -> tuple[str, ...]:
        """Coordinates that the data identify without knowledge of the others."""
        lost = {index for group in self.groups for index in group.coordinates}
        return tuple(name for i, name in enumerate(self.parameters.coordinates) if i not in lost)

    def or_sharper(self, other: "Identifiability") -> "Identifiability":
        """Return whichever of this and `other` has fewer ridges (directions in which the likelihood is constant).

        The rank of the information is the same at almost all points, so that a point with more ridges has them by
        rounding or by chance. With equally many, the larger least eigenvalue (`weakest`) decides.
        """
        return min(self, other, key=lambda result: (result.ridges, -result.weakest))

    def at(self, solution: "Solution") -> "Identifiability":
        """Return the identifiability with estimates and intervals of what is identified."""
        return replace(self, sentences=describe_unidentified(self, solution))

    def __str__(self) -> str:
        """Return the sentences, a line for each."""
        return "\n".join(self.sentences) or "All free numbers are identified."


def identifiable(network: Build, inputs: ArrayLike | None = None, horizon: int = 400, seed: int = 0) -> Identifiability:
    """Examine what a recording of this network could identify of its free numbers, before there is one.

    Free numbers (marked by `hg.free`) are identifiable if the data's information about them has full rank. Data are
    drawn as the filter expects them, at three points around the start, and the information that their second half holds
    is examined: the information of the first half is helped by what is known of the initial state, and does not grow
    with more data.

    Args:
        network: a function that returns a Network in which numbers are marked by `hg.free`.
        inputs: inputs of the plant (horizon, inputs), which a plant with inputs needs (default none).
        horizon: number of steps of the data, where there are no inputs; 400 by default.
        seed: seed of the data and of the points (default 0).

    Raises:
        ValueError: as `fit`; numbers that messages tell, of which no law is known; senders that decide when to
            transmit.
    """
    seed = check_seed("seed", seed)
    description = describe(network)
    description.start.check_sends_each_step("identifiability")
    # The filter's likelihood as a function of the free numbers.
    *_, objective = make_objectives(description)  # the last form, which is the sharpest
    count = len(description.start.inputs)
    if inputs is None and count:
        raise fail("inputs", f"an array (steps, {count}) of {list(description.start.inputs)}", "none")
    u = np.zeros((check_count("horizon", horizon), 0)) if inputs is None else np.asarray(inputs, dtype=float)
    # At each point: draw a recording, and find the rank of the information of its second half (`late`).
    points = _draw_points_near(description.parameters.start, seed)
    ranks = []
    for i, x in enumerate(points):
        z = _draw_measurements(objective, x, u, seed + i)
        data = LikelihoodData(measurements=z[None], inputs=u[None], lengths=(len(z),))
        ranks.append(find_information_rank(LikelihoodSurface(objective, data).evaluations(x[None]).late[0]))
    return _judge_identifiability(description.parameters, points, ranks)


def identify_by_recording(surface: LikelihoodSurface, start: Float[np.ndarray, " p"], seed: int) -> Identifiability:
    """Return which free numbers a recording identifies, from its information at three points near a start (p,).

    `late` is the information of the recording's second half, in which what is known before the first step counts least.
    Points where it is not finite are left out. If it is finite at none, only the start is judged.

    Args:
        surface: the likelihood of the recording.
        start: unconstrained coordinates of the free numbers (p,).
        seed: of the points.
    """
    points = _draw_points_near(start, seed)
    late = surface.evaluations(np.stack(points)).late
    finite = [i for i in range(len(points)) if np.isfinite(late[i]).all()]
    if not finite:
        points, late, finite = [start], surface.evaluations(start[None]).late, [0]
    ranks = [find_information_rank(late[i]) for i in finite]
    return _judge_identifiability(surface.objective.description.parameters, [points[i] for i in finite], ranks)


def _draw_points_near(start: np.ndarray, seed: int) -> list[np.ndarray]:
    """Return three points (p,) drawn near a start (p,), at most LARGEST_DISTANCE (0.5) away in each coordinate.

    At the start itself numbers may be identified by chance, or not be, as where two of them are equal. Small
    coordinates are moved less.
    """
    rng = np.random.default_rng([seed, 1])
    reach = np.minimum(1.0, 0.2 + np.abs(start))
    return [
        start + rng.uniform(-LARGEST_DISTANCE, LARGEST_DISTANCE, len(start)) * reach for _ in range(POINTS_NEAR_START)
    ]


def _judge_identifiability(
    parameters: Parameters, points: list[np.ndarray], ranks: list[InformationRank]
) -> Identifiability:
    """Return what is identified, from the ranks of the information at several points, with sentences on it.

    A point with more flat directions than another has them by chance, so the point with fewest counts.

    Args:
        parameters: the free numbers.
        points: unconstrained coordinates of the points (p,).
        ranks: at each point the flat directions (`flat`, in columns), on which the data say nothing, and the least
            information in any other direction (`weakest`), of which the largest counts.
    """
    groups = tuple(find_confounded(parameters, points, ranks))
    ridges = min(rank.flat.shape[1] for rank in ranks)
    weakest = max(rank.weakest for rank in ranks)
    identifiability = Identifiability(parameters, groups, ridges, weakest, ())
    return replace(identifiability, sentences=describe_unidentified(identifiability, solution=None))


def describe_unidentified(identifiability: Identifiability, solution: "Solution | None") -> tuple[str, ...]:
    """Return sentences on the numbers that are not identified, and on the products or sums of them that are.

    Args:
        identifiability: which numbers, and which combinations of them, are identified.
        solution: the maximum, whose estimates and intervals the sentences quote; None where there is none yet.
    """
    names = identifiability.parameters.coordinates
    lines = [
        _describe_confounded_group(identifiability.parameters, group, solution) for group in identifiability.groups
    ]
    # A group of numbers becomes known once `fix` of them are; the data identify the other dimensions. If
    # there are fewer identified products than these, mean gains and covariances of the links say the rest.
    has_others = any(group.fix + len(group.exponents) < len(group.coordinates) for group in identifiability.groups)
    if solution is not None and has_others:
        lines += describe_identified_links(solution)
    if identifiability.weakest < WEAK_INFORMATION:
        lines.append(
            f"The data hardly tell some of {', '.join(names)} apart (least eigenvalue {identifiability.weakest:.1g}): "
            "expect wide intervals."
        )
    return tuple(lines)


def _describe_confounded_group(parameters: Parameters, group: ConfoundedNumbers, solution: "Solution | None") -> str:
    """Return one sentence on a group of confounded numbers: which sums or products of them the data do tell.

    Confounded numbers are those that the data do not tell apart. An example: "Of a and b only the product a * b (0.48,
    95 % 0.44..0.53) is identified; fix one."

    Args:
        parameters: the free numbers, with their names.
        group: the numbers' indices, how many must be fixed, and the products and sums that are identified.
        solution: the maximum of the likelihood; None where there is none yet.
    """
    names = [parameters.coordinates[i] for i in group.coordinates]
    if group.fix == len(names):  # no combination of them is identified
        return f"Nothing in the data tells {_join_names(names)}."
    fix = "fix one" if group.fix == 1 else f"fix {group.fix} of them"
    # Identified products x^a y^b and sums a x + b y, each with its interval.
    combinations = []
    for row in group.exponents:
        combinations.append(format_product(names, row) + _format_interval(parameters, group, row, solution, log=True))
    for row in group.weights:
        combinations.append(format_sum(names, row) + _format_interval(parameters, group, row, solution, log=False))
    # Of n numbers, of which k must be fixed, n - k combinations are identified; some are neither product nor sum.
    unnamed = len(names) - group.fix - len(combinations)
    if not combinations:
        return f"The data tell only {_count_in_words(unnamed, 'combination')} of {_join_names(names)}; {fix}."
    # Choose the words. a / b is no product but a combination; if there are sums, there are no products.
    kind = "product" if np.all(group.exponents >= 0) else "combination"
    if len(group.weights):
        kind = "sum"
    kind += "s" if len(combinations) > 1 else ""
    others = f" and {_count_in_words(unnamed, 'other combination')}" if unnamed else ""
    verb = "is" if len(combinations) == 1 and not unnamed else "are"
    return f"Of {_join_names(names)} only the {kind} {_join_names(combinations)}{others} {verb} identified; {fix}."


def _count_in_words(count: int, what: str) -> str:
    """Return a count of things as text: "one combination", "3 combinations"."""
    return f"one {what}" if count == 1 else f"{count} {what}s"


def _format_interval(
    parameters: Parameters, group: ConfoundedNumbers, row: np.ndarray, solution: "Solution | None", log: bool
) -> str:
    """Return the interval in parentheses, (0.48, 95 % 0.44..0.53), of a product or a sum at a maximum; "" if none.

    Data may tell a product or a sum of confounded parameters though not each one: so its interval is shown. By the
    delta method its variance is g' C g, with its gradient g and the covariance C of the estimates.

    Args:
        parameters: the free numbers v_i.
        group: the confounded numbers; `coordinates` are theirs.
        row: exponents a_i of a product, or weights of a sum, by number in the group.
        solution: the maximum of the likelihood; None where there is none yet.
        log: whether it is a product, whose logarithm sum_i a_i log |v_i| is a sum.
    """
    if solution is None or not all(solution.active[i] for i in group.coordinates):
        return ""
    # The value sum_i a_i v_i, or sum_i a_i log |v_i|, and its slopes by the unconstrained coordinates.
    jacobian = parameters.jacobian(solution.x)
    values = parameters.entries_at(solution.x)
    slopes, value = np.zeros(len(solution.x)), 0.0
    for entry, slope, number in zip(parameters.entries, jacobian, values, strict=True):
        if entry.coordinate in group.coordinates:
            weight = row[group.coordinates.index(entry.coordinate)]
            slopes += weight * (slope / number if log else slope)
            value += weight * (np.log(abs(number)) if log else number)
    # Half the width of the interval: the quantile of Student's t times sqrt(g' C g).
    covariance, freedom = solution.covariance()
    gradient = slopes[solution.active]
    reach = student_quantile(freedom) * float(np.sqrt(max(gradient @ covariance @ gradient, 0.0)))
    middle, low, high = ((np.exp(v) if log else v) for v in (value, value - reach, value + reach))
    return f" ({middle:.3g}, 95 % {low:.3g}..{high:.3g})"


def _join_names(names: list[str]) -> str:
    """Return names with commas between them, and "and" before the last."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"


def _draw_measurements(objective: Objective, x: np.ndarray, u: np.ndarray, seed: int) -> Float[np.ndarray, "steps m"]:
    """Return measurements (steps, received) drawn by the model of the filter at x (p,) under inputs u, row by row."""
    with jax.enable_x64(True):
        return np.asarray(_draw_measurements_by_innovations(objective, x, u, jax.random.key(seed)))


@quickly_compiled
def _draw_measurements_by_innovations(objective: Objective, x: Array, u: Array, key: jax.Array) -> jax.Array:
    """Return measurements (steps, received) drawn from the filter itself, each from N(E z, S) given those before.

    Such measurements follow the law that the likelihood assumes, which tests of identifiability need. Each row is drawn
    given those before, by the filter's own prediction. Gains or noise variances that are reported with each message are
    part of z, and drawn from their own law. `x`: the free numbers (p,), from which `objective` makes the filter. `u`:
    inputs (steps, inputs).
    """
    filter = objective.filter(jnp.asarray(x))
    reporting = find_told_filter(filter)

    def draw_row(state: PyTree, row: tuple[jax.Array, ...]) -> tuple[PyTree, jax.Array]:
        """Return the filter's state after row k, and the measurement drawn for it.

        `reporting` is the filter that reads numbers reported with messages, None if there are none; `key_of_numbers` is
        the key that they are drawn with.
        """
        k, u_k, noise = row
        prior = filter.predict(state, u_k, k)
        zeros = jnp.zeros(filter.received)
        # Draw the reported numbers first: the law of the other components depends on them.
        numbers = jnp.zeros(0)
        if reporting is not None:
            numbers = reporting.draw_numbers(jax.random.fold_in(key_of_numbers, k), k)
            zeros = reporting.with_numbers(zeros, numbers)
        # The innovation of z = 0 is -E z, with covariance S. Both are NaN for reported numbers, which get S = I and are
        # overwritten below.
        _, innovation = filter.correct(prior, zeros, k)
        is_value = ~jnp.isnan(innovation.value)
        S = jnp.where(is_value[:, None] & is_value, innovation.covariance, jnp.eye(len(zeros)))
        # z = E z + L noise, with L L' = S.
        z = cholesky(S) @ noise - innovation.value
        if reporting is not None:
            z = reporting.with_numbers(z, numbers)
        after, _ = filter.correct(prior, z, k)
        return after, z

    start = jax.tree.map(jnp.asarray, filter.init())
    key_of_numbers = jax.random.fold_in(key, 1)
    noise = jax.random.normal(key, (len(u), filter.received), dtype=float)
    measurements: jax.Array
    _, measurements = jax.lax.scan(draw_row, start, (jnp.arange(len(u)), jnp.asarray(u), noise))
    return measurements


def describe_identified_links(solution: "Solution") -> list[str]:
    """Return a sentence on each output of which the data identify mean gain, gain variance or noise.

    An example is "The received y has mean gain 0.8 (0.7 .. 0.9), 95 %, the sensor's noise included." Single parameters
    may not be identified (a gain only as the product of two) while these moments are. There is no sentence where the
    sensor or channel varies over time, or depends on inputs or the past.

    Args:
        solution: the maximum of the likelihood, at the point x, with the covariance of its active coordinates.
    """
    # The sensor and channel of all nodes together, at the starting point, to see of what kind they are.
    description = solution.surface.objective.description
    _, sensor, channel = join_all_nodes(description.start)
    if isinstance(sensor, OverTime) or not _is_route_constant(sensor, channel):
        return []

    def compute_moments_at(x: Array) -> jax.Array:
        """Return mean gain, gain variance and noise of each output (outputs, 3) at unconstrained coordinates x.

        `description` builds the network from the free numbers.
        """
        _, sensor, channel = join_all_nodes(description.at(description.parameters.values(x)))
        return _compute_link_moments(first(sensor), first(channel))

    def differentiate_moments(x: Array) -> tuple[jax.Array, jax.Array]:
        """Return these moments, and their derivatives by x (outputs, 3, p)."""
        return compute_moments_at(x), jax.jacfwd(compute_moments_at)(x)

    with jax.enable_x64(True):  # compiled: operation by operation the compiler is called two hundred times
        moments, slopes = map(np.asarray, quickly_compiled(differentiate_moments)(jnp.asarray(solution.x)))
    slopes = slopes[:, :, solution.active]
    # An interval for each moment that is identified: its estimate has the variance g' C g, with its derivatives g by x
    # and the covariance C of x.
    covariance, freedom = solution.covariance()
    names = sensor.outputs if len(sensor.outputs) == len(moments) else [f"z{i}" for i in range(len(moments))]
    lines = []
    for name, values, gradients in zip(names, moments, slopes, strict=True):
        found = []
        for kind, value, gradient in zip(KINDS_OF_MOMENTS, values, gradients, strict=True):
            if solution.identifies(gradient):
                reach = student_quantile(freedom) * float(np.sqrt(max(gradient @ covariance @ gradient, 0.0)))
                found.append(f"{kind} {value:.3g} ({value - reach:.3g} .. {value + reach:.3g})")
        if found:
            lines.append(f"The received {name} has {', '.join(found)}, 95 %, the sensor's noise included.")
    return lines


def _is_route_constant(sensor: AbstractSensor, channel: Channel) -> bool:
    """Return whether a channel is the same at each step, and it and the sensor depend on no inputs and no past."""
    return not (isinstance(channel, OverTime) or sensor.inputs or channel.remembers or channel.past)


def _compute_link_moments(sensor: AbstractSensor, link: AbstractRandomAffine) -> jax.Array:
    """Return mean gain, gain variance and noise variance of each output behind a link, (outputs, 3).

    An output's gain is that of the measured value with the largest mean gain. The noise variance is the diagonal of M R
    M' + E[dG R dG'] + Cov(offset), with M the mean gain, dG the gain's deviation and R the sensor's noise covariance.
    """
    moments, R = second_order(link), jnp.asarray(sensor.noise.covariance)
    M, p = jnp.asarray(moments.mean_gain), moments.mean_gain.shape[1]
    # spread[i, j, a, b]: covariance of entries (i, a) and (j, b) of the matrix (gain, offset), with the offset last.
    spread = jnp.asarray(moments.nominal.center)
    second_of_noise_and_one = jnp.zeros((p + 1, p + 1)).at[:p, :p].set(R).at[p, p].set(1.0)
    # contract(C, S)[i, j] = sum_ab C[i, j, a, b] S[a, b], here E[dG R dG'] + Cov(offset).
    noise = jnp.diagonal(M @ R @ M.T + contract(spread, second_of_noise_and_one))
    strongest = jnp.argmax(jnp.abs(M), axis=1)
    rows = jnp.arange(len(M))
    return jnp.stack([M[rows, strongest], spread[rows, rows, strongest, strongest], noise], axis=1)
