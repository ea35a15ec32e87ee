"""What a network is to a store: a state goes on only where everything computes as it did."""

from heliograph.live.identity import Identity, network_identity
from heliograph.numerics.check import instance
from heliograph.serving.fleet import Fleet


def identity(fleet: Fleet) -> Identity:
    """What a store has to be of, to go on with this fleet: its network, its compiled program and its options."""
    instance("fleet", fleet, Fleet, "a Fleet")
    return network_identity(fleet.network, fleet.lanes.program(), fleet.options._asdict())
