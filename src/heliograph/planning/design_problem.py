"""The design problem and its result: powers (or other numbers) for a small error, with a certificate."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any, NamedTuple, TypeAlias

import numpy as np

from heliograph.model.relays import RelayNetwork
from heliograph.numerics.check import fail
from heliograph.numerics.module import Module, readable
from heliograph.numerics.types import ArrayLike, Float
from heliograph.planning.error_objective import Error
from heliograph.planning.free_numbers.problem import Build
from heliograph.planning.multihop_paths.model import Paths
from heliograph.planning.network_from_design import designed_network
from heliograph.planning.power_budget import Budget, make_budget
from heliograph.simulation.network import Network

if TYPE_CHECKING:
    Designable: TypeAlias = "Network | RelayNetwork | Paths | Build | DesignProblem"
    Free: TypeAlias = Sequence[str] | Mapping[str, object]
    BudgetLike: TypeAlias = Budget | ArrayLike
else:  # judged by `hg.design`, in one clear line
    Designable = Free = BudgetLike = Any


@readable
@dataclass(frozen=True)
class DesignProblem:
    """Design problem: least error within a budget, or least power for a target error. `hg.design(problem)` solves it.

    Args:
        network: a network, a network of relays that filter, independent paths, or a function of free numbers.
        free: what may change, see `hg.design`.
        error: the error that is to be small.
        budget: limits of the powers, or the total mean power.
        target_error: an error that is to be reached with the least power.
        starts: descents, where the problem is not convex.
        seed: of the starts that are drawn.
    """

    network: Designable
    free: Free | None = None
    error: Error | None = None
    budget: BudgetLike | None = None
    target_error: ArrayLike | None = None
    starts: int = 64
    seed: int = 0

    @property
    def criterion(self) -> Error:
        """Error, the steady trace unless given."""
        return Error() if self.error is None else self.error

    def replace_total(self, total: float) -> "DesignProblem":
        """Return the problem of least error with this total power and the other limits of the budget.

        Args:
            total: largest mean power of all transmitters together.
        """
        limits = None if self.budget is None else make_budget(self.budget)
        budget = Budget(total) if limits is None else Budget(total, limits.per_transmitter, limits.peak)
        return replace(self, budget=budget, target_error=None)


@readable
class Certificate(NamedTuple):
    """Certificate of a design: what is known of the best that its limits allow.

    Args:
        convex: whether every local minimum is global.
        value: the error found, or the power where an error is the target.
        bound: no design has less, whatever was searched.
        stationarity: the part of the value by which a linear model still sees it fall within the limits; zero if and
            only if the conditions of Karush, Kuhn and Tucker hold (of free numbers: over a step of the size of their
            range, or of their start where they have none). NaN where it is not known.
        starts: number of descents.
        unit: "error" or "power".
    """

    convex: bool
    value: float
    bound: float
    stationarity: float
    starts: int
    unit: str

    @property
    def gap(self) -> float:
        """Difference of the value and its bound: no more can be gained."""
        return max(self.value - self.bound, 0.0)

    @property
    def words(self) -> str:
        """Sentence on what the numbers certify: how near the value is to the best, and what was searched."""
        if self.convex:
            return f"optimal within {self.gap:.1e}: the problem is convex, and no {self.unit} is below {self.bound:.6g}"
        starts = "the one start" if self.starts == 1 else f"{self.starts} starts"
        known = "" if np.isnan(self.stationarity) else f", stationary within {self.stationarity:.1e}"
        if not np.isfinite(self.bound):
            return f"best of {starts}{known}; no bound is known"
        better = "better" if self.unit == "error" else "less"
        return f"best of {starts}{known}; nothing can be {better} than {self.bound:.6g}"


@readable
class PowerDesign(Module):
    """Design of a network: powers of its transmitters, the error they attain, and a certificate.

    Of free numbers, sensitivity and price come from Lagrange's multipliers: zero where no limit of power binds.

    Args:
        problem: what was to be designed.
        powers: of every transmitter, {name: (steps,)}, steps of the error's period or horizon (one if steady).
        error: the error attained.
        certificate: what is known of the best that the limits allow.
        present: the error of the network as it is (NaN of independent paths, which have no powers yet).
        covariance: P after each step, (steps, n, n).
        sensitivity: the error's derivative by the mean power of each transmitter.
        price: the error that one more watt of the total takes away, sent where no other limit binds; without a total,
            one more of the transmitter that it helps most, whose own limit rises.
        numbers: the free numbers of a network that is a function of them.
        realised: the network at these numbers, None where powers alone were designed.
    """

    problem: "DesignProblem"
    powers: "dict[str, Float[np.ndarray, 'steps']]"
    error: float
    certificate: "Certificate"
    present: float
    covariance: "Float[np.ndarray, 'steps n n']"
    sensitivity: dict[str, float]
    price: float
    numbers: dict[str, np.ndarray]
    realised: "Network | None"

    @property
    def bound(self) -> float:
        """Bound of the certificate: no design has less error (or power, where an error is the target)."""
        return self.certificate.bound

    @property
    def network(self) -> Network:
        """Design as a network that runs: each node has a filter "best", and so has the centre of all nodes.

        A design of free numbers is the network that their function returns (`self.realised`, None for a design of
        powers). A period is repeated for about 100 steps.

        Raises:
            ValueError: a design of independent paths, which belong to no network.
        """
        if self.realised is not None:
            return self.realised
        if not isinstance(self.problem.network, Network):
            raise fail("network of a design", "a design of a Network", "one of independent paths")
        return designed_network(self.problem.network, self.powers, self.problem.criterion)

    @property
    def total(self) -> float:
        """Mean power of all transmitters together."""
        return float(sum(np.mean(power) for power in self.powers.values()))
