"""What a network is to whoever kept its state: a state goes on only where everything computes as it did."""

from heliograph.live.identity import Identity, short_name, versions
from heliograph.numerics.types import PyTree
from heliograph.serving.fleet import Fleet


def identity(fleet: Fleet) -> Identity:
    """Versions, precision, options, names and sizes; of each part of the network its numbers; and of what is computed.

    What is computed is read off the compiler's input: a function of the plant counts by what it does.
    """
    network, lanes = fleet.network, fleet.lanes
    parts: dict[str, PyTree] = {f"node {name!r}": node for name, node in network.nodes.items()}
    parts |= {f"fusion {name!r}": item for name, item in network.fused.items()}
    return {
        **versions(),
        "precision": "single" if network.single else "double",
        "states": ", ".join(network.states),
        "inputs": ", ".join(network.inputs),
        "nodes": ", ".join(f"{name} ({node.received} heard)" for name, node in network.nodes.items()),
        "filters": ", ".join(f"{place.node}/{place.filter}" for place in lanes.places),
        **{f"option {name}": f"{value!r}" for name, value in fleet.options._asdict().items()},
        "numbers of the plant": short_name(network.plant),
        **{f"numbers of {name}": short_name(part) for name, part in parts.items()},
        "what is computed": short_name(lanes.program()),
    }
