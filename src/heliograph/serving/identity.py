"""What a network is to a store: a state goes on only where everything computes as it did."""

from heliograph.live.identity import Identity, network_identity
from heliograph.serving.fleet import Fleet


def identity(fleet: Fleet) -> Identity:
    """That of the network and of the fleet's options."""
    return network_identity(fleet.network, fleet.lanes.program(), fleet.options._asdict())
