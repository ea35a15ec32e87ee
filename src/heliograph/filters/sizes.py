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
    """Return claim, and the sizes of a filter of the states and inputs of a plant, which receives so many numbers."""
    return FilterSizes(claim=claim, states=like.states, inputs=like.inputs, received=received)
