"""Snapshots: arrays in NumPy's own format under a head of JSON, and the identity of what they go on with."""

import json
from collections.abc import Mapping, Sequence
from io import BytesIO
from typing import Any
from zipfile import BadZipFile

import jax
import numpy as np

import heliograph
from heliograph.numerics.check import fail, show_value
from heliograph.numerics.trees.program_text import hash_numbers
from heliograph.numerics.types import PyTree
from heliograph.simulation.network import Network

Identity = dict[str, str]


def list_versions() -> Identity:
    """Return the versions of this package and of JAX."""
    return {"heliograph": heliograph.__version__, "jax": jax.__version__}


def network_identity(network: Network, program: str, options: Mapping[str, object]) -> Identity:
    """Return all by which a stored state is recognised as one of this network.

    These are versions, precision, options, names, sizes, a hash of the numbers of each part, and one of the program.
    """
    parts: dict[str, PyTree] = {f"node {name!r}": node for name, node in network.nodes.items()}
    parts |= {f"fusion {name!r}": fusion for name, fusion in (network.fused | network.meshes).items()}
    filters = [f"{node}/{name}" for node, claims in network.claims().items() for name in claims]
    return {
        **list_versions(),
        "precision": "double",
        "states": ", ".join(network.states),
        "inputs": ", ".join(network.inputs),
        "nodes": ", ".join(f"{name} ({node.received} received)" for name, node in network.nodes.items()),
        "filters": ", ".join(filters),
        **{f"option {name}": f"{value!r}" for name, value in options.items()},
        "numbers of the plant": hash_numbers(network.plant),
        **{f"numbers of {name}": hash_numbers(tree) for name, tree in parts.items()},
        "what is computed": hash_numbers(program),
    }


def check_same_network(
    what: str, mine: Mapping[str, str], other: Mapping[str, str], kept: Sequence[str] = (), accept: bool = False
) -> None:
    """Raise ValueError, which names the differences, if the state of `other` is not one of `mine`.

    Args:
        what: name of the state.
        mine: identity of what is here.
        other: identity of what was saved.
        kept: names of entries that have to be the same even if changes are accepted.
        accept: whether changes of other entries are accepted. If they are not but would suffice, the error advises it.
    """
    differing = [name for name in {**mine, **other} if mine.get(name) != other.get(name)]
    may_be_accepted = not any(name in kept for name in differing)
    if differing and not (accept and may_be_accepted):
        mine_in_words = "; ".join(f"{name}: {mine.get(name, 'none')}" for name in differing)
        other_in_words = "; ".join(f"{name}: {other.get(name, 'none')}" for name in differing)
        advice = "; accept_changes=True goes on with what fits" if kept and may_be_accepted else ""
        found = f"one that differs ({other_in_words}){advice}"
        raise fail(what, f"the state of what is here ({mine_in_words})", found)


HEAD = "head"


def pack_snapshot(head: Mapping[str, object], arrays: Mapping[str, np.ndarray]) -> bytes:
    """Return a head and arrays as the bytes of an NPZ file; the head is JSON, stored as the array HEAD."""
    file = BytesIO()
    json_bytes = np.frombuffer(json.dumps(head).encode(), dtype=np.uint8)
    np.savez(file, allow_pickle=False, **{HEAD: json_bytes, **arrays})
    return file.getvalue()


def unpack_snapshot(data: bytes) -> tuple[dict[str, Any], dict[str, np.ndarray]]:
    """Return the head and the arrays, by name, of what `pack_snapshot` wrote; raise ValueError for other bytes."""
    try:
        with np.load(BytesIO(data), allow_pickle=False) as file:
            arrays = {name: file[name] for name in file.files}
        return json.loads(arrays.pop(HEAD).tobytes()), arrays
    except (BadZipFile, ValueError, KeyError, OSError, EOFError, TypeError):
        raise fail("snapshot", "what save returned", show_value(data)) from None
