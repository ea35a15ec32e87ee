"""Steps of many plants of one network, and where the outputs of a step stand in a row."""

from functools import partial
from typing import NamedTuple

import jax
import numpy as np

from heliograph.live.player import player
from heliograph.model.estimate import Claim
from heliograph.numerics.check import fail, instance
from heliograph.numerics.types import PyTree
from heliograph.simulation.network import FUSED, Network
from heliograph.simulation.results.by_name import by_name


class JudgementAt(NamedTuple):
    """Columns of the parts of a judgement."""

    distance: int
    arrived: int
    reason: int
    input: int


class WeighedAt(NamedTuple):
    """Columns of what a filter that weighs made of each of its components."""

    value: tuple[int, ...]
    variance: tuple[int, ...]
    weight: tuple[int, ...]


class TestedAt(NamedTuple):
    """Columns of a fused estimate's squared innovation, and of how many numbers arrived."""

    distance: int
    arrived: int


class Place(NamedTuple):
    """Columns of a filter's estimate among the outputs: first of its mean, first of its covariance, and its judgement.

    `judgement` is None for a fusion rule, which receives no measurement; `tested` has its squared innovation by what
    its nodes receive, and is None for all others. `weighed` is None of a filter that weighs nothing.
    """

    node: str
    filter: str
    claim: Claim
    mean: int
    covariance: int
    judgement: JudgementAt | None
    weighed: WeighedAt | None
    tested: TestedAt | None


class Lanes:
    """A network's step as a function of rows: (state, received, inputs, step number) to (state, outputs).

    The outputs are the leaves of the estimates and each filter's judgement of what it received; `places` gives their
    columns. A filter leaves out the measurements that it finds implausible. Plants come and go without compilation, and
    no bit of an estimate depends on which other rows are stepped in the same call.

    Args:
        network: the network, with at least one filter.

    Raises:
        ValueError: no network, or one without filters.
    """

    def __init__(self, network: Network):
        instance("network", network, Network, "a Network")
        if not any(network.claims().values()):
            raise fail("network", "at least one filter to run", "none")
        self.network, self.player = network, player(network)
        self.dt, self.received, self.given = self.player.dt, self.player.received, self.player.given
        self.places = self._places()

    def _places(self) -> tuple[Place, ...]:
        """Locate each filter's estimate, by reading a row that holds its own column numbers as a row of estimates."""
        outputs = self.player.step_rows.outputs
        result = jax.tree.map(lambda leaf: leaf.astype(int), outputs.tree(np.arange(float(outputs.size))))
        mean = by_name(self.network, result, lambda part: np.asarray(part.mean), -3)
        covariance = by_name(self.network, result, lambda part: np.asarray(part.covariance), -4)
        judged, weighed = self._judged(result), self._weighed(result)
        tested = {(FUSED, name): TestedAt(*map(int, item)) for name, item in result["tested"].items()}
        return tuple(
            Place(node, name, claim, int(mean[node][name].flat[0]), int(covariance[node][name].flat[0]),
                  judged[node].get(name), weighed.get((node, name)), tested.get((node, name)))
            for node, filters in self.network.claims().items()
            for name, claim in filters.items()
        )  # fmt: skip

    def _weighed(self, outcome: PyTree) -> dict[tuple[str, str], WeighedAt]:
        """Return the columns of what each filter that weighs made of its components, by node and filter."""
        parts = {
            place: [np.asarray(part)[f, i] for part in outcome["weighed"][kind]]
            for place, (kind, f, i) in self.network.places().items()
            if outcome["weighed"][kind] is not None
        }
        central = {(FUSED, name): list(item) for name, item in outcome["weighed_centrally"].items() if item is not None}
        return {
            place: WeighedAt(*(tuple(map(int, column)) for column in columns))
            for place, columns in (parts | central).items()
        }

    def _judged(self, outcome: PyTree) -> dict[str, dict[str, JudgementAt]]:
        """Return the columns of each part of a judgement, by node and filter."""
        local = {"estimates": outcome["judged"], "fused": {}}
        parts = [by_name(self.network, local, partial(_part, i), -2) for i in range(len(JudgementAt._fields))]
        result = {
            node: {name: JudgementAt(*(int(part[node][name]) for part in parts)) for name in filters}
            for node, filters in parts[0].items()
        }
        central = outcome["judged_centrally"]
        return result | {FUSED: {name: JudgementAt(*(int(part) for part in item)) for name, item in central.items()}}


def _part(i: int, judged: PyTree) -> np.ndarray:
    return np.asarray(judged[i])
