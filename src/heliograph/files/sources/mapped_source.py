"""Sources on a network: which numbers of a node's measurement the fields of a topic's messages are."""

from collections.abc import Mapping, Sequence
from difflib import get_close_matches
from typing import NamedTuple

import numpy as np

from heliograph.files.sources.source_description import Source
from heliograph.live.event import INPUTS
from heliograph.numerics.check import fail, show_value

NamesByNode = Mapping[str, tuple[str, ...]]  # names of each node's numbers; under INPUTS those of the plant's inputs


class MappedSource(NamedTuple):
    """A source, checked against the network: its fields are known to be certain numbers of a node's measurement."""

    source: Source
    pattern: str  # its topic, which may have wildcards
    indices_by_node: dict[str, np.ndarray]  # for each of its values, (values,), the index in the node's measurement


def map_sources(topic: object, items: object, names: NamesByNode, time_counts_steps: bool) -> list[MappedSource]:
    """Return the sources of a topic, checked, with the indices of their values in each node's measurement.

    Args:
        topic: the topic, possibly with wildcards.
        items: a source, or a list of them.
        names: of the numbers of each node and of the inputs.
        time_counts_steps: whether the network counts steps.

    Raises:
        ValueError: a source that does not fit the network; one line that names the topic.
    """
    if not isinstance(topic, str) or not topic:
        raise fail("sources", "topics that are text", show_value(topic))
    sources = [items] if isinstance(items, Source) else items
    if not isinstance(sources, Sequence) or not all(isinstance(s, Source) for s in sources) or not sources:
        raise fail(f"sources, {topic!r}", "json_field, or a list of them", show_value(items))
    mapped = []
    for source in sources:
        _check_wildcards(topic, source)
        mapped.append(MappedSource(source, topic, _find_output_indices(topic, source, names)))
        # `of` raises ValueError if the topic lacks a level that a condition asks for; "#" may stand for any levels.
        if "#" not in topic:
            for condition in source.available:
                condition.of(topic)
        _check_time_unit(topic, source, time_counts_steps)
    return mapped


def _check_wildcards(topic: str, source: Source) -> None:
    """Raise ValueError if a topic with a wildcard has a source that says neither whose plant nor which node it is."""
    wildcards = [i for i, word in enumerate(topic.split("/")) if word in ("+", "#")]
    if wildcards and source.plant is None and isinstance(source.node, str):
        level = f"hg.files.Level({wildcards[0]})"
        remedy = f"plant={level}, node={level} or a field that names either"
        raise fail(f"sources, {topic!r}, plant", f"{remedy}, since a wildcard stands for several sensors", "neither")


def _check_time_unit(topic: str, source: Source, time_counts_steps: bool) -> None:
    """Raise ValueError if a source's times are steps and the network's are not, or the other way round.

    Times are steps if the source counts steps, or if it says how many seconds a step has. `time_counts_steps`: whether
    the network counts steps.
    """
    are_steps = source.step is not None or (source.time is not None and source.time_unit == "step")
    if time_counts_steps == are_steps:
        return
    expected = (
        "the seconds of a step (step=0.1), or a time field in steps (time=..., time_unit='step'), "
        "since the network counts steps: no input 'dt'"
        if time_counts_steps
        else "a time that is no step, since the network's time is continuous"
    )
    path = None if source.time is None else source.time.path
    got = f"{show_value(path)} in {source.time_unit}"
    raise fail(f"sources, {topic!r}, time", expected, got)


def _find_output_indices(topic: str, source: Source, names: NamesByNode) -> dict[str, np.ndarray]:
    """Return {node: index among its numbers of each value of a source, (values,)}.

    `names`: {node: names of its numbers}, "inputs" among the nodes.

    Raises:
        ValueError: an unknown node or output; one line that names the topic.
    """
    node = source.node
    if isinstance(node, str):
        if node not in names:
            raise fail(f"sources, {topic!r}, node", f"one of {', '.join(names)}", suggest_name(node, names))
        return {node: _index_outputs(topic, source, names[node])}
    # Messages name their node, which may be any that has these outputs.
    indices = {
        each: _index_outputs(topic, source, outputs)
        for each, outputs in names.items()
        if each != INPUTS and _has_outputs(outputs, source)
    }
    if not indices:
        got = show_value(source.outputs or len(source.paths))
        raise fail(f"sources, {topic!r}, output", "outputs of a node", got)
    return indices


def _has_outputs(outputs: tuple[str, ...], source: Source) -> bool:
    """Return whether these are the outputs of a source: those that it names, or as many as it has values."""
    return set(source.outputs) <= set(outputs) if source.outputs else len(outputs) == len(source.paths)


def _index_outputs(topic: str, source: Source, known: tuple[str, ...]) -> np.ndarray:
    """Return the index among the `known` outputs of a node for each path of a source.

    A source names the outputs of its paths, or has a path for each output of the node, in their order.
    """
    outputs = source.outputs or known
    if len(outputs) != len(source.paths):
        expected = f"{len(known)} paths, for {', '.join(known)}, or output="
        raise fail(f"sources, {topic!r}, path", expected, len(source.paths))
    for output in outputs:
        if output not in known:
            raise fail(f"sources, {topic!r}, output", f"one of {', '.join(known)}", suggest_name(output, known))
    return np.array([known.index(output) for output in outputs])


def suggest_name(name: str, names: Sequence[str] | Mapping[str, object]) -> str:
    """Return an unknown name with the closest known one in brackets, if any is close."""
    close = get_close_matches(name, list(names), 1)
    return f"{name!r}{f' (closest: {close[0]!r})' if close else ''}"
