"""Steps of all filters without implausible data, messages about them, and values that a sender's rule forbids."""

from collections.abc import Callable, Mapping, Sequence

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.filters.plausibility import INPUT, Judgement
from heliograph.model.checks.faults import find_function_fault
from heliograph.model.over_time import first
from heliograph.model.trigger import AbstractThreshold
from heliograph.numerics.types import Float, PyTree
from heliograph.simulation.centres.uplinks import UplinkDraws
from heliograph.simulation.network import FUSED, Network
from heliograph.simulation.node import Node, ReceivingNode
from heliograph.simulation.stepping import AllFilters

Stepped = tuple[PyTree, dict[str, PyTree]]  # the filters' states after a step, and their results

RIM = 1e-9  # share of delta by which a value may lie inside for rounding


def implausible(outputs: Mapping[str, PyTree]) -> jax.Array:
    """Return, within a program, whether some filter judges its measurement implausible."""
    flags = [jnp.any(j.implausible) for j in (*outputs["judged"], *outputs["judged_centrally"].values())]
    return jnp.any(jnp.stack(flags)) if flags else jnp.asarray(False)


def any_implausible(outputs: Mapping[str, PyTree]) -> bool:
    """Return whether some filter judged a measurement implausible in stored results, NumPy arrays."""
    return any((j.reason > 0).any() for j in (*outputs["judged"], *outputs["judged_centrally"].values()))


def reasons(outputs: Mapping[str, PyTree]) -> tuple[list[jax.Array], dict[str, jax.Array]]:
    """Return each filter's reason not to use its measurement, 0 for none: of nodes by kind, of central ones by name."""
    return [judgement.reason for judgement in outputs["judged"]], {
        n: judgement.reason for n, judgement in outputs["judged_centrally"].items()
    }


# Traced once, for the shapes of its results and for the loop's body: tracing is most of what a step takes to compile.
_step: Callable[..., Stepped] = eqx.filter_jit(AllFilters.step, inline=True)  # type: ignore[call-overload]


def step_plausibly(
    filters: AllFilters,
    states: PyTree,
    z: Sequence[jax.Array],
    u: jax.Array,
    k: jax.Array,
    drawn: Mapping[str, UplinkDraws] | None = None,
) -> Stepped:
    """Step all filters with all data, which they judge; where some is implausible, step again without it.

    In the second turn each filter skips what it judged implausible in the first; the judgements of the first stay. A
    loop of at most two turns, so that the second is left out where it is not needed.
    """
    by_kind = [jnp.zeros((a.count, a.nodes)) for a in filters.alike]
    none_skipped = by_kind, {name: jnp.zeros(()) for name in filters.central}
    _, outputs = eqx.filter_eval_shape(_step, filters, states, z, u, k, drawn, none_skipped)

    def needs_turn(carry: tuple[jax.Array, Stepped]) -> jax.Array:
        """Return whether to step: in turn 0 always, in turn 1 where something was implausible."""
        turn, (_, outputs) = carry
        return (turn == 0) | (turn == 1) & implausible(outputs)

    def step(carry: tuple[jax.Array, Stepped]) -> tuple[jax.Array, Stepped]:
        """Step from the states before, without what the turn before judged implausible; in turn 0 that is nothing."""
        turn, (_, before) = carry
        after, outputs = _step(filters, states, z, u, k, drawn, reasons(before))
        for name in ("judged", "judged_centrally"):
            outputs[name] = jax.tree.map(lambda old, new: jnp.where(turn == 0, new, old), before[name], outputs[name])
        return turn + 1, (after, outputs)

    start = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape, leaf.dtype), outputs)
    stepped: Stepped = jax.lax.while_loop(needs_turn, step, (jnp.asarray(0), (states, start)))[1]
    return stepped


class FilterJudges:
    """The filters that judge what each node received; reads their judgements of a step, or of a recording's rows."""

    def __init__(self, network: Network):
        self._places: dict[str, list[tuple[int, int, int]]] = {name: [] for name in network.names}
        for (node, name), position in network.places.items():
            if network.nodes[node].filters[name].received:
                self._places[node].append(position)

    def of_node(self, outputs: Mapping[str, PyTree], node: str) -> Float[np.ndarray, "... filters 4"]:
        """Return the judgements of the filters that receive from a node; where it has none, of the central ones."""
        return self._stack_judgements(outputs, self._places[node], not self._places[node])

    def of_all(self, outputs: Mapping[str, PyTree]) -> Float[np.ndarray, "... filters 4"]:
        """Return the judgements of all filters."""
        places = []
        for kind, judgement in enumerate(outputs["judged"]):
            places += [(kind, f, i) for f, i in np.ndindex(*judgement[0].shape[-2:])]
        return self._stack_judgements(outputs, places, central=True)

    def _stack_judgements(
        self, outputs: Mapping[str, PyTree], places: Sequence[tuple[int, int, int]], central: bool
    ) -> Float[np.ndarray, "... filters 4"]:
        """Return the judgements of these filters, and those of the centre behind them if `central`.

        Axes: the recording's, filter, field of a Judgement.
        """
        judgements = [[field[..., f, i] for field in outputs["judged"][k]] for k, f, i in places]
        judgements += [list(judgement) for judgement in outputs["judged_centrally"].values()] if central else []
        if not judgements:
            return np.zeros((0, len(Judgement._fields)))
        return np.moveaxis(np.array(judgements), (0, 1), (-2, -1))

    @property
    def without_own(self) -> list[str]:
        """Nodes that no filter of their own judges, but the central ones."""
        return [name for name, places in self._places.items() if not places]


def find_refused_rows(
    network: Network, outcome: Mapping[str, PyTree]
) -> tuple[dict[str, dict[int, str]], dict[int, str]]:
    """Return the rows that a filter calls implausible, with the reason: by node with filters, and of the central ones.

    Nodes without filters of their own are judged by the central ones, all alike: the first tells for all.
    """
    judges, refused = FilterJudges(network), dict[str, dict[int, str]]()
    without_own = judges.without_own
    for name in network.names:
        if name not in without_own and (reasons_by_row := _list_reasons(judges.of_node(outcome, name))):
            refused[name] = reasons_by_row
    central = _list_reasons(judges.of_node(outcome, without_own[0])) if without_own else {}
    return refused, central


def _list_reasons(votes: Float[np.ndarray, "steps filters 4"]) -> dict[int, str]:
    """Return the rows whose values all these filters refuse, with the reason."""
    reasons_by_row = {row: Judgement.why_values(votes[row]) for row in _find_flagged(votes, "reason")}
    return {row: reason for row, reason in reasons_by_row.items() if reason}


def describe_doubts(
    network: Network,
    outputs: Mapping[str, PyTree],
    refused: Mapping[str, Mapping[int, str]],
    u: Float[np.ndarray, "steps inputs"],
) -> list[str]:
    """Return messages about a recording: rows that are implausible to all filters or to one alone, and inputs."""
    # Rows that are implausible for all filters of a node.
    faults = _FaultFinder(network, outputs, u)
    lines = []
    for node, by_row in refused.items():
        row, why = next(iter(by_row.items()))
        named = [faults.of(node, name, row) for name in network.nodes[node].filters]
        fault = next((words for words in named if words), "")
        lines.append(f"node {node!r}: {_format_rows(list(by_row))} implausible, as if not arrived: {why}{fault}")
    # Rows that a single filter skips.
    at_nodes = {(node, name): [field[:, f, i] for field in outputs["judged"][kind]]
            for (node, name), (kind, f, i) in network.places.items()}  # fmt: skip
    at_centres = {(FUSED, name): list(judgement) for name, judgement in outputs["judged_centrally"].items()}
    all_rows = {k: "" for rows in refused.values() for k in rows}
    for (node, name), (distance, _, reason, _) in (at_nodes | at_centres).items():
        reported = all_rows if node == FUSED else refused.get(node, {})
        rows = [int(k) for k in np.flatnonzero(reason > 0) if k not in reported]
        if rows:
            why = Judgement.describe(reason[rows[0]], distance[rows[0]]) + faults.of(node, name, rows[0])
            lines.append(f"filter {name!r} of {node!r} alone: {_format_rows(rows)} implausible, left out: {why}")
    # Inputs, judged by all filters.
    if network.inputs:
        votes = FilterJudges(network).of_all(outputs)
        rows = [k for k in _find_flagged(votes, "input") if Judgement.why_inputs(votes[k])]
        lines += [f"inputs: {_format_rows(rows)} implausible: {INPUT}"] if rows else []
    return lines


class _FaultFinder:
    """Names functions of the filters' models that returned no number in a recording."""

    def __init__(self, network: Network, outputs: Mapping[str, PyTree], u: Float[np.ndarray, "steps inputs"]):
        self.network, self.u = network, u
        self.outputs = outputs.get("filtered", outputs)  # those of filters, where smoothed ones stand beside them

    def of(self, node: str, name: str, row: int) -> str:
        """Name the function of a filter that returned no number in a row, after a semicolon; "" where none did."""
        central = node == FUSED
        filter = self.network.fused[name] if central else self.network.nodes[node].filters[name]
        if not isinstance(filter, AbstractFilter):
            return ""
        if row == 0:
            before = filter.estimate(filter.init())
        elif central:
            before = jax.tree.map(lambda leaf: leaf[row - 1], self.outputs["fused"][name])
        else:
            kind, f, i = self.network.places[node, name]
            before = jax.tree.map(lambda leaf: leaf[row - 1, f, i], self.outputs["estimates"][kind])
        fault = find_function_fault(filter, before, self.u[row], row)
        return f"; {fault}" if fault else ""


def _find_flagged(votes: Float[np.ndarray, "steps filters 4"], field: str) -> list[int]:
    """Return the rows in which this field of some filter's judgement is over 0."""
    if not votes.size:
        return []
    flagged: list[int] = np.flatnonzero((votes[..., Judgement._fields.index(field)] > 0).any(axis=-1)).tolist()
    return flagged


def _format_rows(rows: Sequence[int]) -> str:
    """Return "row 3 is", or "7 rows (1, 2, ...) are" with the first five, counted from 1."""
    listed = ", ".join(str(k + 1) for k in rows[:5]) + (", ..." if len(rows) > 5 else "")
    return f"{len(rows)} rows ({listed}) are" if len(rows) > 1 else f"row {listed} is"


def find_forbidden_rows(node: Node | ReceivingNode, z: Float[np.ndarray, "steps received"]) -> list[int]:
    """Return the rows at which a value came though it was within delta of the value before, and no heartbeat was due.

    Only of a sender on delta whose values all arrive as they are: elsewhere no single value is impossible. A filter
    uses such a value and gives it a floor of 1e-6 as its probability.
    """
    trigger = node.trigger if isinstance(node, Node) else None
    if not isinstance(trigger, AbstractThreshold) or trigger.reference != "sent" or trigger.region == "each":
        return []
    assert isinstance(node, Node)  # as it has a trigger
    channel = first(node.channel)
    if channel.erases or channel.remembers or channel.outputs != len(node.outputs):
        return []
    # Each value against the one before it.
    forbidden, last = list[int](), None
    for k, row in enumerate(z[:, : len(node.outputs)]):
        if np.isnan(row).any():
            continue
        if last is not None:
            due = trigger.heartbeat is not None and k - last >= trigger.heartbeat
            error = np.abs(row - z[last, : len(row)])
            delta = (1 - RIM) * np.asarray(trigger.delta)
            inside = np.linalg.norm(error) <= delta if trigger.region == "ball" else np.all(error <= delta)
            if inside and not due:
                forbidden.append(k)
        last = k
    return forbidden
