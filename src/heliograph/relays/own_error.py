"""The greedy design: every relay and the receiver minimise their own next error."""

from heliograph.model.relays import RelayNetwork
from heliograph.numerics.check import instance
from heliograph.numerics.float64 import compiled
from heliograph.relays.design import RelayDesign, as_design, start_moments
from heliograph.relays.second_moments import propagate_own

_propagate_own = compiled(propagate_own)


def own_error_design(network: RelayNetwork, horizon: int) -> RelayDesign:
    """Design gains with which each filter minimises the trace of its own next error covariance, in one forward pass.

    K_f = E[e_f i_f'] E[i_f i_f']^-1, i_f the innovation. Optimal for one step only: a relay's gain also decides
    what the receiver can know later (see `receiver_error_design`).

    Raises:
        ValueError: a horizon beyond what varies over time; a singular innovation moment.
    Source: filter-and-forward successive relays (IEEE/CAA JAS 11(5), 2024), Theorems 1 and 2, for any network.
    """
    instance("relay network", network, RelayNetwork, "a RelayNetwork")
    return as_design(network, _propagate_own(network.steps(horizon), start_moments(network)))
