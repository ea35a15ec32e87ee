"""Identity of a saved state: it may only continue where everything is computed as before."""

from collections.abc import Mapping
from hashlib import sha256

import jax
import numpy as np

import heliograph
from heliograph.numerics.check import fail
from heliograph.numerics.types import PyTree
from heliograph.simulation.network import Network

Identity = dict[str, str]
DIGITS = 16


def versions() -> Identity:
    """Return the versions of this package and of JAX."""
    return {"heliograph": heliograph.__version__, "jax": jax.__version__}


def network_identity(network: Network, program: str, options: Mapping[str, object]) -> Identity:
    """Return versions, precision, options, names, sizes, hashes of each part's numbers, and a hash of the program."""
    parts: dict[str, PyTree] = {f"node {name!r}": node for name, node in network.nodes.items()}
    parts |= {f"fusion {name!r}": item for name, item in (network.fused | network.meshes).items()}
    filters = [f"{node}/{name}" for node, claims in network.claims().items() for name in claims]
    return {
        **versions(),
        "precision": "single" if network.single else "double",
        "states": ", ".join(network.states),
        "inputs": ", ".join(network.inputs),
        "nodes": ", ".join(f"{name} ({node.received} received)" for name, node in network.nodes.items()),
        "filters": ", ".join(filters),
        **{f"option {name}": f"{value!r}" for name, value in options.items()},
        "numbers of the plant": short_name(network.plant),
        **{f"numbers of {name}": short_name(part) for name, part in parts.items()},
        "what is computed": short_name(program),
    }


def check_same(what: str, mine: Mapping[str, str], other: Mapping[str, str]) -> None:
    """Refuse a saved state of something else, and name the difference."""
    names = [name for name in {**mine, **other} if mine.get(name) != other.get(name)]
    if names:
        here = "; ".join(f"{name}: {mine.get(name, 'none')}" for name in names)
        there = "; ".join(f"{name}: {other.get(name, 'none')}" for name in names)
        raise fail(what, f"the state of what is here ({here})", f"one that differs ({there})")


def short_name(part: PyTree) -> str:
    """Hash all numbers in a part, or a text."""
    if isinstance(part, str):
        return sha256(part.encode()).hexdigest()[:DIGITS]
    result = sha256()
    for leaf in jax.tree.leaves(part):
        if isinstance(leaf, jax.Array | np.ndarray | np.generic | int | float):
            array = np.asarray(leaf)
            result.update(f"{array.shape}{array.dtype}".encode() + array.tobytes())
    return result.hexdigest()[:DIGITS]
