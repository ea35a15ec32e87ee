"""Networks with free numbers: a function that returns one, built again with other numbers where some are free."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from inspect import signature

import jax
import numpy as np

from heliograph.learning.free_marks import Asking, Build, Given, reading
from heliograph.learning.parameters import Parameters, plain_number
from heliograph.numerics.check import fail, function, instance, shown_error
from heliograph.numerics.module import readable
from heliograph.numerics.types import Float
from heliograph.simulation.network import Network


@readable
@dataclass(frozen=True)
class Description:
    """Network with free numbers, as the function that builds it and the numbers that are free in it.

    Args:
        build: the function, without arguments, that returns the network.
        parameters: the free numbers in the order in which the network uses them.
        named: which of their names the user gave.
    """

    build: Build
    parameters: Parameters
    named: tuple[bool, ...]

    def at(self, values: Mapping[str, object]) -> Network:
        """Build the network with these values, {name: value}.

        Raises:
            ValueError: operations on a free number that derivatives cannot pass, a function that returns no network.
        """
        with reading(Given(self.parameters, self.named, values)), jax.enable_x64(True):
            try:
                return checked(self.build())
            except (jax.errors.ConcretizationTypeError, jax.errors.TracerArrayConversionError) as error:
                expected = "free numbers that only jax.numpy computes with, so that derivatives pass"
                got = f"one that is read: {shown_error(error)}"
                raise fail("network to be learned", expected, got) from error

    @cached_property
    def start(self) -> Network:
        """Network with every free number at its start."""
        return self.at({item.name: plain_number(item.start) for item in self.parameters.every})

    def at_point(self, x: Float[np.ndarray, " p"]) -> Network:
        """Network at a point (p,) of the line, of plain numbers."""
        return self.at(self.parameters.known(x))


def describe(network: Build) -> Description:
    """Find what is free in the network that a function returns.

    Args:
        network: a function without arguments that returns a Network, with `hg.free(...)` in place of numbers.

    Raises:
        ValueError: no function, one that returns no network, or nothing free.
    """
    if isinstance(network, Network):
        expected = "a function that returns it with hg.free(...) in it, so that it can be built with other numbers"
        raise fail("network to be learned", expected, "a Network")
    function("network to be learned", network, "nothing that returns a Network")
    try:
        signature(network).bind()
    except (TypeError, ValueError) as error:
        raise fail("network to be learned", "a function without arguments", str(error)) from None
    asking = Asking()
    with reading(asking), jax.enable_x64(True):
        checked(network())
    if not asking.marks:
        raise fail("network to be learned", "at least one number marked by hg.free(start)", "none")
    parameters = asking.parameters()
    return Description(network, parameters, tuple(mark.given is not None for mark in asking.marks))


def checked(network: object) -> Network:
    """Check that a function returned a network, and return it."""
    return instance("network to be learned", network, Network, "a function that returns a Network")
