"""Boundedness for all time of the mean error covariance of a network's best filter, certified or refuted.

The plant is x+ = A x + w, and z = G (H x + v) + n arrives, G and n random. P is the filter's prior error covariance, E
its mean over what is lost. A kind of losses is a set of components that arrive; a mode that of the links' chain, where
it is not one of the plant (an eigenvector of A).
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple

import numpy as np
import scipy

from heliograph.linear.known_loss_stability import (
    BELOW_ONE,
    KindGains,
    KnownLossSystem,
    UnobservedGrowth,
    certify_radius,
    find_fastest_unobserved_mode,
    find_gains,
    is_excited_by_noise,
)
from heliograph.linear.steady_state import plant_matrices
from heliograph.model.over_time import first
from heliograph.numerics.check import instance
from heliograph.numerics.lapack import spectral_radius
from heliograph.numerics.module import readable
from heliograph.numerics.types import Float
from heliograph.random_affine.base import ArrivalOutcome
from heliograph.random_affine.erasure import second_moments
from heliograph.random_affine.modes import long_run_law
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node
from heliograph.simulation.transmission.joint_links import JointLinks, find_joint_links

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


def certify_boundedness(network: Network) -> Boundedness:
    """Judge whether E P, the mean error covariance of the best linear filter of all nodes' messages, stays bounded.

    The filter knows what arrived. U_i is the part of E P in state i of the losses, and `chain` holds the probabilities
    of their transitions. A is the plant's matrix, C_i the received rows in state i, K_i a gain, and rho the spectral
    radius.

    Certified: rho of U_j -> sum_i chain[i, j] (A - K_i C_i) U_i (A - K_i C_i)' is below 1 for some gains, which are
    searched first and then certified independently of the search. Only rows of known gain are used: a gain that is
    random and unknown makes noise that grows with the state, so an unstable mode observed through such gains alone is
    impossible.
    Impossible: rho(chain within the modes that do not observe an eigenvector) |eigenvalue|^2 >= 1. Where losses alone
    are random, and noises Gaussian, that is true of every filter; a nonlinear filter may identify a hidden mode.
    Some nodes use a message only if a trigger, limits or `stuck` allow it, and some send words, which end at their
    range. Certified is what holds without these nodes. Impossible is what holds even if they send everything. All else
    is undecided.

    Args:
        network: linear, of nodes that receive their sensors over channels that do not vary.

    Raises:
        ValueError: a plant, sensor or channel that varies or is not linear, a channel that delivers late or tells its
            gain, relays that filter, a sensor with feedback, too many sets of losses.

    Source: Sinopoli et al. (2004), Theorems 2 to 5; Xie and Xie, Stability of a random Riccati equation with Markovian
        binary switching (2008); Liu and Goldsmith, Kalman filtering with partial observation losses (2004).
    """
    instance("network", network, Network, "a Network")
    a, q = plant_matrices(network.plant)
    senders = {name: node for name, node in network.nodes.items() if isinstance(node, Node)}
    chosen = [name for name, node in senders.items() if node.disturbs_what_is_sent]
    found = _judge_links(network, a, q, find_joint_links(network, len(a), counts_all=False))
    if not chosen or found.verdict == "certified":
        return found
    # Such nodes certify nothing. An error that grows even if they sent everything grows in any case.
    complete = _judge_links(network, a, q, find_joint_links(network, len(a), counts_all=True))
    if complete.verdict == "impossible":
        return complete
    unjudged = f"what nodes {chosen} show is not counted, as values, or the range of words, decide what of it is used"
    return found._replace(verdict="undecided", reason=f"{found.reason}; {unjudged}")


def _judge_links(network: Network, a: np.ndarray, q: np.ndarray, links: JointLinks) -> Boundedness:
    """Return the verdict on the filter's mean error covariance for a plant x+ = A x + N(0, Q) behind these links.

    Received numbers z = G x + noise have random gains G, which the filter does not know. It can use sums D z whose gain
    D G on x is the same in all outcomes of the losses that look alike. Errors stay bounded if some filter gains on such
    sums give them a spectral radius below 1 ("certified"). They grow if the losses hide a growing mode of A for too
    long ("impossible"). Else the verdict is "undecided". `a` and `q` are A and Q; `links`: joint model of all links'
    losses.
    """
    # First sums whose gain is known on all of x. If these certify nothing, those whose gain is known on the modes of A
    # that do not decay: there are more of them.
    unstable_modes = _find_unstable_modes(a)
    usable, gains, radius = _find_best_gains(a, q, links, basis=np.eye(len(a)))
    if not radius < BELOW_ONE:
        usable, gains, radius = _find_best_gains(a, q, links, basis=unstable_modes)
    system = usable.system
    if radius < BELOW_ONE:
        # The sum over i of U_i, the steady error covariance in state i of the losses, bounds E P in the long run.
        bound = system.solve_steady_covariances(gains).sum(axis=0) if usable.exact else None
        return Boundedness(
            verdict="certified",
            reason=_describe_certificate(a, radius),
            radius=radius,
            growth=0.0,
            gains=usable.map_gains(gains),
            bound=bound,
        )
    # Not certified. Do losses hide a mode that does not decay? By state of the losses: the usable sums' gain on x.
    outputs_by_state = [system.outputs[kind] for kind in system.known]
    unseen = find_fastest_unobserved_mode(a, system.chain, outputs_by_state)
    verdict, reason = _judge_unobserved_modes(network, links, unstable_modes, usable, unseen, radius)
    return Boundedness(
        verdict=verdict, reason=reason, radius=radius, growth=unseen.growth, gains=usable.map_gains(gains), bound=None
    )


class _FixedGains(NamedTuple):
    """Fixed filter gains on sums of received numbers, and the spectral radius of E[e e'] -> E[e+ e+'] under them."""

    usable: "UsableMeasurements"
    gains: KindGains
    radius: float


def _find_best_gains(a: np.ndarray, q: np.ndarray, links: JointLinks, basis: Float[np.ndarray, "n d"]) -> _FixedGains:
    """Return the best fixed gains that a search finds on sums whose gain is known on the span of the basis."""
    usable = _find_usable_measurements(a, q, links, basis)
    gains = find_gains(usable.system)
    return _FixedGains(usable, gains, radius=certify_radius(usable.system, gains))


def _find_unstable_modes(matrix: Float[np.ndarray, "n n"]) -> Float[np.ndarray, "n d"]:
    """Return an orthonormal basis, one column each, of the modes of A = `matrix` that do not decay: |lambda| >= 1."""
    _, basis, count = scipy.linalg.schur(matrix / BELOW_ONE, sort="ouc")  # first those outside the unit circle
    return np.asarray(basis[:, :count])


class UsableMeasurements(NamedTuple):
    """What a receiver can use of its measurements: sums of known gain, by the kind of losses that it sees.

    Args:
        system: the plant x+ = A x + w, measured by sums of what arrives, with the Markov chain of the losses.
        kinds: for each kind of losses, a flag for each received component: whether it arrives.
        known_sums: the sums D z of received numbers z that are used in each kind.
    """

    system: KnownLossSystem
    kinds: list[tuple[bool, ...]]
    known_sums: list["KnownGainSums"]

    @property
    def exact(self) -> bool:
        """True if the gains of all sums are known on the whole state, and their offsets: the noises are then exact."""
        return all(sums.exact for sums in self.known_sums)

    @property
    def random(self) -> bool:
        """True if some combination of received numbers is not used, since its gain is random."""
        return any(sums.random for sums in self.known_sums)

    def map_gains(self, gains: KindGains) -> dict[tuple[bool, ...], np.ndarray]:
        """Return K D (n, received) by kind: gains on what arrives, from gains K on its sums D z of known gain."""
        return {kind: k @ sums.combine for kind, k, sums in zip(self.kinds, gains, self.known_sums, strict=True)}


def _find_usable_measurements(
    a: np.ndarray, q: np.ndarray, links: JointLinks, basis: Float[np.ndarray, "n d"]
) -> UsableMeasurements:
    """Return for each pattern of what arrives the sums of received numbers whose gain on a subspace of x is known.

    The plant is x+ = A x + w. The pattern of arriving components (a kind of losses) is all that the receiver sees of
    the channel's mode. Gains that differ between modes with one pattern are unknown to it; used are sums D z of the
    received numbers z whose gain does not differ.

    Args:
        a: A (n, n).
        q: Cov w (n, n).
        links: joint model of all links: the Markov chain of their modes, and for each mode the possible outcomes
            (which components arrive, with which probability, and gain and noise).
        basis: basis of the subspace (n, d), in columns.
    """
    # All outcomes of all modes one after another, the mode of each, and its pattern of what arrives.
    outcomes = [outcome for outcomes_of_mode in links.outcomes for outcome in outcomes_of_mode]
    mode = np.repeat(np.arange(len(links.outcomes)), [len(outcomes_of_mode) for outcomes_of_mode in links.outcomes])
    patterns = [tuple(outcome.arrived.tolist()) for outcome in outcomes]
    # Kinds of losses, which kind each outcome is, and the sums of known gain in each kind.
    kinds = list(dict.fromkeys(patterns))
    kind_of_outcome = np.array([kinds.index(pattern) for pattern in patterns])
    known_sums = [
        _find_known_sums([o for o, pattern in zip(outcomes, patterns, strict=True) if pattern == kind], links, basis)
        for kind in kinds
    ]
    # Chain of pairs (mode, outcome), P(next pair | pair) = P(next mode | mode) P(outcome | mode), and its long-run law.
    probability = np.array([outcome.probability for outcome in outcomes])
    chain = links.chain[np.ix_(mode, mode)] * probability
    law = long_run_law(links.initial[mode] * probability, chain)
    noises = tuple(
        known_sums[kind].find_noise_of_sums(outcome, links)
        for outcome, kind in zip(outcomes, kind_of_outcome, strict=True)
    )
    system = KnownLossSystem(a, q, chain, law, kind_of_outcome, tuple(sums.rows for sums in known_sums), noises)
    return UsableMeasurements(system, kinds, known_sums)


class KnownGainSums(NamedTuple):
    """Sums D z of received rows whose gain on x is known: D z = rows x + noise.

    Args:
        combine: D, r sums of m received components.
        rows: their gain on x.
        mean: of the channel's gain and offset, over the outcomes that look the same; p: measured components.
        exact: the gain is known on the whole state, and the offset too, so that the noise does not depend on the state.
        random: some combination of what arrives is left out, since its gain is random.
    """

    combine: Float[np.ndarray, "r m"]
    rows: Float[np.ndarray, "r n"]
    mean: Float[np.ndarray, "m p+1"]
    exact: bool
    random: bool

    def find_noise_of_sums(self, outcome: ArrivalOutcome, links: JointLinks) -> Float[np.ndarray, "r r"]:
        """Return D E[(z - m)(z - m)'] D' (r, r), the noise of the sums D z in one outcome of the losses at x = 0.

        D is `self.combine`. z = G y with y = (v, 1), the sensors' noise v and a 1 for the offset of the random gain G.
        m = M E y is what the filter expects: it cannot tell this outcome from others in which the same numbers arrive,
        and M = `self.mean` is the mean of G over all of these.
        """
        mean, gain_moments = second_moments(outcome.map)  # E G, and E[G_ia G_jb] as [i, j, a, b], in this outcome
        # E y, and E[y y'].
        mean_signal = np.append(links.sensor_mean, 1.0)
        signal_moments = np.outer(mean_signal, mean_signal)
        signal_moments[:-1, :-1] += links.sensor_noise
        # E[z z'] - E[z] m' - m E[z]' + m m'.
        expected, mean_in_outcome = self.mean @ mean_signal, mean @ mean_signal  # m, and E z
        second = np.einsum("ijab,ab->ij", gain_moments, signal_moments)  # E[z z']
        cross = np.outer(mean_in_outcome, expected)
        noise = second - cross - cross.T + np.outer(expected, expected)
        return np.asarray(self.combine @ noise @ self.combine.T)


def _find_known_sums(
    outcomes: Sequence[ArrivalOutcome], links: JointLinks, basis: Float[np.ndarray, "n d"]
) -> KnownGainSums:
    """Return the sums D z of received numbers z = G (H x + v) whose gain D G H is the same in all these outcomes.

    The same components arrive in the `outcomes`, so that a receiver cannot tell them apart. G is random, of mean M over
    them, and H the sensors' matrix. The gain is to be known on the span of Y = `basis`: it is if D (G - M) H Y = 0
    always. So D spans the null space of V = E[(G - M) H Y Y' H' (G - M)'].
    """
    # E G, and E[G_ia G_jb] as [i, j, a, b], of each outcome; the last column of G is its offset. M is their mean.
    moments = [second_moments(outcome.map) for outcome in outcomes]
    mean = np.mean([mean_of_outcome for mean_of_outcome, _ in moments], axis=0)
    arrived = np.flatnonzero(outcomes[0].arrived)
    rows = mean[:, :-1] @ links.sensing  # M H
    sensed = links.sensing @ basis @ (links.sensing @ basis).T  # S = H Y Y' H'
    # V = E[G S G'] - M S M', scaled as the correlations of what arrives.
    second = np.mean([np.einsum("ijab,ab->ij", t[..., :-1, :-1], sensed) for _, t in moments], axis=0)
    of_mean = mean[:, :-1] @ sensed @ mean[:, :-1].T
    scale = np.sqrt(np.diag(second)[arrived])
    scale = np.where(scale > 0, scale, 1.0)
    variance = (second - of_mean)[np.ix_(arrived, arrived)] / scale / scale[:, None]
    # Its eigenvectors of eigenvalue zero, taken back to the units of what arrives, are the rows of D.
    values, vectors = np.linalg.eigh(variance)
    is_known = values <= CERTAIN
    combine = np.zeros((int(np.sum(is_known)), len(mean)))
    combine[:, arrived] = vectors[:, is_known].T / scale
    # Whether the sums are exact: gain known on all states, and the same offset in all outcomes.
    offset_is_known = all(np.array_equal(mean_of_outcome[:, -1], mean[:, -1]) for mean_of_outcome, _ in moments)
    spans_all_states = basis.shape[1] == len(basis)
    return KnownGainSums(
        combine=combine,
        rows=combine @ rows,
        mean=mean,
        exact=spans_all_states and offset_is_known,
        random=len(combine) < len(arrived),
    )


def _describe_certificate(transition: Float[np.ndarray, "n n"], radius: float) -> str:
    """Return in words why the errors stay bounded: the plant is stable, or fixed gains bound them.

    `transition`: the plant's transition matrix. `radius`: the spectral radius of the error under these fixed gains.
    """
    if spectral_radius(transition) < BELOW_ONE:
        return f"the plant is stable, and fixed gains leave the error a spectral radius of {radius:.6g}"
    return f"fixed gains leave the mean square of the error a spectral radius of {radius:.6g}"


def _judge_unobserved_modes(
    network: Network,
    links: JointLinks,
    unstable_modes: np.ndarray,
    usable: UsableMeasurements,
    unseen: UnobservedGrowth,
    radius: float,
) -> tuple[Verdict, str]:
    """Return verdict and reason: "impossible" if an unobserved mode grows and noise excites it, else "undecided".

    The question is whether some filter keeps its mean squared error bounded. Every filter's error grows without bound
    along a mode of eigenvalue lambda if noise excites it and `unseen.growth`, |lambda|^2 times the spectral radius of
    the losses that hide it (the rate at which it becomes unlikely to stay hidden), is 1 or more.

    Args:
        network: the network.
        links: joint model of all links.
        unstable_modes: basis of the plant's modes that do not decay.
        usable: sums of received numbers of known gain, for each pattern of what arrives.
        unseen: the plant's mode that grows most while the links do not observe it.
        radius: spectral radius of the error's second moments with the best gains that were found, 1 or more.
    """
    if unseen.growth < 1:
        best = f"no gains are certified: the best that were found leave {radius:.6g}"
        return "undecided", f"{best}, and nothing that losses hide grows: {unseen.growth:.6g} < 1"
    reason = _explain_unbounded_error(links, usable.system, unseen)
    if not _is_mode_excited(network, unstable_modes, usable, unseen):
        return "undecided", f"{reason}; but noise does not reach all that grows, so that it may stay zero"
    return "impossible", reason


def _explain_unbounded_error(links: JointLinks, system: KnownLossSystem, unseen: UnobservedGrowth) -> str:
    """Return why no filter's error can stay bounded, in words: the plant's mode, and why nothing received shows it.

    `unseen`: eigenvalue and eigenvectors of that mode, the modes of the chain of losses in which nothing shows it
    (`modes`), and its growth; `system`: what is received, with the chain of all losses.
    """
    value = unseen.eigenvalue
    mode = f"the plant's mode of eigenvalue {value.real:.6g}" + (f" +- {value.imag:.6g}i" if value.imag else "")
    if len(unseen.modes) < len(system.chain):
        return f"{mode} grows by {unseen.growth:.6g} >= 1 a step in mean square while what would show it is lost"
    # No known gain shows the mode's eigenvectors V. Does a random one, G of z = G (H x + v) + n? It does if the mean
    # power E |G H V|^2 = tr((H V)* E[G' G] H V) is positive in some outcome of the losses.
    seen = links.sensing @ unseen.vectors  # H V
    powers = []
    for outcome in (outcome for outcomes_of_mode in links.outcomes for outcome in outcomes_of_mode):
        _, second = second_moments(outcome.map)  # E[G_ia G_jb] as [i, j, a, b]; the last column of G is its offset
        gain_power = np.einsum("iiab->ab", second)[:-1, :-1]  # E[G' G], without the offset
        powers.append(float(np.real(np.einsum("ad,ab,bd->", seen.conj(), gain_power, seen))))
    if max(powers) > 0:
        return f"{mode} is seen only through random gains that are not known, which make noise as large as the state"
    return f"{mode} is not seen at all"


def _is_mode_excited(
    network: Network, unstable_modes: np.ndarray, usable: UsableMeasurements, unseen: UnobservedGrowth
) -> bool:
    """Return whether noise keeps exciting the unseen mode v: whether P >= eps v v', eps > 0, for every filter.

    An unseen mode v is an eigenvector of A that losses hide from the filter. x+ = A x + w, Cov w = Q. If v is excited,
    its part of the error covariance P grows while nothing received shows it. Random gains of the links make noise in
    proportion to the state: that noise grows, and hides v, only if the state does, so then all unstable modes must be
    excited too.

    Args:
        network: the network, whose plant has the covariance of x_0.
        unstable_modes: basis of the modes of A that do not decay.
        usable: sums of received numbers of known gain, with the system that they measure; `random` if random gains make
            other sums unusable.
        unseen: the mode v: `vectors`, a basis of its eigenvectors, and `growth` per step.
    """
    a, q = usable.system.transition, usable.system.process
    # The directions that must be excited.
    directions = np.concatenate([unseen.vectors, unstable_modes], axis=1) if usable.random else unseen.vectors
    # Q itself excites them in each step, whatever is measured (A = 0 in the test).
    if is_excited_by_noise(directions, np.zeros_like(a), q):
        return True
    # Q excites them over several steps, through A. Measurements without noise could remove the error on the way.
    if any(np.linalg.eigvalsh(r).min(initial=np.inf) <= 0 for r in usable.system.noises):
        return False
    if is_excited_by_noise(directions, a, q):
        return True
    # The error of x_0 excites them once, which is enough for a mode that grows by more than 1 a step.
    initial = q + np.asarray(first(network.plant).initial_covariance)
    return unseen.growth > 1 and is_excited_by_noise(directions, a, initial)
