"""What changed between the network whose state is stored and the one that runs, in words."""

import json
from collections.abc import Mapping

import numpy as np

from heliograph.live.stored.snapshot import Identity

DESCRIPTION = "description"  # key of an identity: its numbers and the layout of its rows, as JSON
LISTED = 4  # entries of an array that are named
SAME = ("precision", "states", "inputs")  # what the rows of a plant mean


def list_changes(mine: Identity, other: Identity) -> list[str]:
    """Return a line for each thing that has changed from the identity `other` to `mine`.

    `other` describes the network by which a state was stored, `mine` the present one: options, versions, nodes and
    filters, numbers of the parts. A change of functions is listed only where nothing else has changed.
    """
    # Entries whose values are no words for a user: JSON, and hashes.
    not_words = (DESCRIPTION, "what is computed", "layout of the store")
    # First the entries that are words, shown as they stand: options, versions, nodes, filters.
    lines = [
        f"{name}: {other.get(name, 'none')} -> {mine.get(name, 'none')}"
        for name in {**mine, **other}
        if mine.get(name) != other.get(name) and not name.startswith("numbers of ") and name not in not_words
    ]
    # Numbers of the parts (plant, nodes, fusions) that are in both networks.
    here, there = (json.loads(identity[DESCRIPTION])["values"] for identity in (mine, other))
    same_version = mine.get("heliograph") == other.get("heliograph")
    for name in here:
        if name in there:
            lines += _list_changed_numbers(name, there[name], here[name], same_version)
            # A long array (more than MOST numbers) is known only by a hash.
            if not lines and mine.get(f"numbers of {name}") != other.get(f"numbers of {name}"):
                lines.append(f"{name}: numbers of a long array")
    # Of a function only the program that it is compiled to is known, which other changes change too: it is named where
    # there is none of these.
    if not lines and mine.get("what is computed") != other.get("what is computed"):
        lines.append("functions of the network")
    return lines


def _list_changed_numbers(
    name: str, before: Mapping[str, object], after: Mapping[str, object], same_version: bool
) -> list[str]:
    """Return a line for each number of the part `name` of a network that has changed.

    `before` and `after` are {path of an attribute: its numbers}. A path in only one of two versions is passed over.
    """
    return [
        f"{name}{path}: {line}"
        for path in {**before, **after}
        if not path.endswith(".factor")  # the factor of a covariance that is also there
        and (same_version or (path in before and path in after))
        for line in _describe_changes(before.get(path), after.get(path))
    ]


def _describe_changes(before: object, after: object) -> list[str]:
    """Return lines on the change of a number or array, entry by entry if the shape is the same; [] if it is equal."""
    if before == after:
        return []
    try:
        a, b = np.asarray(before, dtype=float), np.asarray(after, dtype=float)
    except (TypeError, ValueError):
        return [f"{before} -> {after}"]
    if a.shape != b.shape or before is None or after is None:
        return [" -> ".join("none" if side is None else f"{side}" for side in (before, after))]
    indices = [tuple(map(int, index)) for index in np.argwhere(a != b)]
    lines = [f"{list(index) if a.size > 1 else ''} {a[index]:.6g} -> {b[index]:.6g}".strip() for index in indices]
    return [*lines[:LISTED], f"and {len(lines) - LISTED} more of its numbers"] if len(lines) > LISTED else lines
