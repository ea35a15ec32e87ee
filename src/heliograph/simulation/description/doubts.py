"""Doubts about a network before any data: states that no sensor shows, errors without bound, memory that is ignored."""

from collections.abc import Iterator
from typing import NamedTuple

import numpy as np

from heliograph.disk.quoted_text import join_names
from heliograph.filters.base import AbstractFilter
from heliograph.filters.gaussian.gaussian import GaussianFilter
from heliograph.filters.linear.linear import LinearFilter
from heliograph.filters.words.linear_word_filter import SEEN
from heliograph.filters.wrappers.told_link_law import ToldFilter, believe_typical
from heliograph.model.assumed.agreement import CHANNEL
from heliograph.model.assumed.same_plant_and_sensor import find_sensor_matrix
from heliograph.model.channel_side_information import separate_told_numbers
from heliograph.model.fading import memory_matters
from heliograph.model.over_time import at_each_step, first
from heliograph.model.sensor import AbstractSensor
from heliograph.numerics.check import InputError, instance
from heliograph.numerics.module import readable
from heliograph.numerics.numpy_or_jax import DOUBLE
from heliograph.numerics.types import Float
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.channel_state_information import list_told_maps
from heliograph.random_affine.modes import redraw_modes_each_step
from heliograph.random_affine.sum_of_maps import Superposed
from heliograph.simulation.boundedness import certify_boundedness
from heliograph.simulation.covariance_claims import MistakenBelief, yield_mistaken_beliefs
from heliograph.simulation.declared_noise.refit import list_links_declaring_noise
from heliograph.simulation.description.angle_doubts import doubt_degrees_at_start, doubt_wide_angles_at_start
from heliograph.simulation.description.diagram import list_rounded_numbers, list_shared_in_words
from heliograph.simulation.description.execution_fallbacks import describe_sequential_filters, explain_xla_fallbacks
from heliograph.simulation.description.observability import list_sensors, make_observability_matrix
from heliograph.simulation.description.separable_nodes import separate_nodes
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node
from heliograph.simulation.results.overloaded_words import find_overloads

CANCELLED = 1e-12  # of the largest mean gain: what is left where gains cancel
HIDDEN = 1e-9  # of the largest singular value of the observability matrix: what is smaller is rounding
NODES_LIMIT = 12  # nodes of which each is judged alone
SEED = 0  # of the state at which a nonlinear plant is judged


@readable
class Doubt(NamedTuple):
    """A line about a network; `serious` where an estimate may not be what it is for, else something to know.

    Args:
        serious: whether an estimate may not be what it is for.
        words: the line.
    """

    serious: bool
    words: str


def doubts_before_data(network: Network) -> list[Doubt]:
    """Return what is doubtful in a network that has not seen any data, the serious first.

    A doubt is serious if an estimate may not be what it is for; all others are good to know, such as what costs time.
    Each is a sentence for the user, found from the models of plant, sensors, channels and filters.

    Args:
        network: the network.

    Raises:
        ValueError: what is no network.
    """
    instance("network", network, Network, "a Network")
    # States that no sensor observes, errors without a bound, links that carry nothing, filters that ignore a link's
    # memory, filters that assume other models than the true ones.
    doubts = [*_doubt_unobservable_states(network), *_doubt_boundedness(network), *_doubt_useless_links(network)]
    doubts += [*_doubt_forgetful_filters(network), *_doubt_mistaken_beliefs(network)]
    # In words alone: serious ones on angles; then lost digits, links that fail together, and slow computation.
    serious = [*doubt_wide_angles_at_start(network), *doubt_degrees_at_start(network)]
    notes = [f"digits: {words}; make tables {DOUBLE}" for words in list_rounded_numbers(network)]
    notes += [f"shared, so that losses come together: {words}" for words in list_shared_in_words(network)]
    notes += [f"by XLA, which takes longer: {words}" for words in explain_xla_fallbacks(network)]
    if sequential := describe_sequential_filters(network):
        notes.append(f"row by row however long a recording is, since not linear in its data: {sequential}")
    doubts += [Doubt(serious=True, words=words) for words in serious]
    doubts += [Doubt(serious=False, words=words) for words in notes]
    # Noise that messages declare, links that report what is not the whole truth, words of few bits.
    doubts += [*_doubt_declared_noise(network), *_doubt_told_numbers_without_claim(network)]
    doubts += [*_doubt_overloaded_words(network), *_doubt_independent_nodes(network)]
    return sorted(doubts, key=lambda doubt: not doubt.serious)


def _doubt_independent_nodes(network: Network) -> Iterator[Doubt]:
    """Yield a line if nodes measure states that nothing couples: each part could be a network of its own.

    Parts that are estimated together cost more than apart, and estimate nothing better.
    """
    parts = separate_nodes(network)
    if len(parts) > 1:
        words = f"independent: nothing couples what {join_names([repr(names[0]) for names in parts])} measure"
        advice = "a plant of each, a fleet, is estimated as well, starts sooner, costs less"
        yield Doubt(serious=False, words=f"{words}; {advice}")


def _doubt_overloaded_words(network: Network) -> Iterator[Doubt]:
    """Yield how often a node's words of few bits are expected to be overloaded by values beyond their range.

    A doubt is serious if the bound on this probability is above SEEN.
    """
    for name, filters in find_overloads(network).items():
        for label, overload in filters.items():
            is_serious = not float(overload.bound) <= SEEN  # also True for NaN
            yield Doubt(serious=is_serious, words=overload.describe(name, label))


def _doubt_unobservable_states(network: Network) -> Iterator[Doubt]:
    """Yield a doubt if there are directions of the state that no sensor shows within n steps, by their states' names.

    They are the null space of the observability matrix, the derivatives of all outputs with respect to the state.
    """
    # At a state drawn around the initial mean: at the mean itself, often a point of symmetry, a nonlinear sensor may
    # have a derivative of zero that it has nowhere else.
    plant = first(network.plant)
    deviation = np.sqrt(np.diagonal(np.asarray(plant.initial_covariance)))
    state = np.asarray(plant.initial_mean) + deviation * np.random.default_rng(SEED).normal(size=len(plant.states))
    matrix = make_observability_matrix(plant, list_sensors(network), state, len(plant.states))
    if not np.isfinite(matrix).all():
        yield Doubt(False, "observability: not judged, the derivatives of plant or sensors are no numbers")
        return
    # Rows (outputs) and then columns (states) scaled to length 1, so that no unit matters; those of zeros stay.
    row_lengths = np.linalg.norm(matrix, axis=1, keepdims=True)
    rows = matrix / np.where(row_lengths > 0, row_lengths, 1.0)
    column_lengths = np.linalg.norm(rows, axis=0)
    _, singular, right = np.linalg.svd(rows / np.where(column_lengths > 0, column_lengths, 1.0))
    # States with a part in the null space, whose basis are the last right singular vectors.
    rank = int(np.sum(singular > HIDDEN * max(singular[0], 1e-300)))
    hidden = np.abs(right[rank:]).max(axis=0, initial=0.0) > np.sqrt(HIDDEN)
    names = [repr(name) for name, unseen in zip(network.states, hidden, strict=True) if unseen]
    if names:
        directions = len(network.states) - rank
        what = names[0] if len(names) == 1 else f"{directions} of the combinations of {', '.join(names)}"
        yield Doubt(True, f"unobservable: no sensor shows {what}, of which filters know no more than before any data")


def _doubt_boundedness(network: Network) -> Iterator[Doubt]:
    """Yield what is known before data on whether errors stay bounded: of all nodes together, and of each alone.

    Where nodes are many, more than NODES_LIMIT, each alone is not judged. A node's own error that grows is serious only
    where nothing is fused, as the node is then all that there is.
    """
    # All nodes together, then each that has filters.
    yield from _doubt_error_bound(network, "the mean error of every filter", serious=True)
    nodes_with_filters = [name for name, node in network.nodes.items() if isinstance(node, Node) and node.filters]
    if len(network.nodes) == 1 or not nodes_with_filters:
        return
    if len(nodes_with_filters) > NODES_LIMIT:
        yield Doubt(
            serious=False, words=f"boundedness of each node alone: not judged of {len(nodes_with_filters)} nodes"
        )
        return
    for name in nodes_with_filters:
        node = network.nodes[name]
        network_of_node = Network(network.plant, {name: node})
        yield from _doubt_error_bound(network_of_node, f"the mean error of {name!r} alone", serious=not network.fused)


def _doubt_error_bound(network: Network, what: str, serious: bool) -> Iterator[Doubt]:
    """Yield a doubt if the error of the best filter of all nodes grows without end, or if this cannot be decided.

    `what`: whose error it is, in words. `serious`: True if growth is a serious doubt. Only then is there also a line if
    boundedness cannot be judged.
    """
    try:
        boundedness = certify_boundedness(network)
    except InputError as error:
        if serious:
            yield Doubt(serious=False, words=f"boundedness: not judged ({error})")
        return
    if boundedness.verdict == "impossible":
        yield Doubt(serious=serious, words=f"unbounded: {what} grows without end: {boundedness.reason}")
    elif boundedness.verdict == "undecided" and not _has_undecided_senders(network):
        yield Doubt(serious=False, words=f"boundedness of {what}: undecided: {boundedness.reason}")


def _has_undecided_senders(network: Network) -> bool:
    """Return whether at some node data decide what is used (trigger, limits), or codewords stand for numbers.

    `certify_boundedness` is always undecided then, so that "undecided" is no news.
    """
    return any(isinstance(node, Node) and node.disturbs_what_is_sent for node in network.nodes.values())


def _doubt_useless_links(network: Network) -> Iterator[Doubt]:
    """Yield doubts on links that add up at a node, z = sum_i G_i y_i + n, and are useless to a linear filter.

    That is so of all together where their mean gains cancel, and of one whose mean gain is zero.
    """
    for name, node in network.nodes.items():
        channel = first(node.channel) if isinstance(node, Node) else None
        if not isinstance(node, Node) or not isinstance(channel, Superposed):
            continue
        gains = [_compute_mean_gain(link) for link in channel.maps]
        if _do_gains_cancel(channel, gains, first(node.sensor)):
            advice = "a linear filter learns nothing of it; compensate phases and signs at the transmitters"
            yield Doubt(serious=True, words=f"unheard: what adds up at {name!r} has mean gain 0: {advice}")
            continue
        silent = [f"link{i}" for i, gain in enumerate(gains, 1) if not np.any(gain)]
        if silent:
            yield Doubt(False, f"unheard: {join_names(silent)} at {name!r}: of mean gain 0, which only adds noise")


def _compute_mean_gain(link: AbstractRandomAffine) -> Float[np.ndarray, "m p"]:
    """Return E[G] of a link z = G y + n, over its fading and, where its modes have memory, over their long-run law."""
    mean = np.asarray(redraw_modes_each_step(link).moments(1).mean)  # [E G, E n; 0, 1]
    return mean[:-1, :-1]


def _do_gains_cancel(channel: Superposed, gains: list[Float[np.ndarray, "m p"]], sensor: AbstractSensor) -> bool:
    """Return whether sum_i E[G_i] C_i = 0 up to rounding, so that the mean of z = sum_i G_i C_i x + n shows no state.

    C_i are the rows of the sensor's matrix C that link i carries (`channel.places`). Where the sensor is not linear, or
    the channel is late and so carries past signals too, C = I: it is judged by signals and not by states.

    Args:
        channel: the sum of links.
        gains: E[G_i] of each link.
        sensor: what measures the signals.
    """
    is_late = channel.past > 0
    matrix = None if is_late else find_sensor_matrix(sensor)
    sensed = np.eye(channel.inputs) if matrix is None else np.asarray(matrix)  # C
    heard = [gain @ sensed[list(outputs)] for gain, outputs in zip(gains, channel.places, strict=True)]
    return not np.any(np.abs(sum(heard)) > CANCELLED * sum(np.abs(mean) for mean in heard))


def _doubt_declared_noise(network: Network) -> Iterator[Doubt]:
    """Yield a line on the nodes whose messages declare the variance of their noise, which filters take for true.

    A message may bring the variance of its own noise beside its value. Whether such variances are true shows only in
    data.
    """
    names = []
    for name, node in network.nodes.items():
        if not isinstance(node, Node):
            continue
        # A ToldFilter uses numbers that come with each message, such as this variance.
        filters_using_numbers = [filter for filter in node.filters.values() if isinstance(filter, ToldFilter)]
        if any(list_links_declaring_noise(filter) for filter in filters_using_numbers):
            names.append(name)
    if names:
        senders = join_names([repr(name) for name in names])
        yield Doubt(
            False, f"declared: noise is taken as the messages of {senders} say it; `heliograph run --report` judges it"
        )


def _doubt_told_numbers_without_claim(network: Network) -> Iterator[Doubt]:
    """Yield a doubt for each node with filters behind a link whose reported numbers do not give its law exactly.

    With each message such a link reports numbers of its law, such as a gain. If they are not the whole truth, for the
    reason that the link gives, filters that use them claim "nominal": their covariance is neither exact nor a bound.
    """
    for name, node in network.nodes.items():
        if not isinstance(node, Node) or not node.filters:
            continue
        for affine in list_told_maps(first(node.channel)):
            if reason := affine.reason_for_no_claim:
                numbers = join_names([repr(number) for number in affine.names])
                yield Doubt(serious=True, words=f"told: {numbers} at {name!r} {reason}, so that claims are nominal")


def _doubt_mistaken_beliefs(network: Network) -> Iterator[Doubt]:
    """Yield a doubt for filters that were made for other models than those of the node where they stand.

    Filters of one name that are wrong in the same parts of the model make one line, which names all their nodes. The
    doubt is serious if the filter's claim of its covariance was lowered to "nominal" for this.
    """
    beliefs_by_line: dict[tuple[bool, str, tuple[str, ...]], list[MistakenBelief]] = {}
    # For each filter the nodes where it ignores the memory of their links: `_doubt_forgetful_filters` tells of these.
    nodes_with_ignored_memory = _list_forgetful_nodes(network)
    for belief in yield_mistaken_beliefs(network):
        if belief.parts == (CHANNEL,) and belief.node in nodes_with_ignored_memory.get(belief.filter, ()):
            continue
        beliefs_by_line.setdefault((belief.lowered, belief.filter, belief.parts), []).append(belief)
    for (was_lowered, _, _), beliefs in beliefs_by_line.items():
        other_nodes = join_names([repr(belief.node) for belief in beliefs[1:]])
        places = f" (and at {other_nodes})" if len(beliefs) > 1 else ""
        consequence = ", so that its claim is nominal" if was_lowered else ""
        yield Doubt(serious=was_lowered, words=f"another world: {beliefs[0].words}{places}{consequence}")


def _doubt_forgetful_filters(network: Network) -> Iterator[Doubt]:
    """Yield a doubt for each filter that takes a link for one without memory although its gains have memory."""
    for label, names in _list_forgetful_nodes(network).items():
        finding = f"ignored memory: {label!r} of {join_names(names)} takes a link for one without memory"
        remedy = "another channel than its own; linear_filter or mixture_filter of the link knows it"
        yield Doubt(serious=True, words=f"{finding}, {remedy}")


def _fix_told_numbers(channel: AbstractRandomAffine) -> AbstractRandomAffine:
    """Return a channel with fixed values for the numbers of its law that are reported with each message.

    A filter needs no memory to use a reported number, which comes with the message. So the number is fixed at the value
    that is assumed where none is reported, before it is judged whether the channel's memory matters.
    """
    link, _, reported_numbers = separate_told_numbers(channel)
    return believe_typical(link) if reported_numbers else channel


def _list_forgetful_nodes(network: Network) -> dict[str, list[str]]:
    """Return for each filter name the nodes where the filter takes a link with memory for one without.

    Memory matters if gains are correlated over time. Numbers that a link tells are fixed at typical ones to judge this.
    """
    nodes: dict[str, list[str]] = {}
    for name, node in network.nodes.items():
        if not isinstance(node, Node):
            continue
        try:
            remembers = memory_matters(at_each_step(_fix_told_numbers, node.channel))
        except InputError:  # it is unknown whether this memory matters
            continue
        for label, filter_ in node.filters.items() if remembers else ():
            if _ignores_memory(filter_):
                nodes.setdefault(label, []).append(name)
    return nodes


def _ignores_memory(filter: AbstractFilter) -> bool:
    """Return whether a filter takes its link's gains for independent over time, though they may be correlated.

    Filters of these two classes do: their state has no part for the channel's mode, which carries its memory from step
    to step. Judged is a filter, or the one inside it where it wraps another (`base`).
    """
    inner = getattr(filter, "base", filter)
    return isinstance(inner, GaussianFilter | LinearFilter)
