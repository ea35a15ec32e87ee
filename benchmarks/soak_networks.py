"""Random networks for the soak: three dozen structures, each filled with numbers of its own for every network.

The structure decides what is compiled, the numbers decide what can go wrong: scales over twelve decades, parts without
noise or variance, links that never or always deliver, states far from zero, components that say the same. What a number
would decide of the structure (a link that never delivers has no random gain) is therefore the structure's.
"""

from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np

import heliograph as hg

STRUCTURES = 36
HORIZON = 5
SINGULAR = 0.15  # share of the variances that are zero
KINDS = "linear", "skewed", "nonlinear"
WIRINGS = "hops", "relays", "dropouts", "direct link"
LOSSES = "none", "whole", "each"
NEVER_OR_ALWAYS = {("dropouts", 2, 0): 1.0, ("dropouts", 2, 1): 0.0, ("dropouts", 0, 2): 1.0}  # wiring, round, kind
LOST_OR_NOT = {(3, 1): 1.0, (2, 2): 0.0, (0, 2): 0.0, (3, 2): 1.0}  # of the first link that loses; wiring, round


class Structure(NamedTuple):
    """What the networks of one number modulo STRUCTURES have in common."""

    kind: str
    states: int
    laws: tuple[int, ...]  # of each output's gain
    wiring: str
    loses: str  # what the receiver knows to be lost: nothing, all outputs at once, each for itself
    dropped: float | None  # how often a dropout delivers, None: anything between
    arrives: float | None  # the same of the first loss that is observed
    nodes: int
    own_prior: bool
    remembers: bool
    modal: bool

    @property
    def informed(self) -> bool:
        """Whether fusion can know the joint covariance."""
        return self.kind == "linear" and not self.remembers and not self.own_prior and 2 not in self.laws


def structure(number: int) -> Structure:
    """The kinds of plant and the wirings in all combinations, three rounds of them with what else there is."""
    kind, wiring, round_ = number % 3, number // 3 % 4, number // 12
    random = np.random.default_rng(number)
    outputs, linear = int(random.integers(1, 3)), kind == 0
    return Structure(
        KINDS[kind],
        int(random.integers(1, 4)),
        tuple((wiring + 2 * round_ + kind + j) % 4 for j in range(outputs)),
        WIRINGS[wiring],
        LOSSES[(wiring + round_) % 3],
        NEVER_OR_ALWAYS.get((WIRINGS[wiring], round_, kind)),
        LOST_OR_NOT.get((wiring, round_)),
        1 if round_ == 0 else 2,
        linear and round_ == 2 and wiring % 2 == 1,
        linear and (round_ + wiring) % 3 == 1,
        linear and wiring != 1,
    )


def network(index: int, seed: int) -> hg.Network:
    """The network of this number: its structure is index mod STRUCTURES."""
    s, values = structure(index % STRUCTURES), np.random.default_rng([seed, 1, index])
    linear, outputs = s.kind != "nonlinear", len(s.laws)
    plants = {"linear": linear_plant, "skewed": skewed_plant, "nonlinear": nonlinear_plant}
    plant = plants[s.kind](s.states, values)
    units = 10.0 ** values.uniform(-6, 6, size=outputs) if linear else np.ones(outputs)
    result = {}
    for number in range(s.nodes):
        sensor = (linear_sensor if linear else nonlinear_sensor)(plant, units, values)
        item = wired(s, units, values)
        arrivals = [chance(values) for _ in item]
        arrivals[0] = arrivals[0] if s.arrives is None else s.arrives
        channel, world = joined(s, item), lossy(s, item, arrivals)
        if s.remembers:
            other, rates = wired(s, units, values), (*values.uniform(0.05, 0.9, size=2), f"sight{number}")
            channel = hg.gilbert_elliott(channel, joined(s, other), *rates)
            world = hg.gilbert_elliott(world, lossy(s, other, arrivals), *rates)
        filters = (linear_filters if linear else nonlinear_filters)(plant, sensor, channel, s)
        if s.kind == "linear":
            filters |= informed_filters(plant, sensor, world, s.modal)
        result[f"node{number}"] = hg.Node(sensor, world, filters)
    return hg.Network(plant, result, fused(result, "linear" if linear else "cubature", s.informed))


def chance(values: np.random.Generator) -> float:
    """A probability that is neither 0 nor 1."""
    return float(values.uniform(0.1, 0.9))


def variance(values: np.random.Generator, scale: Any = 1.0) -> Any:
    """Variances beside a scale, some of them zero."""
    shape = np.shape(scale)
    result = 10.0 ** values.uniform(-3, 0.5, size=shape) * np.square(scale)
    return np.where(values.random(shape) < SINGULAR, 0.0, result)


def covariance(values: np.random.Generator, scale: np.ndarray) -> np.ndarray:
    """A covariance in these units, sometimes singular."""
    n = len(scale)
    root = values.normal(size=(n, n)) * np.sqrt(variance(values, np.ones(n)))
    return np.asarray(np.outer(scale, scale) * (root @ root.T))


def linear_plant(n: int, values: np.random.Generator) -> hg.LinearPlant:
    """Gaussian noises, states in units of their own, sometimes far from zero, sometimes growing."""
    units = 10.0 ** values.uniform(-6, 6, size=n)
    a = values.normal(size=(n, n))
    a *= values.uniform(0.2, 1.3) / max(np.abs(np.linalg.eigvals(a)).max(), 1e-9)
    mean = units * values.normal(size=n) * values.choice([0.0, 1.0, 1e3])
    noise, start = covariance(values, units), covariance(values, units)
    return hg.LinearPlant(units[:, None] * a / units, noise, mean, start)


def skewed_plant(n: int, values: np.random.Generator) -> hg.LinearPlant:
    """Noise of finitely many values in one direction, small enough for filters that use it."""
    base = linear_plant(n, values)
    atoms = hg.random_affine.FiniteSupport([[2.0], [-0.5]], [0.2, 0.8])
    direction = np.sqrt(np.diag(np.asarray(base.initial_covariance)))[:, None] * values.normal(size=(n, 1))
    law = hg.random_affine.Shaped(direction, atoms)
    return hg.LinearPlant(base.matrix, law, base.initial_mean, base.initial_covariance)


def turning(x: Any, u: Any) -> Any:
    """A bounded nonlinear step."""
    return 0.8 * x + 0.3 * jnp.sin(jnp.roll(x, 1))


def bent(x: Any) -> Any:
    """The output of a nonlinear sensor."""
    return (x[0] + 0.2 * x[0] ** 2)[None]


def bent_pair(x: Any) -> Any:
    """Two outputs of a nonlinear sensor."""
    return jnp.stack([x[0] + 0.2 * x[-1] ** 2, jnp.sin(x[-1])])


def nonlinear_plant(n: int, values: np.random.Generator) -> hg.Plant:
    """A smooth plant with sometimes singular noise."""
    return hg.Plant(turning, covariance(values, np.ones(n)), values.normal(size=n), covariance(values, np.ones(n)))


def linear_sensor(plant: hg.LinearPlant, units: np.ndarray, values: np.random.Generator) -> hg.LinearSensor:
    """Rows of which some repeat and some are zero, in units of each output's own."""
    deviation = np.sqrt(np.diag(np.asarray(plant.initial_covariance)))
    local = np.where(deviation > 0, deviation, np.max(deviation, initial=0.0) + 1e-9)
    rows = values.normal(size=(len(units), len(local))) / local
    rows[values.random(len(units)) < 0.1] = 0.0
    if len(units) > 1 and values.random() < 0.2:
        rows[1] = rows[0]
    return hg.LinearSensor(units[:, None] * rows, np.diag(variance(values, units)))


def nonlinear_sensor(plant: hg.Plant, units: np.ndarray, values: np.random.Generator) -> hg.Sensor:
    """One or two bent outputs."""
    return hg.Sensor([bent, bent_pair][len(units) - 1], np.diag(variance(values, units)))


def hop(law: int, unit: float, values: np.random.Generator) -> Any:
    """A hop with a gain of one of four laws."""
    noise = float(variance(values, np.array(unit)))
    gains = np.sort(values.uniform(-0.5, 1.5, size=2))
    match law:
        case 0:
            return hg.hop(float(values.choice([1.0, values.normal()])), noise)
        case 1:
            return hg.hop(hg.Discrete(gains, [0.4, 0.6]), noise)
        case 2:
            return hg.hop(hg.Discrete(gains, [0.4, 0.6], 0.1), noise)
        case _:
            return hg.hop(hg.Rayleigh(float(values.uniform(0.3, 1.5))), noise)


def wired(s: Structure, units: np.ndarray, values: np.random.Generator) -> list[Any]:
    """Channels of one output each: a hop; two with a relay between; with losses that the receiver does not know of."""
    items = [hop(law, unit, values) for law, unit in zip(s.laws, units, strict=True)]
    if s.wiring == "relays":
        more = [hg.hop(hg.Discrete([0.5, 1.0], [0.5, 0.5]), float(variance(values, np.array(u)))) for u in units]
        items = [hg.amplify_and_forward([a, b]) for a, b in zip(items, more, strict=True)]
    if s.wiring == "dropouts":
        items = [hg.dropout(item, chance(values) if s.dropped is None else s.dropped) for item in items]
    if s.wiring == "direct link":
        items += [hg.hop(1.0, float(variance(values, np.array(u)))) for u in units]
    return items


def joined(s: Structure, items: list[Any]) -> Any:
    """One channel of all outputs; where there are direct links, they are the second half."""
    whole = hg.parallel(items[: len(s.laws)])
    return whole if s.wiring != "direct link" else hg.model.with_direct_link(whole, hg.parallel(items[len(s.laws) :]))


def lossy(s: Structure, items: list[Any], arrivals: list[float]) -> Any:
    """The channel with the losses that the receiver knows of."""
    if s.loses == "each":
        return joined(s, [hg.erasure(item, chance) for item, chance in zip(items, arrivals, strict=True)])
    return hg.erasure(joined(s, items), arrivals[0]) if s.loses == "whole" else joined(s, items)


def linear_filters(plant: Any, sensor: Any, channel: Any, s: Structure) -> dict[str, Any]:
    """Every filter of a linear model; polynomial ones where the lift is small."""
    zero_mean = hg.filters.ZeroMean()
    prior = {"initial_covariance": np.asarray(plant.initial_covariance) * 2} if s.own_prior else {}
    filters = {
        "linear": hg.linear_filter(plant, sensor, channel),
        "cubature": hg.cubature_filter(plant, sensor, channel, **prior),
        "extended": hg.extended_filter(plant, sensor, channel),
        "zero_mean": hg.cubature_filter(plant, sensor, channel, zero_mean),
        "mean_gain": hg.mean_gain_filter(plant, sensor, channel),
        "open_loop": hg.filters.open_loop_filter(plant),
        "first_degree": hg.polynomial_filter(plant, sensor, channel, HORIZON, 1),
    }
    if s.states * channel.outputs <= 2:
        filters["quadratic"] = hg.polynomial_filter(plant, sensor, channel, HORIZON, 2)
    return filters


def informed_filters(plant: Any, sensor: Any, world: Any, modal: bool) -> dict[str, Any]:
    """The filters that know what arrived; those with a Gaussian for each mode where asked for."""
    filters: dict[str, Any] = {"informed": hg.filters.side_information_filter(plant, sensor, world)}
    if modal:
        filters["imm"] = hg.filters.imm_filter(plant, sensor, world)
        filters["gpb1"] = hg.filters.gpb1_filter(plant, sensor, world)
        filters["gpb2"] = hg.filters.gpb2_filter(plant, sensor, world)
    return filters


def nonlinear_filters(plant: Any, sensor: Any, channel: Any, s: Structure) -> dict[str, Any]:
    """Every filter of a nonlinear model."""
    moments = hg.filters.PolynomialMoments(2)
    return {
        "cubature": hg.cubature_filter(plant, sensor, channel),
        "extended": hg.extended_filter(plant, sensor, channel),
        "moments": hg.filters.gaussian_filter(plant, sensor, channel, moments),
        "zero_mean": hg.cubature_filter(plant, sensor, channel, hg.filters.ZeroMean()),
        "mean_gain": hg.mean_gain_filter(plant, sensor, channel),
        "open_loop": hg.filters.open_loop_filter(plant),
    }


def fused(nodes: dict[str, hg.Node], name: str, informed: bool) -> dict[str, Any]:
    """Every rule, and the central filter; what knows the joint covariance where that is known."""
    count = len(nodes)
    if count < 2:
        return {}
    rules = {
        "equal": hg.fusion.EqualIntersection(),
        "smallest": hg.CovarianceIntersection(),
        "inverse": hg.fusion.InverseCovarianceIntersection(),
        "fixed": hg.fusion.FixedIntersection(np.arange(1, count + 1) / (count * (count + 1) / 2)),
        "mean": hg.fusion.WeightedFusion(np.full(count, 1 / count)),
    }
    if informed:
        rules |= {
            "matrix": hg.fusion.MatrixWeights(),
            "diagonal": hg.fusion.DiagonalWeights(),
            "scalar": hg.fusion.ScalarWeights(),
            "matrix_with_mean": hg.fusion.MatrixWeights(with_mean=True),
            "all_reports": hg.fusion.AllReports(),
        }
    central = hg.filters.sequential_filter([node.filters["extended"] for node in nodes.values()])
    return {rule: hg.Fusion(name, item) for rule, item in rules.items()} | {"central": central}
