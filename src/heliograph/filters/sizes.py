"""Claim, names of states and inputs, and number of received components, of which a filter is made."""

from typing import Protocol, TypedDict

from heliograph.model.estimate import Claim


class FilterSizes(TypedDict):
    """Claim and sizes of a filter, as its class takes them."""

    claim: Claim
    states: tuple[str, ...]
    inputs: tuple[str, ...]
    received: int


class HasStates(Protocol):
    """A plant, a filter or a network, with the names of its states and inputs."""

    @property
    def states(self) -> tuple[str, ...]:
        """Names of the states."""

    @property
    def inputs(self) -> tuple[str, ...]:
        """Names of the inputs."""


def make_sizes(claim: Claim, like: HasStates, received: int) -> FilterSizes:
    """Return the keyword arguments that every filter class takes: its claim, names of states and inputs, length of z.

    Args:
        claim: what its covariance is said to be ("exact", "upper", "nominal", "none").
        like: plant or filter whose names of states and inputs are taken.
        received: length of the measurement z.
    """
    return FilterSizes(claim=claim, states=like.states, inputs=like.inputs, received=received)
