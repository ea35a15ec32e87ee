"""Search for a claim of "upper" that is broken in a network: events, quantizers, bounded noise, side information.

Run: python benchmarks/upper_networks.py [ASCENTS]. As upper_fusion.py, by ascent over plants, starts, noises within
their bounds, thresholds, losses, and over the law of all that is random: its covariance is what the network says, or
less where only a bound is said, and it has few values, so that the true error is a sum over these. A bound that rests
on second moments holds for every such law. Prints the largest ratio of true to claimed squared error over all
directions.
"""

import sys
import warnings
from collections.abc import Callable
from itertools import product
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from upper_claims import ROUNDING, SEED, N, Numbers, Ratio, Reader, ascended, largest, plant_of
from upper_fusion import MESHES

import heliograph as hg

NODES, ROWS, STEPS = ("a", "b"), 4, 25


class Grid(hg.fusion.AbstractQuantizer):
    """Multiples of a step: an error of half of it, whatever the value."""

    width: float

    def init(self, n: int) -> tuple[()]:
        """Return the empty state."""
        return ()

    def step(self, state: Any, value: Any) -> tuple[Any, hg.fusion.Quantized]:
        """Round to the nearest multiple."""
        x = jnp.asarray(value, dtype=float)
        sent = jnp.round(x / self.width) * self.width
        error = jnp.where(jnp.isnan(x), jnp.nan, self.error(len(x)))
        return state, hg.fusion.Quantized(sent, error, jnp.zeros(x.shape, bool), jnp.ones(x.shape, int))

    def claim(self, claim: Any) -> Any:
        """The claim of the estimate, at most "upper"."""
        return hg.model.weakest([claim, "upper"])

    def error(self, n: int) -> np.ndarray:
        """Half of a step."""
        return np.full(n, self.width / 2)


class World(NamedTuple):
    """A network's parts, and what happens: states (case, row, N), measurements (case, row, node), probabilities."""

    plant: Any
    sensors: list[Any]
    links: list[Any]
    states: np.ndarray
    measured: np.ndarray
    chance: np.ndarray


def world_of(read: Reader) -> World:
    """A plant, sensors whose noise is known by bounds behind links with noise, and a law of few values of it all."""
    plant, sensors, links, sizes, matrices, gains = plant_of(read), [], [], [], [], []
    for _ in NODES:
        r, share, grown = read.positive(1e-2, 1.0), read.positive(0.01, 0.5), read.positive(1.0, 100.0)
        matrices.append(read.real(1, N))
        sensors.append(hg.LinearSensor(matrices[-1], hg.Contaminated.at_most(r, share, grown * r)))
        gains.append(0.8 + 0.7 * float(np.tanh(read.real(1)[0])))
        noise = read.positive(1e-3, 0.3)
        links.append(hg.hop(gains[-1], noise))
        sizes.append(gains[-1] ** 2 * r * (1 + np.abs(np.tanh(read.real(ROWS))) * share * (grown - 1)) + noise)
    # x = mean + root xi and so on, of sources xi (1, noises of the plant, noises of the sensors) of unit variance.
    unit = np.eye(N + ROWS * (N + len(NODES)))
    motion, noise_root = np.asarray(plant.matrix), np.linalg.cholesky(plant.noise.covariance)
    x, mean = np.linalg.cholesky(plant.initial_covariance) @ unit[:N], np.asarray(plant.initial_mean)
    sources, states, measured = iter(np.split(unit[N:], ROWS)), [], []
    for k in range(ROWS):
        own = next(sources)
        x, mean = motion @ x + noise_root @ own[:N], motion @ mean
        states.append(np.column_stack([mean, x]))
        measured.append(
            [gains[i] * matrices[i][0] @ states[-1] + np.sqrt(sizes[i][k]) * np.append(0, own[N + i])
             for i in range(len(NODES))]
        )  # fmt: skip
    # Values +-u_i / sqrt(w_i) of the sources, each with probability w_i / 2, u_i orthonormal: E xi = 0, E xi xi' = I.
    weights = read.probabilities(len(unit))
    turned = np.linalg.qr(read.real(*unit.shape) + 1e-3 * unit)[0] / np.sqrt(weights)
    values = np.column_stack([np.ones(2 * len(unit)), np.concatenate([turned.T, -turned.T])])
    state, received = (np.einsum("kij,cj->cki", np.array(rows), values) for rows in (states, measured))
    return World(plant, sensors, links, state, received, np.tile(weights / 2, 2))


def ratio_in(world: World, network: Any, name: str, reports: Any = None) -> Ratio:
    """Ratio of the estimates of this name, at all nodes that have them."""
    claims = {claims[name] for claims in network.claims().values() if name in claims}
    assert claims == {"upper"}, claims
    errors: dict[tuple[str, int], np.ndarray] = {}
    claimed: dict[tuple[str, int], np.ndarray] = {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # values of such laws are no likely data
        for states, measured, chance in zip(world.states, world.measured, world.chance, strict=True):
            record = hg.run(network, {n: measured[:, [i]] for i, n in enumerate(NODES)}, reports=reports)
            for node, filters in record.estimates.items():
                for k in range(ROWS) if name in filters else ():
                    off = states[k] - filters[name].mean[k]
                    errors[node, k] = errors.get((node, k), 0.0) + chance * np.outer(off, off)
                    claimed[node, k] = claimed.get((node, k), 0.0) + chance * np.asarray(filters[name].covariance[k])
    most = max(largest(errors[place], claimed[place]) for place in errors)
    return Ratio(most, most)


def nodes_of(world: World) -> dict[str, Any]:
    """Nodes with a filter each."""
    return {
        name: hg.Node(sensor, link, {"alone": hg.linear_filter(world.plant, sensor, link)})
        for name, sensor, link in zip(NODES, world.sensors, world.links, strict=True)
    }


def at_a_centre(
    rule: Callable[[Reader], Any], quantizer: Callable[[Reader], Any] = lambda read: None
) -> Callable[[Numbers], Ratio]:
    """Make the ratio of a rule at a centre, which receives estimates through a quantizer."""

    def ratio(numbers: Numbers) -> Ratio:
        read = Reader(numbers.free)
        world = world_of(read)
        fusion = hg.Fusion("alone", rule(read), quantizer=quantizer(read))
        return ratio_in(world, hg.Network(world.plant, nodes_of(world), {"one": fusion}), "one")

    return ratio


def between_neighbours(rule: Any, events: bool) -> Callable[[Numbers], Ratio]:
    """Make the ratio of a rule between neighbours, after whatever messages arrived."""

    def ratio(numbers: Numbers) -> Ratio:
        read = Reader(numbers.free)
        world, alpha = world_of(read), read.positive(0.01, 3.0) if events else None
        near, lossy = {"a": ["b"], "b": ["a"]}, hg.erasure(hg.perfect(), 0.5)
        fusion = hg.Fusion("alone", rule, neighbours=near, link=lossy, alpha=alpha)
        arrived = np.where(numbers.corners[: 2 * ROWS].reshape(2, ROWS, 1) % 3 > 0, 1.0, np.nan)
        reports = {"one": dict(zip(NODES, arrived, strict=True))}
        return ratio_in(world, hg.Network(world.plant, nodes_of(world), {"one": fusion}), "one", reports)

    return ratio


def scheduled(numbers: Numbers) -> Ratio:
    """Ratio of the filter behind a sender with a schedule, whose messages are lost now and then."""
    read = Reader(numbers.free)
    world, trigger = world_of(read), hg.Periodic(2, int(numbers.corners[0] % 2))
    links = [hg.erasure(link, 0.5) for link in world.links]
    nodes = {
        name: hg.Node(sensor, link, {"one": hg.event_filter(world.plant, sensor, link, trigger)}, trigger=trigger)
        for name, sensor, link in zip(NODES, world.sensors, links, strict=True)
    }
    sent = (np.arange(ROWS) % 2 == trigger.phase) & (numbers.corners[:ROWS] % 4 > 0)
    seen = world._replace(measured=np.where(sent[:, None], world.measured, np.nan))
    return ratio_in(seen, hg.Network(world.plant, nodes, {}), "one")


def flagged(make: Callable[[Any, Any, Any, np.ndarray], Any], late: bool) -> Callable[[Numbers], Ratio]:
    """Make the ratio of a filter with flags, given them: z = g_j (C x + v) + n in mode j, v known by a bound."""

    def ratio(numbers: Numbers) -> Ratio:
        read = Reader(numbers.free)
        world = world_of(read)
        states, sensor = world.states, world.sensors[0]
        gains, noises = 0.8 + 0.7 * read.real(2), np.array([read.positive(1e-2, 1.0) for _ in range(2)])
        hops = [hg.hop(float(g), float(n)) for g, n in zip(gains, noises, strict=True)]
        rows = np.array([read.probabilities(2) for _ in range(2)])
        chain = hg.random_affine.MarkovChain(rows, initial=read.probabilities(2))
        chances = np.eye(2) if late else np.array([read.probabilities(2) for _ in range(2)])
        filter = make(world.plant, sensor, hg.markov_fading(hops, chain), chances)
        assert filter.claim == "upper", filter.claim
        flags = numbers.corners[:ROWS] % 2
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            runs = [filter.run(np.column_stack([row, flags])) for row in (np.zeros(ROWS), *np.eye(ROWS))]
        matrices = np.stack([run.means - runs[0].means for run in runs[1:]], axis=-1)
        # Of each row the sum over what the modes may have been, by their probabilities given the flags up to it. A late
        # flag is of the step before; that of the first step says nothing.
        errors, total = np.zeros((ROWS, N, N)), np.zeros((ROWS, 1, 1))
        c, r = np.asarray(sensor.matrix)[0], np.tanh(read.real(ROWS)) ** 2 * sensor.noise.covariance[0, 0]
        for modes in product((0, 1), repeat=ROWS):
            j = np.array(modes)
            said = np.append(1.0, chances[j[:-1], flags[1:]]) if late else chances[j, flags]
            chance = np.cumprod(np.append(chain.initial[j[0]], rows[j[:-1], j[1:]]) * said)[:, None, None]
            off = states - runs[0].means - np.einsum("knl,cl->ckn", matrices, gains[j] * (states @ c))
            spread = np.einsum("c,cka,ckb->kab", world.chance, off, off)
            noise = (matrices * (gains[j] ** 2 * r + noises[j])) @ np.swapaxes(matrices, 1, 2)
            errors += chance * (spread + noise)
            total += chance
        return both_largest(errors / total, runs[0].covariances)

    return ratio


def both_largest(errors: np.ndarray, claimed: np.ndarray) -> Ratio:
    """The largest ratio over all rows."""
    most = max(largest(*pair) for pair in zip(errors, claimed, strict=True))
    return Ratio(most, most)


CENTRES: dict[str, Callable[[Reader], Any]] = {
    "CovarianceIntersection": lambda read: hg.CovarianceIntersection(),
    "EqualIntersection": lambda read: hg.fusion.EqualIntersection(),
    "WeightedFusion": lambda read: hg.fusion.WeightedFusion(read.probabilities(len(NODES))),
    "AllReports": lambda read: hg.fusion.AllReports(),
}
INFORMED = {
    "MatrixWeights": hg.fusion.MatrixWeights(),
    "DiagonalWeights": hg.fusion.DiagonalWeights(),
    "ScalarWeights": hg.fusion.ScalarWeights(),
    "AllReports": hg.fusion.AllReports(),
}
QUANTIZERS: dict[str, Callable[[Reader], Any]] = {
    "events": lambda read: hg.fusion.EventSending(np.array([read.positive(1e-2, 3.0) for _ in range(N)])),
    "a quantizer": lambda read: Grid(read.positive(1e-2, 3.0)),
}


def families() -> dict[str, Callable[[Numbers], Ratio]]:
    """Ratio of each place in a network that claims "upper"."""
    cases: dict[str, Callable[[Numbers], Ratio]] = {
        f"{name}, {kind}": at_a_centre(rule, quantizer)
        for kind, quantizer in QUANTIZERS.items()
        for name, rule in CENTRES.items()
    }
    cases |= {f"{name}, bounds": at_a_centre(lambda read, rule=rule: rule) for name, rule in INFORMED.items()}
    cases |= {f"{name} between neighbours, events": between_neighbours(rule, True) for name, rule in MESHES.items()}
    near = {**MESHES, **{name: rule for name, rule in INFORMED.items() if name != "AllReports"},
            "DiffusionWeights": hg.fusion.DiffusionWeights()}  # fmt: skip
    cases |= {f"{name} between neighbours, bounds": between_neighbours(rule, False) for name, rule in near.items()}
    cases["event_filter behind Periodic, bounds"] = scheduled
    cases["side_information_filter, bounds"] = flagged(
        lambda plant, sensor, link, flags: hg.filters.side_information_filter(plant, sensor, link, flags=flags), False
    )
    cases["mode_late_filter, bounds"] = flagged(
        lambda plant, sensor, link, flags: hg.filters.mode_late_filter(plant, sensor, link), True
    )
    return cases


def main(ascents: int) -> int:
    """Ascend, print, and return the number of claims that are broken."""
    broken = 0
    for name, ratio in families().items():
        most = max(ascended(ratio, SEED + i, STEPS).largest for i in range(ascents))
        broken += most > 1 + ROUNDING
        print(f"{name:52} {most:.9f}{'  BROKEN' * (most > 1 + ROUNDING)}", flush=True)
    return broken


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else 4) > 0)
