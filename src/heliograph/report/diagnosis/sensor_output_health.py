"""Innovations of a run by output: values down-weighted, bias, which to blame; and errors of its filters.

A filter weighs if it gives what arrives weights from 0 to 1, by how far it lies from what was expected; a value is
down-weighted below 1/2. A listener is a filter with what it receives.
"""

from collections import Counter, defaultdict, deque
from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import jax
import numpy as np

from heliograph.disk.quoted_text import visible
from heliograph.filters.base import AbstractFilter
from heliograph.filters.innovation import InnovationSummary, Weighed
from heliograph.fusion.network_fusion import Fusion
from heliograph.model.estimate import STRENGTH, weakest
from heliograph.numerics.confidence_intervals import average_correlated
from heliograph.numerics.confidence_intervals import round_to as round_to
from heliograph.report.diagnosis.expected_squared_innovations import compute_expected_squares, compute_ratio_of_squares
from heliograph.report.diagnosis.innovation_medians import compute_innovation_medians
from heliograph.report.diagnosis.stuck_sensors import NO_LAW, NoiseLaw, StuckValue, find_stuck_value, list_noise_laws
from heliograph.report.results_folder import Json
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


def compute_filter_errors(record: Record) -> list[FilterErrors]:
    """Return the errors of each filter, the fused ones first; nothing of a record without true states.

    They are the RMSE of each state, and the NEES e' P^-1 e divided by the number of states whose truth is known, with
    e the error and P the claimed covariance: 1 where the claim holds. Both come with standard errors. `record` has true
    states and estimates of a run, by node and filter; Network.FUSED stands for the fusion centre.

    `claim` is the weakest claim that the filter had in any row; `weakest` chooses it. `average_correlated` returns a
    mean over rows that are correlated over time, and its standard error.
    """
    if record.truth is None:
        return []
    known = np.sum(~np.isnan(np.asarray(record.truth)), axis=-1)  # how many states' truth is known, by row
    results = []
    for node, estimates in sorted(record.estimates.items(), key=lambda pair: pair[0] != Network.FUSED):
        for name, estimate in estimates.items():
            rmse, nees = record.rmse(node, name), record.nees(node, name)
            # Per known state: over all claimed rows together, with the standard error of a mean over rows.
            claimed = ~np.isnan(nees)
            has_nees = bool(claimed.any())
            per_state = nees / np.where(known > 0, known, np.nan)
            _mean, error_of_mean = average_correlated(per_state) if has_nees else (np.nan, np.nan)
            results.append(
                FilterErrors(
                    node=node,
                    filter=name,
                    claim=weakest(np.unique(estimate.claims).tolist()),
                    rmse=rmse,
                    rmse_error=_estimate_rmse_errors(record, node, name, rmse),
                    nees=float(nees[claimed].sum() / known[claimed].sum()) if has_nees else np.nan,
                    nees_error=error_of_mean,
                )
            )
    return results


def _estimate_rmse_errors(record: Record, node: str, name: str, rmse: Mapping[str, float]) -> dict[str, float]:
    """Return the standard error of each state's RMSE, NaN for an RMSE of 0.

    With the mean square M = RMSE^2, to first order it is the standard error of M divided by 2 RMSE. `rmse` holds by
    state the RMSE of the filter `name` at `node`. `record.errors` are the estimates' errors (rows, n).
    """
    truth = np.asarray(record.truth)
    squares = np.where(np.isnan(truth), np.nan, record.errors(node, name)) ** 2
    errors = {}
    for (state, rmse_of_state), squares_of_state in zip(rmse.items(), squares.T, strict=True):
        _, error_of_mean_square = average_correlated(squares_of_state)
        errors[state] = error_of_mean_square / (2 * rmse_of_state) if rmse_of_state > 0 else np.nan
    return errors


class OutputJudgement(NamedTuple):
    """What the innovations of one filter say of one received number.

    to_blame: whether outliers come from this output: more of its values are down-weighted than of the filter's other
    outputs together, by an interval of the difference, and the filter is one whose weights are believed (`blames`).
    size: mean square of the innovations that the filter used (of weight 1/2 or more) over their claimed variance, 1
    where the claim holds, with its standard error. held: the longest run of equal values, where chance makes none as
    long; None elsewhere.
    """

    output: str
    to_blame: bool
    summary: InnovationSummary
    size: float
    size_error: float
    held: StuckValue | None


class OutputHealth(NamedTuple):
    """The judgement of one received number under one filter; weighs: whether the filter weighs what arrives."""

    node: str
    filter: str
    weighs: bool
    judged: OutputJudgement

    @property
    def name(self) -> str:
        """Return the node, the filter and the output (`self.judged` is its judgement), such as "radio/robust: left"."""
        return visible(f"{self.node}/{self.filter}: {self.judged.output}")

    def __str__(self) -> str:
        """One line, such as "radio/robust: left: 7 of 200 down-weighted (2 % to 7 %), bias 0.14 +- 0.05"."""
        # To blame: its values were weighted down more often than those of the other outputs.
        blame = "; to blame: more than of the others" if self.judged.to_blame else ""
        return f"{self.name}: {self.judged.summary}{blame}"


class FilterWithMeasurements(NamedTuple):
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


def yield_filters_with_measurements(network: Network, record: Record) -> Iterator[FilterWithMeasurements]:
    """Yield every filter with its measurements: those of the nodes, then central ones.

    A filter is trusted if the network relies on it. It blames (its weights decide which outputs are bad) if it weighs
    outputs and is trusted, or if it weighs outputs and no trusted filter of the node does. A central filter receives
    the numbers of all nodes, one node after the other; it is trusted, and blames.
    """
    received = record.measurements
    relied_on = _list_relied_on_filters(network)
    for node, z in received.items():
        filters = network.nodes[node].filters
        names = list(network.nodes[node].received_names)
        weighing = {name for name, filter in filters.items() if filter.received and weighs(filter)}
        blaming = (weighing & relied_on[node]) or weighing  # trusted ones, or all if no trusted filter weighs
        for name, filter in filters.items():
            trusted, blames = name in relied_on[node], name in blaming
            yield FilterWithMeasurements(node, name, filter, z, names, trusted=trusted, blames=blames)
    every = [f"{node}: {name}" for node in received for name in network.nodes[node].received_names]
    for name, fusion in network.fused.items():
        if isinstance(fusion, AbstractFilter):
            yield FilterWithMeasurements(
                Network.FUSED, name, fusion, np.concatenate(list(received.values()), axis=1), every
            )


def _list_relied_on_filters(network: Network) -> dict[str, set[str]]:
    """Return by node the names of the filters that the network relies on.

    They are those that a fusion joins, or else the first filter with the strongest claim. Other filters are there for
    comparison.
    """
    # Names of the filters whose estimates a fusion joins, in a centre or among neighbours.
    fused = {fusion.filter for fusion in (network.fused | network.meshes).values() if isinstance(fusion, Fusion)}
    # STRENGTH ranks claims from "none" to "exact".
    relied_on = {}
    for node, receiver in network.nodes.items():
        strengths = {name: STRENGTH[filter.claim] for name, filter in receiver.filters.items()}
        first_of_strongest = {max(strengths, key=lambda name: strengths[name])} if strengths else set()
        relied_on[node] = fused & set(strengths) or first_of_strongest
    return relied_on


def weighs(filter: AbstractFilter) -> bool:
    """Return whether a filter weighs received components by how likely they are, as a filter against outliers does."""

    def make_innovation(state: Any, z: Any) -> Any:
        """Return the innovation of one correction of `state` by the received numbers z."""
        _corrected, innovation = filter.correct(state, z)
        return innovation

    # Trace one correction without computing it: the innovation's weight is None if the filter does not weigh.
    with jax.enable_x64(True):
        state = jax.tree.map(np.asarray, filter.init())
        innovation = jax.eval_shape(make_innovation, state, np.zeros(filter.received))
    return innovation.weight is not None


def judge_outputs_of_filter(
    network: Network, listener: FilterWithMeasurements, record: Record, inputs: np.ndarray
) -> list[OutputHealth]:
    """Return the judgement of each output by the innovations of one filter that claims a covariance.

    An output is doubted by its innovations, such as a median other than 0 (a bias) or another size than claimed. Where
    the law of the noise is not symmetric it has a median of its own, which is no bias.

    Args:
        network: the network.
        listener: the filter with its names, the measurements (time, outputs) that it received, and `blames`, whether
            its weights say which output is to blame.
        record: the run of the network, which holds the innovations of filters that weigh outliers down.
        inputs: inputs of the plant (time, inputs).
    """
    # Innovations with variances and weights (time, outputs). A filter that does not weigh is run again for them.
    innovations = record.weighed.get(listener.node, {}).get(listener.name)
    has_weights = innovations is not None
    if innovations is None:
        outcome = listener.filter.run(listener.measurements, inputs)
        innovations = Weighed(
            value=outcome.innovations,
            variance=np.diagonal(outcome.innovation_covariances, axis1=-2, axis2=-1),
            weight=np.ones_like(outcome.innovations),
        )
    # What the model says of the innovations: variances, medians, mean squares in this recording, and laws of the noise.
    variance = np.asarray(innovations.variance)
    medians = compute_innovation_medians(network, listener.node, _median_over_time(variance))
    expected = compute_expected_squares(listener.filter, listener.measurements, inputs)
    laws = list_noise_laws(network, listener.node)
    # A message may report numbers that a filter takes as they are, such as its gain or a flag. Their innovations have
    # variance 0, and are not judged.
    is_taken_as_given = np.any(variance == 0, axis=0) & ~np.any(variance > 0, axis=0)
    outputs = np.flatnonzero(~is_taken_as_given)
    judged = judge_outputs(
        names=[listener.outputs[i] for i in outputs],
        received=listener.measurements[:, outputs],
        innovations=Weighed(*(np.asarray(field)[:, outputs] for field in innovations)),
        medians=medians[outputs],
        blames=has_weights and listener.blames,
        expected=expected[:, outputs],
        laws=[laws[i] for i in outputs],
    )
    return [
        OutputHealth(node=listener.node, filter=listener.name, weighs=has_weights, judged=output) for output in judged
    ]


def _median_over_time(variance: np.ndarray) -> np.ndarray:
    """Return the median of each column (m,) of variances (time, m), without NaN; 0 for a column of NaN alone."""
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
    """Return what the innovations of a filter, and the values that were received, say of each output.

    For each output: its bias, whether outliers make it suspicious, the size of its innovations against what the filter
    claims, and the longest run of equal values (a stuck sensor).

    Args:
        names: names of the outputs (m).
        received: values (time, m), NaN where none arrived.
        innovations: value, variance and weight of each (time, m).
        medians: medians (m,) that the innovations have anyway, where the noise's law is not symmetric; a bias is
            measured from these.
        blames: whether the filter weighs outliers down, so that low weights tell which output has them.
        expected: what the model expects of each squared innovation (time, m) in this recording, over its variance in
            all runs; 1 for most filters.
        laws: law of each output's noise, by which equal values are judged; None where they are not known.
    """
    # Subtract from each bias, and from both ends of its interval, the median that the law of the noise explains.
    summaries = [
        summary._replace(
            bias=summary.bias - median, bias_low=summary.bias_low - median, bias_high=summary.bias_high - median
        )
        for summary, median in zip(innovations.summarise(), medians, strict=True)
    ]
    # Indices of the outputs of which significantly more values are down-weighted than of the others.
    outlying = InnovationSummary.find_outlying(summaries) if blames else []
    # Squares, over their variances, of the innovations that the filter used (time, m).
    squares = innovations.square_used()
    variance = np.asarray(innovations.variance)
    judged = []
    for i, (name, summary) in enumerate(zip(names, summaries, strict=True)):
        size, size_error = compute_ratio_of_squares(squares[:, i], expected[:, i])
        judged.append(
            OutputJudgement(
                output=name,
                to_blame=i in outlying,
                summary=summary,
                size=size,
                size_error=size_error,
                held=find_stuck_value(received[:, i], variance[:, i], NO_LAW if laws is None else laws[i]),
            )
        )
    return judged


class RecentInnovations:
    """Innovations of the newest rows of filters that weigh, summarised by output on request.

    `names`: of the received numbers, by node and filter; numbers from 1 where they are not known.
    """

    def __init__(self, rows: int, names: Mapping[tuple[str, str], Sequence[str]]):
        """Begin without rows; the newest `rows` rows are kept. `names` holds outputs' names by (node, filter)."""
        self.names = names
        self._rows: dict[tuple[str, str], deque[np.ndarray]] = defaultdict(lambda: deque(maxlen=rows))
        self.left_out = Counter[tuple[str, str]]()  # by (node, filter): how many numbers of all rows had weight 0

    def add(self, node: str, name: str, outputs: Mapping[str, Sequence[float | None]]) -> None:
        """Add a row: the innovation "value", "variance" and "weight" of each number, None if it did not arrive."""
        row = [outputs[field] for field in ("value", "variance", "weight")]
        self._rows[node, name].append(np.array(row, dtype=float))
        # A number that did not arrive has the weight None, and does not count.
        self.left_out[node, name] += sum(weight == 0 for weight in outputs["weight"])

    def summarise_outputs(self) -> list[OutputHealth]:
        """Return what the newest rows of each filter say about each of its outputs."""
        results = []
        for (node, name), rows in self._rows.items():
            innovations = Weighed(*np.moveaxis(np.array(rows), 1, 0))  # rows hold (value, variance, weight) each
            count = innovations.value.shape[1]
            names = list(self.names.get((node, name)) or [str(i + 1) for i in range(count)])
            unknown = np.full(innovations.value.shape, np.nan)  # what was received is not kept
            judged = judge_outputs(
                names, unknown, innovations, medians=np.zeros(count), blames=True, expected=np.ones_like(unknown)
            )
            results += [OutputHealth(node, name, weighs=True, judged=output) for output in judged]
        return results


def summarise_weighed_outputs(network: Network, record: Record) -> list[OutputHealth]:
    """Return what the innovations of all weighing filters say about each output of a recording.

    `record.weighed` has the innovations, variances and weights by node and filter. The judgement of an output has its
    bias, the share of its values that were weighted down, and whether it is to blame.
    """
    # Inputs are not needed (an empty array), since the record holds these filters' innovations.
    outputs: list[OutputHealth] = []
    no_inputs = np.zeros(0)
    for filter in yield_filters_with_measurements(network, record):
        if filter.name in record.weighed.get(filter.node, {}):
            outputs += judge_outputs_of_filter(network, filter, record, no_inputs)
    return outputs


def summarise_output(health: OutputHealth) -> dict[str, Json]:
    """Return the numbers on one output of a sensor for a summary, by name; None in place of NaN.

    They are of its innovations: mean (bias, with interval), mean square, and mean square over the claimed variance
    (size). If its filter weighs outputs: mean weight, and the share that was weighted down. held: a run of equal
    readings longer than noise allows. `health`: the output with its judgement.
    """
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
    """Return one output's names, its numbers, and a text on them.

    `health`: the output of a filter with its judgement; `summarise_output` has the numbers.
    """
    judged = health.judged
    words = str(judged.summary) + ("; to blame" if judged.to_blame else "")
    named: dict[str, Json] = {"node": health.node, "filter": health.filter, "output": judged.output, "words": words}
    return named | summarise_output(health)
