"""Search for a claim of "upper" that is broken: ascent over the law's corners at each step, starts, inputs and plants.

Run: python benchmarks/upper_claims.py [ASCENTS]. For each filter and rule that claims "upper" it draws a plant, a
sensor and a link with uncertain probabilities (or noise of which bounds are known), and a law at the corners of what is
possible, another one at each step; then it changes numbers and corners as long as the ratio of true to claimed squared
error of what is measured rises. The true error is exact (`hg.filters.true_error`). Prints the largest ratio found of
each, over all directions and steps, which must not exceed 1 but by rounding; ends with an error if one does.
"""

import sys
from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np

import heliograph as hg

HORIZON, STEPS, SEED = 30, 60, 0
ROUNDING = 1e-6  # relative: true and claimed errors come out of different sums
N, LEVELS = 2, 3
USED = 0.9  # of the variance before any data: a step that leaves more says little of the rule


class Numbers(NamedTuple):
    """Free numbers of a world, all real, and the corner of the law at each step."""

    free: np.ndarray
    corners: np.ndarray


class Reader:
    """Numbers of a world in the order in which it asks for them."""

    def __init__(self, free: np.ndarray):
        self.free, self.place = free, 0

    def real(self, *shape: int) -> np.ndarray:
        """As many real numbers."""
        size = int(np.prod(shape))
        values = self.free[np.arange(self.place, self.place + size) % len(self.free)]
        self.place += size
        return values.reshape(shape)

    def positive(self, low: float, high: float) -> float:
        """A number between these, evenly on a logarithmic scale."""
        share = 1 / (1 + np.exp(-2 * self.real(1)[0]))
        return float(low * (high / low) ** share)

    def covariance(self, low: float, high: float) -> np.ndarray:
        """A covariance (N, N)."""
        root = np.eye(N) + 0.5 * np.tril(self.real(N, N), -1)
        scale = np.diag([self.positive(low, high) for _ in range(N)])
        covariance: np.ndarray = root @ scale @ root.T
        return covariance

    def probabilities(self, count: int) -> np.ndarray:
        """Probabilities that sum to 1."""
        weights = np.exp(self.real(count))
        shares: np.ndarray = weights / weights.sum()
        return shares


class Case(NamedTuple):
    """A filter that claims "upper", its world, and the horizon that counts."""

    filter: Any
    plant: Any
    sensor: Any
    channel: Any


def plant_of(read: Reader, noise: Any = None) -> Any:
    """A plant of N states that neither explodes nor stops."""
    matrix = np.diag([1 - read.positive(1e-4, 0.5) for _ in range(N)]) + 0.3 * np.triu(np.tanh(read.real(N, N)), 1)
    return hg.LinearPlant(
        matrix, read.covariance(1e-4, 0.1) if noise is None else noise, 5 * read.real(N), read.covariance(1e-2, 10.0)
    )


def law_of(read: Reader) -> Any:
    """Gains of LEVELS values, whose probabilities are known within a radius."""
    values = 0.8 + 0.7 * read.real(LEVELS)
    return hg.Discrete(values, read.probabilities(LEVELS), read.positive(0.02, 0.4))


def chosen(channel: Any, corners: np.ndarray) -> Any:
    """The channel with the law at one of its corners at each step."""
    extremes = channel.extremes()
    return hg.model.over_time([extremes[int(c) % len(extremes)] for c in corners])


def scalars(read: Reader) -> Any:
    """Fixed scalars of Young's inequality."""
    return hg.filters.Scalars(read.positive(0.005, 0.5), read.positive(0.005, 0.5))


RULES: dict[str, Callable[[Reader], Any]] = {
    "polytope": lambda read: hg.filters.Polytope(),
    "polytope, fixed scalars": lambda read: hg.filters.Polytope(scalars(read)),
    "interval": lambda read: hg.filters.Interval(),
    "interval, fixed scalars": lambda read: hg.filters.Interval(scalars(read)),
}
LINKS: dict[str, Callable[[Reader], Any]] = {
    "a hop": lambda read: hg.hop(law_of(read), read.positive(1e-3, 1.0)),
    "two hops": lambda read: hg.amplify_and_forward([hg.hop(law_of(read), read.positive(1e-3, 1.0)) for _ in "ab"]),
    "a dropout": lambda read: hg.dropout(hg.hop(1.0, 0.1), read.positive(0.3, 0.9), read.positive(0.02, 0.3)),
    "links apart": lambda read: hg.parallel([hg.hop(law_of(read), read.positive(1e-3, 1.0)) for _ in "ab"]),
    "a relay and a direct link": lambda read: hg.model.with_direct_link(
        hg.hop(law_of(read), read.positive(1e-3, 1.0)), hg.hop(law_of(read), read.positive(1e-3, 1.0))
    ),
}  # fmt: skip
OUTPUTS = {"links apart": 2}


def behind_a_link(link: str, rule: str) -> Callable[[Numbers], Case]:
    """Make the best linear filter behind a link with uncertain probabilities, by a rule."""

    def make(numbers: Numbers) -> Case:
        read = Reader(numbers.free)
        plant, outputs = plant_of(read), OUTPUTS.get(link, 1)
        sensor = hg.LinearSensor(read.real(outputs, N), np.diag([read.positive(1e-3, 1.0) for _ in range(outputs)]))
        channel = LINKS[link](read)
        filter = hg.linear_filter(plant, sensor, channel, update=RULES[rule](read))
        return Case(filter, plant, sensor, chosen(channel, numbers.corners))

    return make


def late(numbers: Numbers) -> Case:
    """Make the filter behind an uncertain link that is late by chance, without stamps."""
    read = Reader(numbers.free)
    plant, sensor = plant_of(read), hg.LinearSensor(read.real(1, N), read.positive(1e-3, 1.0))
    channel = LINKS["a hop"](read)
    delay = hg.Discrete([0, 1], read.probabilities(2))
    filter = hg.linear_filter(plant, sensor, hg.model.delayed(channel, delay))
    world = channel.extremes()[int(numbers.corners[0]) % len(channel.extremes())]
    return Case(filter, plant, sensor, hg.model.delayed(world, delay))


def chain(numbers: Numbers) -> Case:
    """Make the filter behind a chain whose transitions are known within a radius, differently at each step."""
    read = Reader(numbers.free)
    plant, sensor = plant_of(read), hg.LinearSensor(read.real(1, N), read.positive(1e-3, 1.0))
    rows, radius = np.array([read.probabilities(2) for _ in range(2)]), read.positive(0.01, 0.3)
    hops = [hg.hop(float(g), read.positive(1e-2, 1.0)) for g in 0.8 + 0.7 * read.real(2)]
    link = hg.markov_fading(hops, hg.random_affine.MarkovChain(rows, radius=radius))
    initial = link.memory.initial
    turns = [np.array([[-1, 1], [-1, 1]]), np.array([[-1, 1], [1, -1]]), np.array([[1, -1], [-1, 1]]),
             np.array([[1, -1], [1, -1]])]  # fmt: skip
    room = np.minimum(np.minimum(rows, 1 - rows), radius)
    steps = [rows + np.min(room, axis=1, keepdims=True) * turns[int(c) % 4] for c in numbers.corners]
    world = hg.model.over_time(
        [hg.markov_fading(hops, hg.random_affine.MarkovChain(step, initial=initial)) for step in steps]
    )
    return Case(hg.linear_filter(plant, sensor, link), plant, sensor, world)


FADING = hg.hop(hg.random_affine.Rician(0.8, 0.3), 0.1)
FILTERS: dict[str, Callable[[Any, Any], tuple[Any, Any]]] = {
    "kalman_filter": lambda plant, sensor: (hg.kalman_filter(plant, sensor), hg.perfect()),
    "linear_filter": lambda plant, sensor: (hg.linear_filter(plant, sensor, FADING), FADING),
    "polynomial_filter of degree 1": lambda plant, sensor: (
        hg.polynomial_filter(plant, sensor, FADING, HORIZON, degree=1).inner, FADING,
    ),
}  # fmt: skip


def bounded(name: str) -> Callable[[Numbers], Case]:
    """Make a filter of noise of which bounds are known: fewer outliers, smaller ones, none."""

    def make(numbers: Numbers) -> Case:
        read = Reader(numbers.free)
        r, share, grown = read.positive(1e-3, 1.0), read.positive(0.01, 0.5), read.positive(1.0, 100.0)
        law = hg.Contaminated.at_most(r, share, grown * r)
        plant, matrix = plant_of(read), read.real(1, N)
        filter, channel = FILTERS[name](plant, hg.LinearSensor(matrix, law))
        worlds = [(share, grown), (0.0, 1.0), (share, 1.0), (share / 2, grown)]
        sensors = [hg.LinearSensor(matrix, r * ((1 - e) + e * g)) for e, g in worlds]
        steps = [sensors[int(c) % len(sensors)] for c in numbers.corners]
        return Case(filter, plant, hg.model.over_time(steps), channel)

    return make


class Ratio(NamedTuple):
    """Largest true over claimed squared error, over all directions, and in the direction of what is measured.

    Where nothing is known of a direction both errors are those of the plant, so that the first is seldom below 1; the
    second, of the steps at which something is learned, is what an ascent follows.
    """

    largest: float
    measured: float


def ratio_of(case: Case) -> Ratio:
    """Ratios of a case, each the largest over all steps."""
    assert case.filter.claim == "upper", case.filter.claim
    found = hg.filters.true_error(case.filter, case.plant, case.sensor, case.channel, HORIZON)
    pairs, rows = list(zip(found.true, found.claimed, strict=True)), matrix_of(case.sensor)
    start = np.asarray(case.filter.planned(np.zeros((HORIZON, 0))).covariances)[1]
    measured = [
        float(c @ true @ c / (c @ claimed @ c))
        for true, claimed in pairs
        for c in rows
        if c @ claimed @ c < USED * (c @ start @ c)
    ]
    return Ratio(max(largest(*pair) for pair in pairs), max(measured, default=0.0))


def matrix_of(sensor: Any) -> np.ndarray:
    """Matrix of a sensor, which does not vary."""
    matrix = np.asarray(sensor.values.matrix if isinstance(sensor, hg.model.OverTime) else sensor.matrix)
    return matrix[0] if matrix.ndim == 3 else matrix


def largest(true: np.ndarray, claimed: np.ndarray) -> float:
    """Largest v' E v / v' B v."""
    root = np.linalg.cholesky(claimed + 1e-13 * np.trace(claimed) * np.eye(len(claimed)))
    half = np.linalg.solve(root, true)
    return float(np.linalg.eigvalsh(np.linalg.solve(root, half.T))[-1])


def neighbours(numbers: Numbers, generator: np.random.Generator, size: float) -> Numbers:
    """Numbers nearby: some of them moved, and now and then the corner of a stretch of steps."""
    moved = numbers.free + size * generator.normal(size=len(numbers.free)) * (generator.random(len(numbers.free)) < 0.4)
    corners = numbers.corners.copy()
    if generator.random() < 0.5:
        first, last = np.sort(generator.integers(len(corners) + 1, size=2))
        corners[first:last] = generator.integers(1000)
    return Numbers(moved, corners)


def ascended(ratio: Callable[[Numbers], Ratio], seed: int, steps: int = STEPS) -> Ratio:
    """Largest ratio that an ascent from a random start finds."""
    generator = np.random.default_rng(seed)
    corner = generator.integers(1000)
    best = Numbers(generator.normal(size=60), np.full(HORIZON, corner))
    found, size = ratio(best), 0.5
    for _ in range(steps):
        other = neighbours(best, generator, size)
        value = ratio(other)
        if value.measured > found.measured:
            best, size = other, min(2 * size, 1.0)
        else:
            size = max(0.9 * size, 0.02)
        found = Ratio(max(found.largest, value.largest), max(found.measured, value.measured))
    return found


def families() -> dict[str, Callable[[Numbers], Ratio]]:
    """Ratio of each kind of filter and rule that claims "upper"."""
    cases = {
        f"linear_filter, {link}, {rule}": behind_a_link(link, rule)
        for link in LINKS
        for rule in RULES
        if rule.startswith("polytope") or link in ("a hop", "two hops")
    }
    cases |= {"linear_filter, a late hop": late, "linear_filter, a chain": chain}
    cases |= {f"{name}, noise known by bounds": bounded(name) for name in FILTERS}
    return {name: lambda numbers, make=make: ratio_of(make(numbers)) for name, make in cases.items()}  # type: ignore[misc]


def main(ascents: int) -> int:
    """Ascend, print, and return the number of claims that are broken."""
    broken = 0
    for name, ratio in families().items():
        found = [ascended(ratio, SEED + i) for i in range(ascents)]
        largest, measured = (max(values) for values in zip(*found, strict=True))
        wrong = largest > 1 + ROUNDING
        broken += wrong
        print(f"{name:58} {largest:.9f}, measured {measured:.6f}{'  BROKEN' * wrong}", flush=True)
    return broken


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 20) > 0)
