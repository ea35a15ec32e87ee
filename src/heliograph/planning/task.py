"""What is asked of a design, in one object: so that it can be asked again of other budgets and of other networks."""

from dataclasses import dataclass, replace

from heliograph.numerics.readable import readable
from heliograph.planning.budget import Budget, as_budget
from heliograph.planning.criterion import Error
from heliograph.planning.network_design import design
from heliograph.planning.outcome import NetworkDesign
from heliograph.simulation.network import Network


@readable
@dataclass(frozen=True)
class Task:
    """The arguments of `design` but for the network."""

    free: tuple[str, ...] | None = None
    error: Error | None = None
    budget: Budget | float | None = None
    wanted: float | None = None
    starts: int = 64
    seed: int = 0

    def solve(self, network: Network) -> NetworkDesign:
        """The design of a network.

        Raises:
            ValueError: what `design` refuses.
        """
        return design(network, self.free, self.error, self.budget, self.wanted, self.starts, self.seed)

    def at(self, total: float) -> "Task":
        """The same with this total power, for the least error."""
        given = None if self.budget is None else as_budget(self.budget)
        limits = Budget(total) if given is None else Budget(total, given.each, given.peak)
        return replace(self, budget=limits, wanted=None)

    def also(self, name: str) -> "Task":
        """The same with one more node whose transmitters are free."""
        return self if self.free is None else replace(self, free=(*self.free, name))
