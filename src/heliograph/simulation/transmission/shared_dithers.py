"""Recorded dithers of senders of words: no two senders or components may share theirs."""

from collections.abc import Mapping

import numpy as np

from heliograph.model.words.word_channel import FLAG, find_carried_components
from heliograph.numerics.check import fail
from heliograph.numerics.types import Float
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node

FEWEST = 3  # rows in which two dithers are equal by no chance


def refuse_shared_dithers(network: Network, z: Mapping[str, Float[np.ndarray, "steps received"]]) -> None:
    """Raise ValueError where two senders or components of a recording have the same dithers: their errors are common.

    Args:
        network: the network.
        z: measurements of each node.
    """
    seen = dict[bytes, str]()
    for name, node in network.nodes.items():
        if not isinstance(node, Node) or node.encoder is None or not node.encoder.subtracts:
            continue
        indices = [place for place in find_carried_components(node.channel) if place != FLAG]
        for component in dict.fromkeys(indices):  # copies of a word have one dither
            # Dithers stand at the end of what is received.
            drawn = z[name][:, node.received - len(indices) + indices.index(component)]
            dithers, sender = drawn[~np.isnan(drawn)], f"{name}.{node.outputs[component]}"
            if len(dithers) >= FEWEST and seen.setdefault(dithers.tobytes(), sender) != sender:
                first_sender = seen[dithers.tobytes()]
                expected = f"others than those of {first_sender}, as encoder.dithers(node, numbers) draws"
                raise fail(f"dithers of {sender}", expected, "the same")
