"""Innovations of a run by output: values down-weighted, bias, which to blame; and errors of its filters."""

from collections import Counter, defaultdict, deque
from collections.abc import Iterator, Mapping, Sequence
from typing import NamedTuple

import jax
import numpy as np

from heliograph.disk.quoting import visible
from heliograph.filters.base import AbstractFilter
from heliograph.filters.innovation import InnovationSummary, Weighed
from heliograph.fusion.network_fusion import Fusion
from heliograph.model.estimate import STRENGTH, weakest
from heliograph.numerics.counted_shares import average_correlated
from heliograph.numerics.counted_shares import round_to as round_to
from heliograph.report.expected_squares import compare_squares, expect_squares
from heliograph.report.innovation_medians import find_law_medians
from heliograph.report.repeated_values import NO_LAW, HeldValue, NoiseLaw, find_held_value, list_noise_laws
from heliograph.report.results import Json
from heliograph.simulation.network import Network
from heliograph.simulation.results.record import Record


class FilterErrors(NamedTuple):
    """Errors of one filter: RMSE by state (NaN where its truth is not known), and NEES per state, 1 for a true claim.

    `rmse_error` and `nees_error` are the standard errors, of errors that are correlated in time.

    `claim` is what holds in all rows; `nees` is NaN where nothing is claimed.
    """

    node: str
    filter: str
    claim: str
    rmse: dict[str, float]
    rmse_error: dict[str, float]
    nees: float
    nees_error: float


def compare_with_truth(record: Record) -> list[FilterErrors]:
    """Compare each filter with the truth, the fused ones first; nothing without one."""
    if record.truth is None:
        return []
    known = np.sum(~np.isnan(np.asarray(record.truth)), axis=-1)
    results = []
    for node, estimates in sorted(record.estimates.items(), key=lambda pair: pair[0] != Network.FUSED):
        for name, estimate in estimates.items():
            nees = record.nees(node, name)
            claimed = ~np.isnan(nees)
            rmse = record.rmse(node, name)
            per_state = nees / np.where(known > 0, known, np.nan)
            results.append(
                FilterErrors(
                    node,
                    name,
                    claim=weakest(np.unique(estimate.claims).tolist()),
                    rmse=rmse,
                    rmse_error=_estimate_rmse_errors(record, node, name, rmse),
                    nees=float(nees[claimed].sum() / known[claimed].sum()) if claimed.any() else np.nan,
                    nees_error=average_correlated(per_state)[1] if claimed.any() else np.nan,
                )
            )
    return results


def _estimate_rmse_errors(record: Record, node: str, name: str, rmse: Mapping[str, float]) -> dict[str, float]:
    """Return the standard error of each RMSE, that of the mean square over twice the RMSE; NaN where there is none."""
    truth = np.asarray(record.truth)
    squares = np.where(np.isnan(truth), np.nan, record.errors(node, name)) ** 2
    errors = {}
    for (state, size), column in zip(rmse.items(), squares.T, strict=True):
        mean_square_error = average_correlated(column)[1]
        errors[state] = mean_square_error / (2 * size) if size > 0 else np.nan
    return errors


class OutputJudgement(NamedTuple):
    """What the innovations of one filter say of one received number.

    to_blame: whether more of its values are down-weighted than of the filter's others together, by an interval of the
    difference, and the filter is one that the network relies on where any of these weighs. size: mean square of the
    innovations that the filter used (of weight 1/2 or more) over their claimed variance, 1 where the claim holds, with
    its standard error. held: the longest run of equal values, where chance makes none as long; None elsewhere.
    """

    output: str
    to_blame: bool
    summary: InnovationSummary
    size: float
    size_error: float
    held: HeldValue | None


class OutputHealth(NamedTuple):
    """The judgement of one received number under one filter; weighs: whether the filter weighs what arrives."""

    node: str
    filter: str
    weighs: bool
    judged: OutputJudgement

    @property
    def name(self) -> str:
        """Name the filter and the output, such as "radio/robust: left"."""
        return visible(f"{self.node}/{self.filter}: {self.judged.output}")

    def __str__(self) -> str:
        """One line, such as "radio/robust: left: 7 of 200 down-weighted (2 % to 7 %), bias 0.14 +- 0.05"."""
        blame = "; to blame: more than of the others" if self.judged.to_blame else ""
        return f"{self.name}: {self.judged.summary}{blame}"


class ListeningFilter(NamedTuple):
    """A filter with its measurements (time, m) and their names.

    trusted: whether the network relies on it. blames: whether its weights say which output is to blame.
    """

    node: str
    name: str
    filter: AbstractFilter
    measurements: np.ndarray
    outputs: list[str]
    trusted: bool = True
    blames: bool = True


def list_listeners(network: Network, record: Record) -> Iterator[ListeningFilter]:
    """Yield every filter with its measurements: those of the nodes, then central ones."""
    received, relied_on = record.measurements, _find_relied_on(network)
    for node, z in received.items():
        filters, names = network.nodes[node].filters, list(network.nodes[node].received_names)
        weighing = {name for name, filter in filters.items() if filter.received and weighs(filter)}
        blaming = weighing & relied_on[node] or weighing
        for name, filter in filters.items():
            yield ListeningFilter(node, name, filter, z, names, name in relied_on[node], name in blaming)
    every = [f"{node}: {name}" for node in received for name in network.nodes[node].received_names]
    for name, fusion in network.fused.items():
        if isinstance(fusion, AbstractFilter):
            yield ListeningFilter(Network.FUSED, name, fusion, np.concatenate(list(received.values()), axis=1), every)


def _find_relied_on(network: Network) -> dict[str, set[str]]:
    """Return the filters that the network relies on, by node: fused ones, else the first of the strongest claim.

    Others, such as one that takes the mean of a random gain for it, are there to be compared with.
    """
    fused = {fusion.filter for fusion in (network.fused | network.meshes).values() if isinstance(fusion, Fusion)}
    relied_on = {}
    for node, receiver in network.nodes.items():
        strengths = {name: STRENGTH[filter.claim] for name, filter in receiver.filters.items()}
        strongest = [name for name, strength in strengths.items() if strength == max(strengths.values())]
        relied_on[node] = fused & set(strengths) or set(strongest[:1])
    return relied_on


def weighs(filter: AbstractFilter) -> bool:
    """Return whether a filter weighs the components of what arrives."""
    with jax.enable_x64(True):
        state = jax.tree.map(np.asarray, filter.init())
        innovation = jax.eval_shape(lambda before, z: filter.correct(before, z)[1], state, np.zeros(filter.received))
    return innovation.weight is not None


def judge_outputs_of_filter(
    network: Network, listener: ListeningFilter, record: Record, inputs: np.ndarray
) -> list[OutputHealth]:
    """Judge each output by the innovations of one filter that claims a covariance.

    A median that the node's law of noise has itself, since it is not symmetric, is no bias.
    """
    innovations = record.weighed.get(listener.node, {}).get(listener.name)
    weighed = innovations is not None
    if innovations is None:
        outcome = listener.filter.run(listener.measurements, inputs)
        variance = np.diagonal(outcome.innovation_covariances, axis1=-2, axis2=-1)
        innovations = Weighed(outcome.innovations, variance, np.ones_like(outcome.innovations))
    medians = find_law_medians(network, listener.node, _median_over_time(np.asarray(innovations.variance)))
    expected = expect_squares(listener.filter, listener.measurements, inputs)
    laws = list_noise_laws(network, listener.node)
    # What is told, such as a gain or a flag, is known: its innovations are 0, of variance 0, and it is not judged.
    variance = np.asarray(innovations.variance)
    is_known = np.any(variance == 0, axis=0) & ~np.any(variance > 0, axis=0)
    places = np.flatnonzero(~is_known)
    judged = judge_outputs(
        [listener.outputs[i] for i in places],
        listener.measurements[:, places],
        Weighed(*(np.asarray(column)[:, places] for column in innovations)),
        medians[places],
        blames=weighed and listener.blames,
        expected=expected[:, places],
        laws=[laws[i] for i in places],
    )
    return [OutputHealth(listener.node, listener.name, weighed, output) for output in judged]


def _median_over_time(variance: np.ndarray) -> np.ndarray:
    """Return the median over time by output (m,) of variances (time, m), NaN where nothing arrived; 0 of none."""
    columns = [column[~np.isnan(column)] for column in variance.T]
    return np.array([np.median(column) if len(column) else 0.0 for column in columns])


def judge_outputs(
    names: Sequence[str],
    received: np.ndarray,
    innovations: Weighed,
    medians: np.ndarray,
    blames: bool,
    expected: np.ndarray,
    laws: Sequence[NoiseLaw] | None = None,
) -> list[OutputJudgement]:
    """Judge each output by its innovations (time, m), and by the values that were received (time, m).

    `medians` (m,): of innovations under a law that is not symmetric. `blames`: whether weights tell of outliers.
    `expected` (time, m): of the squares, as `expect_squares` returns them.
    `laws`: of each output's noise; None where they are not known. The bias is that beyond `medians`.
    """
    summaries = [
        summary._replace(bias=summary.bias - m, bias_low=summary.bias_low - m, bias_high=summary.bias_high - m)
        for summary, m in zip(innovations.summarise(), medians, strict=True)
    ]
    outliers = InnovationSummary.find_outlying(summaries) if blames else []
    used, variance = innovations.square_used(), np.asarray(innovations.variance)
    judged = []
    for i, (name, summary) in enumerate(zip(names, summaries, strict=True)):
        size, size_error = compare_squares(used[:, i], expected[:, i])
        held = find_held_value(received[:, i], variance[:, i], NO_LAW if laws is None else laws[i])
        judged.append(OutputJudgement(name, i in outliers, summary, size, size_error, held))
    return judged


class RecentOutputs:
    """Innovations of the newest rows of filters that weigh, summarised by output on request.

    `names`: of the received numbers, by node and filter; numbers from 1 where they are not known.
    """

    def __init__(self, rows: int, names: Mapping[tuple[str, str], Sequence[str]]):
        self.names = names
        self._rows: dict[tuple[str, str], deque[np.ndarray]] = defaultdict(lambda: deque(maxlen=rows))
        self.left_out = Counter[tuple[str, str]]()  # by node and filter: numbers of weight 0, of all rows so far

    def add(self, node: str, name: str, outputs: Mapping[str, Sequence[float | None]]) -> None:
        """Add a row: innovations `value`, their `variance` and the `weight` of each number, None where none arrived."""
        row = [outputs[field] for field in ("value", "variance", "weight")]
        self._rows[node, name].append(np.array(row, dtype=float))
        self.left_out[node, name] += sum(weight == 0 for weight in outputs["weight"])

    def health(self) -> list[OutputHealth]:
        """Summarise each output of each filter over its newest rows."""
        results = []
        for (node, name), rows in self._rows.items():
            innovations = Weighed(*np.moveaxis(np.array(rows), 1, 0))
            count = innovations.value.shape[1]
            names = list(self.names.get((node, name)) or [str(i + 1) for i in range(count)])
            unknown = np.full(innovations.value.shape, np.nan)  # what was received is not kept
            judged = judge_outputs(
                names, unknown, innovations, medians=np.zeros(count), blames=True, expected=np.ones_like(unknown)
            )
            results += [OutputHealth(node, name, weighs=True, judged=output) for output in judged]
        return results


def weighed_outputs(network: Network, record: Record) -> list[OutputHealth]:
    """Summarise the innovations of all filters that weigh what arrives in a recording, by output."""
    outputs: list[OutputHealth] = []
    for listener in list_listeners(network, record):
        if listener.name in record.weighed.get(listener.node, {}):
            outputs += judge_outputs_of_filter(network, listener, record, np.zeros(0))
    return outputs


def summarise_output(health: OutputHealth) -> dict[str, Json]:
    """Return the numbers of one output for a summary, by name; None in place of NaN."""
    judged, summary = health.judged, health.judged.summary
    values: dict[str, float] = {"bias": summary.bias, "bias_low": summary.bias_low, "bias_high": summary.bias_high,
                                "squared": summary.squared, "size": judged.size,
                                "size_error": judged.size_error}  # fmt: skip
    if health.weighs:
        values |= {"weight": summary.weight, "share": summary.share.estimate, "share_low": summary.share.low,
                   "share_high": summary.share.high}  # fmt: skip
    counted: dict[str, Json] = {"expected": summary.expected, "received": summary.received}
    if health.weighs:
        counted |= {"down_weighted": summary.down_weighted, "to_blame": judged.to_blame}
    if judged.held is not None:
        counted |= {"held": judged.held.readings, "held_from_row": judged.held.first_row + 1}
    return counted | {name: None if np.isnan(value) else value for name, value in values.items()}


def make_output_row(health: OutputHealth) -> dict[str, Json]:
    """Return the numbers of one output with its names, and in words."""
    judged = health.judged
    words = str(judged.summary) + ("; to blame" if judged.to_blame else "")
    named: dict[str, Json] = {"node": health.node, "filter": health.filter, "output": judged.output, "words": words}
    return named | summarise_output(health)
