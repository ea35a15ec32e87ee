"""Identity of a network for a store: a stored state may only continue where everything is computed as before."""

from heliograph.live.identity import Identity, network_identity
from heliograph.numerics.check import instance
from heliograph.serving.fleet import Fleet


def identity(fleet: Fleet) -> Identity:
    """Return what a store must agree with to continue this fleet: its network, compiled program and options.

    Args:
        fleet: the fleet whose plants the store keeps.
    """
    instance("fleet", fleet, Fleet, "a Fleet")
    return network_identity(fleet.network, fleet.lanes.program(), fleet.options._asdict())
