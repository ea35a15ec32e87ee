"""Whether the mean error of a network's best filter stays bounded for all time: certified, impossible, or undecided."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import scipy.linalg

from heliograph.linear.arrival import plant_matrices, sensor_matrices
from heliograph.linear.known_losses import (
    BELOW_ONE,
    KindGains,
    KnownLossSystem,
    certified_radius,
    find_gains,
    long_run_law,
    spectral_radius,
    steady,
)
from heliograph.linear.unseen import Unseen, fastest_unseen, reached
from heliograph.model.channel import Channel, parallel
from heliograph.model.over_time import OverTime, first
from heliograph.numerics.check import fail, instance
from heliograph.numerics.readable import readable
from heliograph.numerics.types import Float
from heliograph.random_affine.base import AbstractRandomAffine, memories
from heliograph.random_affine.chain import MarkovChain
from heliograph.random_affine.modes import joint_modes
from heliograph.random_affine.side_information import Outcome, outcomes, second_moments
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node

CERTAIN = 1e-13  # of a row's second moment: a variance of its gain that is rounding

Verdict = Literal["certified", "impossible", "undecided"]


@readable
class Boundedness(NamedTuple):
    """What is known of E P as time goes on, P the error covariance of the filter that hears all nodes, before each z.

    "certified": bounded, since `radius` < 1, the spectral radius of E[e e'] -> E[e+ e+'] under fixed `gains`
    {what arrived: K (n, received)} of xhat+ = A xhat + K (z - what is expected), one for each set of losses.
    "impossible": without bound for every filter that is linear in what arrives, since `growth` >= 1: an eigenvector of
    the plant grows by that, in the mean of its square over one step, while the links do not show it. "undecided":
    neither.

    `bound` (n, n): E P is at most this after long; None where it is not certified or no such matrix is at hand.
    """

    verdict: Verdict
    reason: str
    radius: float
    growth: float
    gains: dict[tuple[bool, ...], Float[np.ndarray, "n received"]]
    bound: Float[np.ndarray, "n n"] | None


class Links(NamedTuple):
    """All that the receivers hear together: a chain of modes, what each may tell, and the sensors that speak."""

    initial: Float[np.ndarray, "modes"]
    chain: Float[np.ndarray, "modes modes"]
    outcomes: list[list[Outcome]]
    sensing: Float[np.ndarray, "m n"]
    sensor_mean: Float[np.ndarray, "m"]
    sensor_noise: Float[np.ndarray, "m m"]


def certify_boundedness(network: Network) -> Boundedness:
    """Judge E P of the best filter that hears every node and is told what arrived, linear in what did.

    Certified: rho of U_j -> sum_i chain[i, j] (A - K_i C_i) U_i (A - K_i C_i)' is below 1 for some gains, which are
    searched and then judged as if they were anybody's. Only rows of certain gain are used: a gain that is random and
    not told makes noise that grows with the state, so an unstable mode seen through such gains alone is impossible.
    Impossible: rho(chain within the modes that do not show an eigenvector) |eigenvalue|^2 >= 1. Where losses alone are
    random, and noises Gaussian, that is true of every filter; a filter that is not linear may learn a hidden mode.

    Raises:
        ValueError: a plant, sensor or channel that varies or is not linear, relays that filter, too many sets of
            losses.
    Source: Sinopoli et al. (2004), Theorems 2 to 5; Xie and Xie, Stability of a random Riccati equation with Markovian
        binary switching (2008); Liu and Goldsmith, Kalman filtering with partial observation losses (2004).
    """
    instance("network", network, Network, "a Network")
    a, q = plant_matrices(network.plant)
    links = _links(network, len(a))
    growing = _unstable(a)
    for space in (np.eye(len(a)), growing):
        known = _known_losses(a, q, links, space)
        gains = find_gains(known.system)
        radius = certified_radius(known.system, gains)
        if radius < BELOW_ONE:
            bound = steady(known.system, gains, known.system.source(gains)).sum(axis=0) if known.exact else None
            return Boundedness("certified", _certified(a, radius), radius, 0.0, known.gains(gains), bound)
    unseen = fastest_unseen(a, known.system.chain, [known.system.outputs[s] for s in known.system.known])
    verdict, reason = _refused(network, links, growing, known, unseen, radius)
    return Boundedness(verdict, reason, radius, unseen.growth, known.gains(gains), None)


def _links(network: Network, states: int) -> Links:
    """All nodes as one: their sensors one above the other, their channels in parallel."""
    if network.relays is not None:
        raise fail("boundedness", "nodes that hear the sensors over channels", "relays that filter")
    nodes = [node for node in network.nodes.values() if isinstance(node, Node)]
    matrices, noises = zip(*(sensor_matrices(node.sensor, states) for node in nodes), strict=True)
    means = [np.asarray(first(node.sensor).noise.mean) for node in nodes]
    channels = [_constant(node.channel) for node in nodes]
    joint = parallel(channels) if len(channels) > 1 else channels[0]
    for memory in memories(joint).values():
        if isinstance(memory, MarkovChain) and np.any(memory.radius > 0):
            raise fail("boundedness", "chains of known transition", "one whose probabilities are uncertain")
    modes = joint_modes(joint, 2)  # of a gain that drifts two values say that it is random
    initial, chain = np.asarray(modes.initial), np.asarray(modes.transition)
    happens = initial @ np.linalg.matrix_power(np.eye(len(chain)) + chain, len(chain)) > 0
    outputs = [outcomes(m) for m, ever in zip(modes.maps, happens, strict=True) if ever]
    noise = scipy.linalg.block_diag(*noises)
    links = initial[happens], chain[np.ix_(happens, happens)], outputs
    return Links(*links, np.concatenate(matrices), np.concatenate(means), noise)


def _constant(channel: Channel) -> AbstractRandomAffine:
    if isinstance(channel, OverTime):
        raise fail("boundedness", "channels that do not vary", "one that varies")
    return channel


def _unstable(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n d"]:
    """An orthonormal basis of the plant's modes that do not decay."""
    _, basis, count = scipy.linalg.schur(matrix / BELOW_ONE, sort="ouc")
    return np.asarray(basis[:, :count])


class KnownLosses(NamedTuple):
    """What a receiver can rely on, for each of the `kinds` of losses."""

    system: KnownLossSystem
    kinds: list[tuple[bool, ...]]
    parts: list["Certain"]

    @property
    def exact(self) -> bool:
        """Whether that is all it hears."""
        return all(part.exact for part in self.parts)

    @property
    def random(self) -> bool:
        """Whether random gains leave something out."""
        return any(part.random for part in self.parts)

    def gains(self, gains: KindGains) -> dict[tuple[bool, ...], np.ndarray]:
        """Gains on what arrives, from those on its certain sums."""
        return {kind: k @ part.combine for kind, k, part in zip(self.kinds, gains, self.parts, strict=True)}


def _known_losses(a: np.ndarray, q: np.ndarray, links: Links, space: Float[np.ndarray, "n d"]) -> KnownLosses:
    """Each set of losses as a kind, with the sums of what arrives whose gain on a subspace of x is certain.

    Modes that tell the same are one kind: a gain that differs between them is not told.
    """
    kinds = list(dict.fromkeys(tuple(o.arrived.tolist()) for outcome in links.outcomes for o in outcome))
    weights = [
        (i, o, kinds.index(tuple(o.arrived.tolist()))) for i, outcome in enumerate(links.outcomes) for o in outcome
    ]
    parts = [_certain([o for _, o, s in weights if s == kind], links, space) for kind in range(len(kinds))]
    values = np.array([s for _, _, s in weights])
    mode = np.array([i for i, _, _ in weights])
    probability = np.array([o.probability for _, o, _ in weights])
    chain = links.chain[np.ix_(mode, mode)] * probability
    law = long_run_law(links.initial[mode] * probability, chain)
    noises = tuple(parts[s].noise(o, links) for _, o, s in weights)
    system = KnownLossSystem(a, q, chain, law, values, tuple(part.rows for part in parts), noises)
    return KnownLosses(system, kinds, parts)


class Certain(NamedTuple):
    """Sums of the rows that arrive: `combine` (r, m) of them, which read `rows` x + noise."""

    combine: Float[np.ndarray, "r m"]
    rows: Float[np.ndarray, "r n"]
    mean: Float[np.ndarray, "m p+1"]
    exact: bool
    random: bool

    def noise(self, outcome: Outcome, links: Links) -> Float[np.ndarray, "r r"]:
        """Covariance of what they read at x = 0, about the kind's mean."""
        mean, second = second_moments(outcome.map)
        v = np.append(links.sensor_mean, 1.0)
        signal = np.outer(v, v)
        signal[:-1, :-1] += links.sensor_noise
        about = self.mean @ v
        center = mean @ v
        total = np.einsum("ijab,ab->ij", second, signal) - np.outer(center, about) - np.outer(about, center)
        return np.asarray(self.combine @ (total + np.outer(about, about)) @ self.combine.T)


def _certain(alike: Sequence[Outcome], links: Links, space: Float[np.ndarray, "n d"]) -> Certain:
    """The null space of E[(G - M) C Y Y' C' (G - M)'] over what is told alike, Y the subspace."""
    moments = [second_moments(o.map) for o in alike]
    mean = np.mean([m for m, _ in moments], axis=0)
    arrived = np.flatnonzero(alike[0].arrived)
    rows = mean[:, :-1] @ links.sensing
    seen = links.sensing @ space @ (links.sensing @ space).T
    second = np.mean([np.einsum("ijab,ab->ij", t[..., :-1, :-1], seen) for _, t in moments], axis=0)
    about = mean[:, :-1] @ seen @ mean[:, :-1].T
    scale = np.sqrt(np.diag(second)[arrived])
    scale = np.where(scale > 0, scale, 1.0)
    spread = (second - about)[np.ix_(arrived, arrived)] / scale / scale[:, None]
    values, vectors = np.linalg.eigh(spread)
    combine = np.zeros((int(np.sum(values <= CERTAIN)), len(mean)))
    combine[:, arrived] = vectors[:, values <= CERTAIN].T / scale
    same = all(np.array_equal(m[:, -1], mean[:, -1]) for m, _ in moments)
    random = len(combine) < len(arrived)
    whole = space.shape[1] == len(space)
    return Certain(combine, combine @ rows, mean, whole and same, random)


def _certified(a: Float[np.ndarray, "n n"], radius: float) -> str:
    if spectral_radius(a) < BELOW_ONE:
        return f"the plant is stable, and fixed gains leave the error a spectral radius of {radius:.6g}"
    return f"fixed gains leave the mean square of the error a spectral radius of {radius:.6g}"


def _refused(
    network: Network, links: Links, growing: np.ndarray, channel: KnownLosses, unseen: Unseen, radius: float
) -> tuple[Verdict, str]:
    """Impossible if an unseen eigenvector grows and noise keeps reaching it, else undecided."""
    if unseen.growth < 1:
        best = f"no gains are certified: the best that were found leave {radius:.6g}"
        return "undecided", f"{best}, and nothing that losses hide grows: {unseen.growth:.6g} < 1"
    reason = _why(links, channel.system, unseen)
    if not _excited(network, growing, channel, unseen):
        return "undecided", f"{reason}; but noise does not reach all that grows, so that it may stay zero"
    return "impossible", reason


def _why(links: Links, system: KnownLossSystem, unseen: Unseen) -> str:
    value = unseen.eigenvalue
    mode = f"the plant's mode of eigenvalue {value.real:.6g}" + (f" +- {value.imag:.6g}i" if value.imag else "")
    if len(unseen.modes) < len(system.chain):
        return f"{mode} grows by {unseen.growth:.6g} >= 1 a step in mean square while what would show it is lost"
    powers = [np.einsum("iiab->ab", second_moments(o.map)[1])[:-1, :-1] for outcome in links.outcomes for o in outcome]
    seen = links.sensing @ unseen.vectors
    if max(float(np.real(np.einsum("ad,ab,bd->", seen.conj(), power, seen))) for power in powers) > 0:
        return f"{mode} is seen only through random gains that are not told, which make noise as large as the state"
    return f"{mode} is not seen at all"


def _excited(network: Network, growing: np.ndarray, channel: KnownLosses, unseen: Unseen) -> bool:
    """Whether P stays above eps v v': noise enters along v at once, or reaches it and every measurement has noise.

    The noise that random gains make grows only where noise reaches all that is unstable.
    """
    a, q = channel.system.transition, channel.system.process
    expected = np.concatenate([unseen.vectors, growing], axis=1) if channel.random else unseen.vectors
    if reached(expected, np.zeros_like(a), q):
        return True
    if any(np.linalg.eigvalsh(r).min(initial=np.inf) <= 0 for r in channel.system.noises):
        return False
    start = q + np.asarray(first(network.plant).initial_covariance)
    return reached(expected, a, q) or (unseen.growth > 1 and reached(expected, a, start))
