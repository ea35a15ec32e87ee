"""Which column of a network's outputs holds what: each filter's estimate, and its judgement of what it received."""

from functools import partial
from operator import attrgetter
from typing import NamedTuple

import jax
import numpy as np

from heliograph.model.estimate import Claim
from heliograph.numerics.module import readable
from heliograph.numerics.trees.flattened_trees import FlatLayout
from heliograph.numerics.types import Float, PyTree
from heliograph.simulation.network import FUSED, Network
from heliograph.simulation.results.results_by_name import collect_mode_probabilities, split_by_name


class JudgementColumns(NamedTuple):
    """Columns of the parts of a judgement."""

    distance: int
    arrived: int
    reason: int
    input: int


class WeighingColumns(NamedTuple):
    """Columns of what a filter that weighs made of each of its components."""

    value: tuple[int, ...]
    variance: tuple[int, ...]
    weight: tuple[int, ...]


class TestColumns(NamedTuple):
    """Columns of a fused estimate's squared innovation, and of how many numbers arrived."""

    distance: int
    arrived: int


@readable
class FilterColumns(NamedTuple):
    """Columns of a filter's estimate among the outputs: first of its mean, first of its covariance, and its judgement.

    Args:
        node: name of the node; `Network.FUSED` of what is fused.
        filter: name of the filter or fusion.
        claim: of its estimate.
        mean: first column of the mean; the others follow it.
        covariance: first column of the covariance, row by row.
        judgement: columns of the filter's `Judgement`; None for a fusion rule, which receives no measurement.
        weighed: columns of its `Weighed`; None of a filter that weighs nothing.
        tested: columns of a fusion's squared innovation by what its nodes receive, and of how many numbers these were;
            None for all others.
        modes: first column of the modes' probabilities, and that after the last; None of a filter that weighs none.
    """

    node: str
    filter: str
    claim: Claim
    mean: int
    covariance: int
    judgement: "JudgementColumns | None"
    weighed: "WeighingColumns | None"
    tested: "TestColumns | None"
    modes: tuple[int, int] | None = None

    def probabilities(self, outputs: Float[np.ndarray, "... outputs"]) -> Float[np.ndarray, "... M"] | None:
        """Return the modes' probabilities among outputs; None of a filter that weighs no modes."""
        return None if self.modes is None else outputs[..., self.modes[0] : self.modes[1]]


def find_filter_columns(network: Network, outputs: FlatLayout) -> tuple[FilterColumns, ...]:
    """Return for each filter the columns of its mean, covariance and other outputs in a row of all outputs.

    `outputs` is the layout of a row: which output lies where. The columns are found from a row 0, 1, 2, ...: if it is
    taken apart by node and filter like any row of outputs, each entry is the number of its own column.
    """
    numbered = jax.tree.map(lambda leaf: leaf.astype(int), outputs.tree(np.arange(float(outputs.size))))
    # The axis of filters is the third from last of means (filter, node, n), the fourth of covariances.
    mean = split_by_name(network, numbered, attrgetter("mean"), axis=-3)
    covariance = split_by_name(network, numbered, attrgetter("covariance"), axis=-4)
    # Columns of judgements, of weighed innovations, of mode probabilities (first, last + 1), and of a centre's tests.
    judged, weighed = _collect_judgements(network, numbered), _collect_weights(network, numbered)
    modes = {
        name: (int(columns[0]), int(columns[-1]) + 1)
        for name, columns in collect_mode_probabilities(network, numbered).items()
    }
    tested = {(FUSED, name): TestColumns(*map(int, columns)) for name, columns in numbered["tested"].items()}
    return tuple(
        FilterColumns(
            node=node,
            filter=name,
            claim=claim,
            mean=int(mean[node][name].flat[0]),
            covariance=int(covariance[node][name].flat[0]),
            judgement=judged[node].get(name),
            weighed=weighed.get((node, name)),
            tested=tested.get((node, name)),
            modes=modes.get((node, name)),
        )
        for node, filters in network.claims().items()
        for name, claim in filters.items()
    )


def _collect_weights(network: Network, outcome: PyTree) -> dict[tuple[str, str], WeighingColumns]:
    """Return by (node, filter) in which columns of a row a filter's weights of its received components stand.

    Filters that weigh tell of each component its innovation, the variance of this and the weight that it got. Central
    filters have FUSED in place of a node.

    `outcome`: the outputs of a step as a tree that has the number of its column in place of each value. It is stacked
    by stack of filters and then (filter, node), with None for stacks that do not weigh.
    """
    weights = {}
    for name, index in network.estimate_indices.items():
        of_stack = outcome["weighed"][index.stack]
        if of_stack is not None:
            value, variance, weight = (np.asarray(field)[index.filter, index.node] for field in of_stack)
            weights[name] = _make_weighing_columns(value, variance, weight)
    for central_name, columns in outcome["weighed_centrally"].items():
        if columns is not None:
            weights[FUSED, central_name] = _make_weighing_columns(*columns)
    return weights


def _make_weighing_columns(value: np.ndarray, variance: np.ndarray, weight: np.ndarray) -> WeighingColumns:
    """Return the columns of each component's innovation, its variance and its weight, as whole numbers."""
    return WeighingColumns(
        value=tuple(map(int, value)), variance=tuple(map(int, variance)), weight=tuple(map(int, weight))
    )


def _collect_judgements(network: Network, outcome: PyTree) -> dict[str, dict[str, JudgementColumns]]:
    """Return, by node and filter, the columns in a row of outputs that hold the fields of a filter's judgement.

    `outcome`: the outputs of a step with the number of its column in place of each value. Central filters have the node
    FUSED.
    """
    judged = {"estimates": outcome["judged"], "fused": {}}
    # Each field of the judgements, distance, arrived, reason and input, by node and filter. A stack of filters has
    # fields (..., filter, node).
    fields = range(len(JudgementColumns._fields))
    distance, arrived, reason, input = (
        split_by_name(network, judged, partial(_read_field, i), axis=-2) for i in fields
    )
    by_node: dict[str, dict[str, JudgementColumns]] = {}
    for node, filters in distance.items():
        by_node[node] = {
            name: JudgementColumns(
                distance=int(distance[node][name]),
                arrived=int(arrived[node][name]),
                reason=int(reason[node][name]),
                input=int(input[node][name]),
            )
            for name in filters
        }
    central = outcome["judged_centrally"]
    fused = {name: JudgementColumns(*map(int, columns)) for name, columns in central.items()}
    return by_node | {FUSED: fused}


def _read_field(i: int, judged: PyTree) -> np.ndarray:
    """Return field i of a judgement: 0 distance, 1 arrived, 2 reason, 3 input."""
    return np.asarray(judged[i])
