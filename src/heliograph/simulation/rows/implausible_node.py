"""Which node is to blame for an implausible row, where a central filter judges the values of all nodes together."""

from collections.abc import Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np

from heliograph.engine.choice import choose_code
from heliograph.filters.base import AbstractFilter
from heliograph.filters.plausibility import Judgement
from heliograph.numerics.float64 import quickly_compiled, to_numpy
from heliograph.numerics.types import Float, PyTree
from heliograph.simulation.runs.stacked_filters import filter_step, map_all


def blame_nodes_for_implausible_rows(
    filters: Mapping[str, AbstractFilter],
    before: Mapping[str, PyTree],
    z: Mapping[str, Float[np.ndarray, "steps m"]],
    u: Float[np.ndarray, "steps inputs"],
    why: Mapping[int, str],
    nodes: Sequence[str],
) -> dict[str, dict[int, str]]:
    """Give each row that all central filters find implausible to one of the nodes that have a value there.

    A row is blamed on a node without whose values the filters find it plausible; `Judgement.find_culprit` chooses.

    Args:
        filters: the central filters, which receive from all nodes.
        before: states of these filters before each row, with a leading axis of rows.
        z: measurements by node, in the order in which the filters receive them, NaN where one is missing.
        u: inputs by row.
        why: rows that are implausible, with the reason.
        nodes: nodes without a filter of their own that judges their values.

    Returns:
        The rows of each node that is to blame, with the reason.
    """
    # One trial for each implausible row and each node with a value in it: the row without the values of this node.
    removals = [_RowWithoutNode(k, name) for k in why for name in nodes if not np.isnan(z[name][k]).all()]
    rows = np.array([removal.row for removal in removals], dtype=int)
    without = {name: values[rows] for name, values in z.items()}
    for i, removal in enumerate(removals):
        without[removal.node][i] = np.nan
    # Whether the filters find the row plausible without the node: `votes` (removal, filter, field of a Judgement).
    votes = _judge_rows(filters, before, np.concatenate(list(without.values()), axis=1), u, rows)
    plausible = {removal: Judgement.why_values(vote) is None for removal, vote in zip(removals, votes, strict=True)}

    def find_largest(removal: _RowWithoutNode) -> float:
        """Return the largest size of the values removed."""
        return float(np.nanmax(np.abs(z[removal.node][removal.row])))

    refused = dict[str, dict[int, str]]()
    for k, reason in why.items():
        if candidates := [removal for removal in removals if removal.row == k]:
            culprit = Judgement.find_culprit(candidates, find_largest, plausible.__getitem__)
            refused.setdefault(culprit.node, {})[k] = reason
    return refused


class _RowWithoutNode(NamedTuple):
    """A row without the values of one node."""

    row: int
    node: str


def _judge_rows(
    filters: Mapping[str, AbstractFilter], before: Mapping[str, PyTree], z: np.ndarray, u: np.ndarray, rows: np.ndarray
) -> Float[np.ndarray, "row filter 4"]:
    """Return each filter's judgement whether the measurements of these rows are plausible, from its states before.

    The last axis holds the four fields of a `Judgement`. Native code computes it, or XLA if there is none.

    Args:
        filters: the filters by name.
        before: their states before each row of the recording, by name.
        z: measurements, one row for each entry of `rows`.
        u: inputs of all rows of the recording.
        rows: numbers of the rows to be judged, which may repeat.
    """
    judgements = []
    for name, filter in filters.items():
        states = jax.tree.map(lambda leaf: np.asarray(leaf)[rows], before[name])
        arguments = filter, states, z, u[rows], rows
        with jax.enable_x64(True):
            choice = choose_code(_judge_filter_step, arguments, differs_by_run=(False, True, True, True, True))
            results = _judge_by_xla(*arguments, len(rows)) if choice.code is None else choice.results()
            judgement = to_numpy(results)
        judgements.append(np.stack([np.broadcast_to(field, len(rows)) for field in judgement], axis=-1))
    return np.stack(judgements, axis=1)


def _judge_filter_step(filter: AbstractFilter, state: PyTree, z: jax.Array, u: jax.Array, k: jax.Array) -> Judgement:
    """Return a filter's judgement whether measurement z of step k is plausible, from its `state` before the step."""
    _, output = filter_step(filter, state, z, u, k, smooths=False, judges=True)
    assert output.judgement is not None  # since judges=True
    return output.judgement


@quickly_compiled
def _judge_by_xla(filter: AbstractFilter, state: PyTree, z: PyTree, u: PyTree, k: PyTree, count: int) -> PyTree:
    """Return a filter's judgements of `count` rows, arguments with a leading axis of these; compiled by XLA."""
    return map_all(lambda *row: _judge_filter_step(filter, *row), count)(state, z, u, k)
