"""Boundedness for all time of the mean error covariance of a network's best filter, certified or refuted."""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import scipy

from heliograph.linear.known_losses import (
    BELOW_ONE,
    KindGains,
    KnownLossSystem,
    UnobservedGrowth,
    certify_radius,
    find_fastest_unobserved_mode,
    find_gains,
    is_excited_by_noise,
)
from heliograph.linear.steady_state import plant_matrices, sensor_matrices
from heliograph.model.channel import Channel, parallel
from heliograph.model.over_time import OverTime, first
from heliograph.numerics.check import fail, instance
from heliograph.numerics.lapack import spectral_radius
from heliograph.numerics.module import readable
from heliograph.numerics.types import Float
from heliograph.random_affine.base import AbstractRandomAffine, Outcome
from heliograph.random_affine.erasure import second_moments
from heliograph.random_affine.memory import memories
from heliograph.random_affine.modes import joint_modes, long_run_law
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node

CERTAIN = 1e-13  # of a row's second moment: a variance of its gain that is rounding

Verdict = Literal["certified", "impossible", "undecided"]


@readable
class Boundedness(NamedTuple):
    """Verdict on E P as time goes on, P the prior error covariance of the filter that receives all nodes.

    Args:
        verdict: "certified": bounded, since `radius` < 1. "impossible": unbounded for every filter that is linear in
            what arrives, since `growth` >= 1. "undecided": neither.
        reason: the verdict in words.
        radius: spectral radius of E[e e'] -> E[e+ e+'] under the fixed `gains`.
        growth: mean square growth over one step of an eigenvector of the plant while the links do not observe it.
        gains: {what arrived: K (n, received)} of xhat+ = A xhat + K (z - E z), one for each set of losses.
        bound: (n, n), E P is at most this in the long run; None where it is not certified or no such matrix is known.
    """

    verdict: Verdict
    reason: str
    radius: float
    growth: float
    gains: dict[tuple[bool, ...], Float[np.ndarray, "n received"]]
    bound: Float[np.ndarray, "n n"] | None


class JointLinks(NamedTuple):
    """Joint model of all links: a chain of modes, the outcomes of each, and the stacked sensors."""

    initial: Float[np.ndarray, "modes"]
    chain: Float[np.ndarray, "modes modes"]
    outcomes: list[list[Outcome]]
    sensing: Float[np.ndarray, "m n"]
    sensor_mean: Float[np.ndarray, "m"]
    sensor_noise: Float[np.ndarray, "m m"]


def certify_boundedness(network: Network) -> Boundedness:
    """Judge E P of the best filter that receives every node of `network`, linear in what arrives, knowing what arrived.

    Certified: rho of U_j -> sum_i chain[i, j] (A - K_i C_i) U_i (A - K_i C_i)' is below 1 for some gains, which are
    searched first and then certified independently of the search. Only rows of known gain are used: a gain that is
    random and unknown makes noise that grows with the state, so an unstable mode observed through such gains alone is
    impossible.
    Impossible: rho(chain within the modes that do not observe an eigenvector) |eigenvalue|^2 >= 1. Where losses alone
    are random, and noises Gaussian, that is true of every filter; a nonlinear filter may identify a hidden mode.

    Args:
        network: linear, of nodes that receive their sensors over channels that do not vary.

    Raises:
        ValueError: a plant, sensor or channel that varies or is not linear, a channel that delivers late, relays that
            filter, too many sets of losses.

    Source: Sinopoli et al. (2004), Theorems 2 to 5; Xie and Xie, Stability of a random Riccati equation with Markovian
        binary switching (2008); Liu and Goldsmith, Kalman filtering with partial observation losses (2004).
    """
    instance("network", network, Network, "a Network")
    a, q = plant_matrices(network.plant)
    links = _join_links(network, len(a))
    # Rows of known gain on all of x, or on the modes that do not decay.
    growing = _find_unstable_modes(a)
    for space in (np.eye(len(a)), growing):
        known = _group_losses(a, q, links, space)
        gains = find_gains(known.system)
        radius = certify_radius(known.system, gains)
        if radius < BELOW_ONE:
            bound = known.system.bound(gains).sum(axis=0) if known.exact else None
            return Boundedness("certified", _describe_certificate(a, radius), radius, 0.0, known.gains(gains), bound)
    # Not certified: is there an unstable mode that losses hide?
    unseen = find_fastest_unobserved_mode(a, known.system.chain, [known.system.outputs[s] for s in known.system.known])
    verdict, reason = _judge_unseen(network, links, growing, known, unseen, radius)
    return Boundedness(verdict, reason, radius, unseen.growth, known.gains(gains), None)


def _join_links(network: Network, states: int) -> JointLinks:
    """Join all nodes: sensors stacked, channels in parallel."""
    if network.relays is not None:
        raise fail("nodes", "ones that receive the sensors over channels", "relays that filter")
    # Sensors one above the other.
    nodes = [node for node in network.nodes.values() if isinstance(node, Node)]
    matrices, noises = zip(*(sensor_matrices(node.sensor, states) for node in nodes), strict=True)
    means = [np.asarray(first(node.sensor).noise.mean) for node in nodes]
    channels = [_require_constant(node.channel) for node in nodes]
    # Channels in parallel, as one chain of modes.
    joint = parallel(channels) if len(channels) > 1 else channels[0]
    for memory in memories(joint).values():
        if memory.is_uncertain:
            raise fail("chain of a channel", "one of known transition", "one whose probabilities are uncertain")
    modes = joint_modes(joint, 2)  # of a gain that drifts two values say that it is random
    initial, chain = np.asarray(modes.initial), np.asarray(modes.transition)
    # Modes that can occur.
    happens = initial @ np.linalg.matrix_power(np.eye(len(chain)) + chain, len(chain)) > 0
    outputs = [m.list_outcomes() for m, ever in zip(modes.maps, happens, strict=True) if ever]
    noise = scipy.linalg.block_diag(*noises)
    links = initial[happens], chain[np.ix_(happens, happens)], outputs
    return JointLinks(*links, np.concatenate(matrices), np.concatenate(means), noise)


def _require_constant(channel: Channel) -> AbstractRandomAffine:
    """Return a channel that neither varies nor delays; raise at another."""
    if isinstance(channel, OverTime):
        raise fail("channel", "one that does not vary", "one that varies")
    if channel.past:
        raise fail("channel", "one without delays", f"one that is late by up to {channel.past} steps")
    return channel


def _find_unstable_modes(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n d"]:
    """Return the orthonormal basis of the plant's modes that do not decay."""
    _, basis, count = scipy.linalg.schur(matrix / BELOW_ONE, sort="ouc")
    return np.asarray(basis[:, :count])


class KnownLosses(NamedTuple):
    """Usable measurements of a receiver, for each of the `kinds` of losses."""

    system: KnownLossSystem
    kinds: list[tuple[bool, ...]]
    parts: list["Certain"]

    @property
    def exact(self) -> bool:
        """True where nothing that arrives is left out."""
        return all(outcome.exact for outcome in self.parts)

    @property
    def random(self) -> bool:
        """True where random gains make something unusable."""
        return any(outcome.random for outcome in self.parts)

    def gains(self, gains: KindGains) -> dict[tuple[bool, ...], np.ndarray]:
        """Return the gains on what arrives, from those on its sums of known gain."""
        return {kind: k @ outcome.combine for kind, k, outcome in zip(self.kinds, gains, self.parts, strict=True)}


def _group_losses(a: np.ndarray, q: np.ndarray, links: JointLinks, space: Float[np.ndarray, "n d"]) -> KnownLosses:
    """Group the outcomes by set of losses, each with the sums of what arrives whose gain on a subspace of x is known.

    Modes that look the same to the receiver are one kind: a gain that differs between them is unknown.
    """
    # Sets of losses, and the sums of rows with known gain in each.
    kinds = list(dict.fromkeys(tuple(o.arrived.tolist()) for outcome in links.outcomes for o in outcome))
    # Cases: mode i, outcome o, and the number s of the outcome's set of losses.
    cases = [
        (i, o, kinds.index(tuple(o.arrived.tolist()))) for i, outcome in enumerate(links.outcomes) for o in outcome
    ]
    parts = [_find_certain([o for _, o, s in cases if s == kind], links, space) for kind in range(len(kinds))]
    # Chain of (mode, outcome), with its long-run law.
    kind_of_case = np.array([s for _, _, s in cases])
    mode = np.array([i for i, _, _ in cases])
    probability = np.array([o.probability for _, o, _ in cases])
    chain = links.chain[np.ix_(mode, mode)] * probability
    law = long_run_law(links.initial[mode] * probability, chain)
    noises = tuple(parts[s].noise(o, links) for _, o, s in cases)
    system = KnownLossSystem(a, q, chain, law, kind_of_case, tuple(outcome.rows for outcome in parts), noises)
    return KnownLosses(system, kinds, parts)


class Certain(NamedTuple):
    """Sums of received rows with known gain: `combine` (r, m) of them, which equal `rows` x + noise."""

    combine: Float[np.ndarray, "r m"]
    rows: Float[np.ndarray, "r n"]
    mean: Float[np.ndarray, "m p+1"]
    exact: bool
    random: bool

    def noise(self, outcome: Outcome, links: JointLinks) -> Float[np.ndarray, "r r"]:
        """Return Cov(D z) of the sums D z of known gain, at x = 0 and about the mean over outcomes of a kind."""
        mean, second = second_moments(outcome.map)
        v = np.append(links.sensor_mean, 1.0)
        signal = np.outer(v, v)
        signal[:-1, :-1] += links.sensor_noise
        about = self.mean @ v
        center = mean @ v
        total = np.einsum("ijab,ab->ij", second, signal) - np.outer(center, about) - np.outer(about, center)
        return np.asarray(self.combine @ (total + np.outer(about, about)) @ self.combine.T)


def _find_certain(alike: Sequence[Outcome], links: JointLinks, space: Float[np.ndarray, "n d"]) -> Certain:
    """Find the sums of known gain: the null space of E[(G - M) C Y Y' C' (G - M)'] over outcomes that look the same.

    Y is a basis of the subspace `space`.
    """
    moments = [second_moments(o.map) for o in alike]
    mean = np.mean([m for m, _ in moments], axis=0)
    arrived = np.flatnonzero(alike[0].arrived)
    # M C, and C Y Y' C'.
    rows = mean[:, :-1] @ links.sensing
    seen = links.sensing @ space @ (links.sensing @ space).T
    # Spread of the gain in mean square, as correlations.
    second = np.mean([np.einsum("ijab,ab->ij", t[..., :-1, :-1], seen) for _, t in moments], axis=0)
    about = mean[:, :-1] @ seen @ mean[:, :-1].T
    scale = np.sqrt(np.diag(second)[arrived])
    scale = np.where(scale > 0, scale, 1.0)
    spread = (second - about)[np.ix_(arrived, arrived)] / scale / scale[:, None]
    # Eigenvalues that are zero: sums of known gain.
    values, vectors = np.linalg.eigh(spread)
    combine = np.zeros((int(np.sum(values <= CERTAIN)), len(mean)))
    combine[:, arrived] = vectors[:, values <= CERTAIN].T / scale
    same = all(np.array_equal(m[:, -1], mean[:, -1]) for m, _ in moments)
    random = len(combine) < len(arrived)
    whole = space.shape[1] == len(space)
    return Certain(combine, combine @ rows, mean, whole and same, random)


def _describe_certificate(a: Float[np.ndarray, "n n"], radius: float) -> str:
    if spectral_radius(a) < BELOW_ONE:
        return f"the plant is stable, and fixed gains leave the error a spectral radius of {radius:.6g}"
    return f"fixed gains leave the mean square of the error a spectral radius of {radius:.6g}"


def _judge_unseen(
    network: Network,
    links: JointLinks,
    growing: np.ndarray,
    channel: KnownLosses,
    unseen: UnobservedGrowth,
    radius: float,
) -> tuple[Verdict, str]:
    """Return "impossible" if an unobserved eigenvector grows and noise keeps exciting it, else "undecided"."""
    if unseen.growth < 1:
        best = f"no gains are certified: the best that were found leave {radius:.6g}"
        return "undecided", f"{best}, and nothing that losses hide grows: {unseen.growth:.6g} < 1"
    reason = _explain_growth(links, channel.system, unseen)
    if not _is_excited(network, growing, channel, unseen):
        return "undecided", f"{reason}; but noise does not reach all that grows, so that it may stay zero"
    return "impossible", reason


def _explain_growth(links: JointLinks, system: KnownLossSystem, unseen: UnobservedGrowth) -> str:
    """Say why no filter's error can stay bounded: the plant's mode, and why what is received does not show it."""
    value = unseen.eigenvalue
    mode = f"the plant's mode of eigenvalue {value.real:.6g}" + (f" +- {value.imag:.6g}i" if value.imag else "")
    if len(unseen.modes) < len(system.chain):
        return f"{mode} grows by {unseen.growth:.6g} >= 1 a step in mean square while what would show it is lost"
    powers = [np.einsum("iiab->ab", second_moments(o.map)[1])[:-1, :-1] for outcome in links.outcomes for o in outcome]
    seen = links.sensing @ unseen.vectors
    if max(float(np.real(np.einsum("ad,ab,bd->", seen.conj(), power, seen))) for power in powers) > 0:
        return f"{mode} is seen only through random gains that are not known, which make noise as large as the state"
    return f"{mode} is not seen at all"


def _is_excited(network: Network, growing: np.ndarray, channel: KnownLosses, unseen: UnobservedGrowth) -> bool:
    """Test whether P stays above eps v v': noise enters along v at once, or reaches it and every measurement has noise.

    The noise of random gains grows only where noise reaches all that is unstable.
    """
    a, q = channel.system.transition, channel.system.process
    expected = np.concatenate([unseen.vectors, growing], axis=1) if channel.random else unseen.vectors
    if is_excited_by_noise(expected, np.zeros_like(a), q):
        return True
    if any(np.linalg.eigvalsh(r).min(initial=np.inf) <= 0 for r in channel.system.noises):
        return False
    start = q + np.asarray(first(network.plant).initial_covariance)
    return is_excited_by_noise(expected, a, q) or (unseen.growth > 1 and is_excited_by_noise(expected, a, start))
