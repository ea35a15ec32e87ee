"""Steps of all filters without implausible data, messages about them, and values that a sender's rule forbids."""

from collections.abc import Callable, Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.filters.plausibility import INPUT, Judgement
from heliograph.model.checks.non_finite_results import describe_non_finite_function
from heliograph.numerics.types import Float, PyTree
from heliograph.simulation.centres.uplinks import UplinkDraws
from heliograph.simulation.network import FUSED, Network
from heliograph.simulation.network_filters import AllFilters
from heliograph.simulation.network_index import EstimateIndex
from heliograph.simulation.recordings.screened_recording import say_taken_for_silence

Stepped = tuple[PyTree, dict[str, PyTree]]  # the filters' states after a step, and their results


def is_implausible(outputs: Mapping[str, PyTree]) -> jax.Array:
    """Return, within a program, whether some filter judges its measurement implausible.

    `outputs`: of a step, with the filters' judgements "judged" by stack of filters, and "judged_centrally" by name.
    """
    judgements = [*outputs["judged"], *outputs["judged_centrally"].values()]
    flags = [jnp.any(judgement.implausible) for judgement in judgements]
    return jnp.any(jnp.stack(flags)) if flags else jnp.asarray(False)


def any_implausible(outputs: Mapping[str, PyTree]) -> bool:
    """Return whether some filter judged a measurement implausible, in stored `outputs` of many rows (NumPy arrays)."""
    judgements = [*outputs["judged"], *outputs["judged_centrally"].values()]
    return any((judgement.reason > 0).any() for judgement in judgements)


def read_refusal_reasons(outputs: Mapping[str, PyTree]) -> tuple[list[jax.Array], dict[str, jax.Array]]:
    """Return each filter's reason to pass over its data, 0 for none: by stack, and by name of central filters."""
    by_stack = [judgement.reason for judgement in outputs["judged"]]
    return by_stack, {name: judgement.reason for name, judgement in outputs["judged_centrally"].items()}


# Traced once, for the shapes of its results and for the loop's body: tracing is most of what a step takes to compile.
_step_filters: Callable[..., Stepped] = eqx.filter_jit(AllFilters.step, inline=True)  # type: ignore[call-overload]


def step_plausibly(
    filters: AllFilters,
    states: PyTree,
    z: Sequence[jax.Array],
    u: jax.Array,
    k: jax.Array,
    drawn: Mapping[str, UplinkDraws] | None = None,
) -> Stepped:
    """Step all filters with all data, which they judge; where some is implausible, step again without it.

    In the second pass each filter leaves out what it judged implausible in the first, and the judgements of the first
    are returned. The passes are iterations of a loop, so that the second is left out where it is not needed.

    Args:
        filters: of the network.
        states: before the step.
        z: measurements (node, received) by group.
        u: inputs of the plant over the step.
        k: number of the step.
        drawn: what uplinks and links between neighbours do, by fusion; without, nothing is lost.

    Returns:
        The states after the step, and its outputs by name: estimates, and judgements of the measurements.
    """
    # The loop begins with outputs of zeros, in which nothing is implausible; their shapes are those of a step's.
    by_stack = [jnp.zeros((stacked.count, stacked.nodes)) for stacked in filters.stacks]
    none_skipped = by_stack, {name: jnp.zeros(()) for name in filters.central}
    _, output_shapes = eqx.filter_eval_shape(_step_filters, filters, states, z, u, k, drawn, none_skipped)

    def needs_pass(carry: tuple[jax.Array, Stepped]) -> jax.Array:
        """Return whether to step: in pass 0 always, in pass 1 if something was implausible in pass 0."""
        number, (_, outputs) = carry
        return (number == 0) | (number == 1) & is_implausible(outputs)

    def step(carry: tuple[jax.Array, Stepped]) -> tuple[jax.Array, Stepped]:
        """Return the next pass's number, and all filters stepped without what the pass before judged implausible.

        Pass 0 leaves nothing out. Both passes start from the same states before the step.
        """
        number, (_, outputs_before) = carry
        skip = read_refusal_reasons(outputs_before)
        after, outputs = _step_filters(filters, states, z, u, k, drawn, skip)
        # Keep the judgements of the first pass, since only it judges all data.
        for name in ("judged", "judged_centrally"):
            outputs[name] = jax.tree.map(
                lambda first, now: jnp.where(number == 0, now, first), outputs_before[name], outputs[name]
            )
        return number + 1, (after, outputs)

    start = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), output_shapes)
    stepped: Stepped
    _, stepped = jax.lax.while_loop(needs_pass, step, (jnp.asarray(0), (states, start)))
    return stepped


class JudgementReader:
    """The filters that judge what each node received; reads their judgements of a step, or of a recording's rows."""

    def __init__(self, network: Network):
        """List, for each node, where its filters that receive measurements stand in the network's stacks of filters.

        The place of a filter is (stack, number in the stack, number of the node): filters of one structure are stacked.
        """
        self._indices: dict[str, list[EstimateIndex]] = {name: [] for name in network.names}
        for (node, name), index in network.estimate_indices.items():
            if network.nodes[node].filters[name].received:
                self._indices[node].append(index)

    def read_node(self, outputs: Mapping[str, PyTree], node: str) -> Float[np.ndarray, "... filters 4"]:
        """Return the judgements of the filters that receive from a node: whether what arrived is plausible.

        Where a node has no such filter, they are those of the central filters, which receive from all nodes. The last
        axis has the four fields of a `Judgement`: distance, arrived, reason and input.
        """
        return self._stack_judgements(outputs, self._indices[node], not self._indices[node])

    def read_all(self, outputs: Mapping[str, PyTree]) -> Float[np.ndarray, "... filters 4"]:
        """Return the judgements of all filters: first those of the nodes by stack, then those of central filters.

        A stack (filter, node) has filters of one structure. The last axis holds the fields of a Judgement.
        """
        indices = []
        for stack, judgement in enumerate(outputs["judged"]):
            filters, nodes = judgement.distance.shape[-2:]
            indices += [EstimateIndex(stack, filter, node) for filter, node in np.ndindex(filters, nodes)]
        return self._stack_judgements(outputs, indices, central=True)

    def _stack_judgements(
        self, outputs: Mapping[str, PyTree], indices: Sequence[EstimateIndex], central: bool
    ) -> Float[np.ndarray, "... filters 4"]:
        """Return the judgements of these filters, followed by those of the central filters if `central` is True.

        The result has the recording's axes (such as steps), then filters, then the four fields of a `Judgement`:
        distance, arrived, reason and input.

        Args:
            outputs: "judged", by stack, judgements whose fields are (..., filter, node); "judged_centrally" by name of
                the central filter, judgements whose fields are (...).
            indices: where each filter stands in the stacked outputs: (stack, filter, node).
            central: whether the central filters' follow.
        """
        judgements = []  # of each filter a list of four arrays (...)
        for index in indices:
            judgements.append([field[..., index.filter, index.node] for field in outputs["judged"][index.stack]])
        if central:
            judgements += [list(judgement) for judgement in outputs["judged_centrally"].values()]
        if not judgements:
            return np.zeros((0, len(Judgement._fields)))
        by_filter_and_field = np.array(judgements)
        return np.moveaxis(by_filter_and_field, (0, 1), (-2, -1))

    @property
    def nodes_without_judge(self) -> list[str]:
        """Names of the nodes without a filter that judges their measurements; only central filters judge these."""
        return [name for name, indices in self._indices.items() if not indices]


def find_refused_rows(
    network: Network, outcome: Mapping[str, PyTree]
) -> tuple[dict[str, dict[int, str]], dict[int, str]]:
    """Return the rows that all filters of a node refuse, with the reason; first by node, then for central filters.

    A filter refuses a measurement that it judges implausible. Central filters, of all nodes' measurements, judge nodes
    that have no filters, all in the same way, so the first of these nodes tells for all. `outcome`: the outputs of
    filtering the rows with judgements.
    """
    reader, refused = JudgementReader(network), dict[str, dict[int, str]]()
    nodes_without_judge = reader.nodes_without_judge
    for name in network.names:
        if name not in nodes_without_judge:
            reasons_by_row = _list_rows_refused_by_all(reader.read_node(outcome, name))
            if reasons_by_row:
                refused[name] = reasons_by_row
    refused_centrally = (
        _list_rows_refused_by_all(reader.read_node(outcome, nodes_without_judge[0])) if nodes_without_judge else {}
    )
    return refused, refused_centrally


def _list_rows_refused_by_all(votes: Float[np.ndarray, "steps filters 4"]) -> dict[int, str]:
    """Return the rows whose values all these filters refuse, with the reason in words.

    `votes`: the filters' judgements of each row; the last axis has the four fields of a `Judgement`: distance, arrived,
    reason and input. A filter refuses a row where its reason, a code, is above 0. `Judgement.why_values` puts the
    reason in words, and is None where some filter accepts the row.
    """
    rows_refused_by_some = _find_flagged(votes, "reason")
    reasons_by_row = {row: Judgement.why_values(votes[row]) for row in rows_refused_by_some}
    return {row: reason for row, reason in reasons_by_row.items() if reason}


def describe_doubts(
    network: Network,
    outputs: Mapping[str, PyTree],
    refused: Mapping[str, Mapping[int, str]],
    u: Float[np.ndarray, "steps inputs"],
) -> list[str]:
    """Return messages about a recording: rows that are implausible to all filters or to one alone, and inputs.

    While a recording is filtered each filter judges each row, and skips a measurement that cannot be true by its model
    (or that is not a number). The messages tell the user which rows were skipped, and why.

    Args:
        network: the network that the recording ran through.
        outputs: output of filtering, by row: "judged" holds judgements by stack of filters (reason (row, filter, node),
            0 for a plausible row, and distance), "judged_centrally" those of fusions by name.
        refused: rows that all filters of a node refuse: {node: {row: reason}}.
        u: inputs of the plant, (steps, inputs).
    """
    # Rows that all filters of a node find implausible. The message explains the first row, and names a function of the
    # model (such as the transition) that returned numbers that are not finite, if there is one.
    faults = _NonFiniteFunctionFinder(network, outputs, u)
    lines = []
    for node, by_row in refused.items():
        first_row, why = next(iter(by_row.items()))
        named = [faults.name_fault(node, name, first_row) for name in network.nodes[node].filters]
        fault = next((words for words in named if words), "")
        taken_for = say_taken_for_silence(network.nodes[node])
        rows_named = _format_rows(list(by_row))
        lines.append(f"node {node!r}: {rows_named} implausible, as if not arrived: {why}{fault}{taken_for}")
    # Rows that one filter alone skips.
    judgements = {
        of_filter: Judgement(*(field[:, i.filter, i.node] for field in outputs["judged"][i.stack]))
        for of_filter, i in network.estimate_indices.items()
    }
    judgements |= {(FUSED, name): judgement for name, judgement in outputs["judged_centrally"].items()}
    all_rows = {k: "" for rows in refused.values() for k in rows}
    for (node, name), judgement in judgements.items():
        reported = all_rows if node == FUSED else refused.get(node, {})
        rows = [int(k) for k in np.flatnonzero(judgement.reason > 0) if k not in reported]
        if rows:
            reason, distance = np.asarray(judgement.reason)[rows[0]], np.asarray(judgement.distance)[rows[0]]
            why = Judgement.describe(reason, distance) + faults.name_fault(node, name, rows[0])
            lines.append(f"filter {name!r} of {node!r} alone: {_format_rows(rows)} implausible, left out: {why}")
    # Inputs are implausible if some filter finds them so, and no filter finds them plausible.
    if network.inputs:
        votes = JudgementReader(network).read_all(outputs)
        rows = [k for k in _find_flagged(votes, "input") if Judgement.why_inputs(votes[k])]
        if rows:
            lines.append(f"inputs: {_format_rows(rows)} implausible: {INPUT}")
    return lines


class _NonFiniteFunctionFinder:
    """Names functions of the filters' models that returned no number in a recording."""

    def __init__(self, network: Network, outputs: Mapping[str, PyTree], u: Float[np.ndarray, "steps inputs"]):
        """Hold the network, what its filters put out by row, and the inputs of the plant."""
        self.network, self.u = network, u
        self.outputs = outputs.get("filtered", outputs)  # those of filters, where smoothed ones stand beside them

    def name_fault(self, node: str, name: str, row: int) -> str:
        """Return "; " and what function of a filter returned no number in a row; "" where none did.

        `node`: where the filter `name` stands, FUSED for a central one.

        Evaluated are the functions of the filter's models (such as the transition) at its estimate before the row.
        """
        central = node == FUSED
        filter = self.network.fused[name] if central else self.network.nodes[node].filters[name]
        if not isinstance(filter, AbstractFilter):
            return ""
        if row == 0:
            before = filter.estimate(filter.init())
        elif central:
            before = jax.tree.map(lambda leaf: leaf[row - 1], self.outputs["fused"][name])
        else:
            i = self.network.estimate_indices[node, name]
            before = jax.tree.map(lambda leaf: leaf[row - 1, i.filter, i.node], self.outputs["estimates"][i.stack])
        fault = describe_non_finite_function(filter, before, self.u[row], row)
        return f"; {fault}" if fault else ""


def _find_flagged(judgements: Float[np.ndarray, "steps filters 4"], field: str) -> list[int]:
    """Return the numbers of the rows in which this field of some filter's judgement is above 0.

    `judgements`: their last axis holds the fields of a `Judgement` (distance, arrived, reason, input). `field`:
    "reason", a code that is above 0 for a refused measurement, or "input", 1 where an input is implausible.
    """
    if not judgements.size:
        return []
    is_over = judgements[..., Judgement._fields.index(field)] > 0  # by row and filter
    rows: list[int] = np.flatnonzero(is_over.any(axis=-1)).tolist()
    return rows


def _format_rows(rows: Sequence[int]) -> str:
    """Return "row 3 is", or "7 rows (1, 2, ...) are" with the first five, counted from 1."""
    listed = ", ".join(str(k + 1) for k in rows[:5])
    if len(rows) > 5:
        listed += ", ..."
    return f"{len(rows)} rows ({listed}) are" if len(rows) > 1 else f"row {listed} is"
