"""What a design gives."""

import numpy as np

from heliograph.numerics.module import Module
from heliograph.numerics.readable import readable
from heliograph.numerics.types import Float
from heliograph.planning.certificate import Certificate
from heliograph.planning.criterion import Error
from heliograph.planning.designed import designed_network
from heliograph.simulation.network import Network


@readable
class NetworkDesign(Module):
    """Powers that were found, what they give, and how good they are.

    powers: of every transmitter, {name: (steps,)}, steps of the error's period or horizon (one if steady). error: what
    they give; present: what the network gives as it is; covariance: P after each step. sensitivity: the error's
    derivative by the mean power of each transmitter; price: the error that one more watt of the budget takes away. Of
    free numbers both come from Lagrange's multipliers: zero where no limit of power holds the error up.
    given, asked: the network and the error that the design is of. numbers: the free numbers of a network that is a
    function of them.
    """

    powers: dict[str, Float[np.ndarray, "steps"]]
    error: float
    present: float
    covariance: Float[np.ndarray, "steps n n"]
    sensitivity: dict[str, float]
    price: float
    certificate: Certificate
    given: Network
    asked: Error
    numbers: dict[str, np.ndarray]

    @property
    def network(self) -> Network:
        """The design as a network that runs: every node with the filter "best", and "best" of all that they receive.

        Where it is a function of free numbers, what this returns for them. A period is gone through again and again,
        for about 100 steps.
        """
        return self.given if self.numbers else designed_network(self.given, self.powers, self.asked)

    @property
    def total(self) -> float:
        """Mean power of all transmitters together."""
        return float(sum(np.mean(power) for power in self.powers.values()))
