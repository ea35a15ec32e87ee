"""What a recording says of a network: how reliable its links are, and which filters its innovations contradict."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import NamedTuple

import numpy as np

from heliograph.model.checks.refusal_reasons import Reason
from heliograph.model.readings.timeouts import LongSilences
from heliograph.numerics.confidence_intervals import average_correlated
from heliograph.report.diagnosis.arrivals import Arrivals
from heliograph.report.diagnosis.constant_sensor_error import ConstantError
from heliograph.report.diagnosis.doubt_sentences import (
    say_constant_error,
    say_declared_variances_are_off,
    say_how_to_refuse_repeats,
    say_innovation_is_impossible,
    say_innovations_are_correlated,
    say_node_differs,
    say_overconfident,
    say_underconfident,
)
from heliograph.report.diagnosis.innovation_tests import (
    LAGS,
    find_impossible_innovation,
    find_memory,
    judge_size,
)
from heliograph.report.diagnosis.sensor_output_health import (
    OutputHealth,
)
from heliograph.report.diagnosis.stuck_sensors import StuckValue
from heliograph.report.forecast_figures import Forecasts, Residuals
from heliograph.simulation.declared_noise.judgement import DeclaredJudgement
from heliograph.simulation.network import Network
from heliograph.simulation.results.record import Record
from heliograph.simulation.results.whiteness import MemoryTest

FALSE = 0.001  # probability of a false warning by one kind of test, of all filters together
PULLED = 0.25  # of the largest excess of a mean square over its claim: what is less goes with it
TYPICAL = 1.25  # ratio of the mean squares of one run and of all, from which its innovations need not be white
LEAST_SHARE = 0.01  # of the variance of innovations that those before predict, below which none is worth a warning


@dataclass(frozen=True)
class FilterHealth:
    """Innovations of one filter in units of its claim, and the test of their whiteness.

    Args:
        node: the node that it listens to, or "fused".
        filter: its name.
        claim: what its covariance claims to be.
        white: innovations in units of their claim (time, m); None for a filter without a claim.
        test: of their whiteness; None also where there are too few rows.
        trusted: whether the network relies on it (default True).
        declared: judgements of the variances that messages declare, one for each link that does.
        unit: of the plant's time (default "steps").
        expected: mean square of the innovations in this run over that in all runs, by the claim (default 1).
    """

    node: str
    filter: str
    claim: str
    white: np.ndarray | None
    test: MemoryTest | None
    trusted: bool = True
    declared: tuple[DeclaredJudgement, ...] = ()
    unit: str = "steps"
    expected: float = 1.0

    @property
    def numbers(self) -> int:
        """Return how many innovations were tested, over all rows and outputs; 0 for a filter without a claim."""
        return 0 if self.white is None else int(np.count_nonzero(~np.isnan(self.white)))


class _MeanSquare(NamedTuple):
    """Mean of innovation^2 / claimed variance, 1 where the claim holds; its standard error, and of how many numbers."""

    size: float
    error: float
    numbers: int


@dataclass(frozen=True)
class Health:
    """A record, with the diagnosis of links and filters."""

    record: Record
    links: list[Arrivals]
    filters: list[FilterHealth]
    outputs: list[OutputHealth]  # of each filter that claims a covariance
    shared: dict[str, tuple[str, ...]]  # {name of what several nodes share: these nodes}
    beliefs: tuple[str, ...] = ()  # a sentence on each filter whose model is not that of the network
    forecasts: Forecasts = field(default_factory=dict)  # by node and filter, where some were asked for
    predicted: Forecasts = field(default_factory=dict)  # of each row, by node and filter, where it was asked for
    residuals: Residuals = field(default_factory=dict)  # (measured - predicted) / deviation, likewise
    constant_errors: Mapping[tuple[str, str], ConstantError] = field(
        default_factory=dict
    )  # by node and filter, where it says most
    error_between_nodes: ConstantError | None = None  # of one node against the others, which filter by themselves
    doubtful_estimates: tuple[str, ...] = ()  # of estimates where no sensor shows a state any more, or at a limit
    silences: Mapping[str, LongSilences] = field(default_factory=dict)  # by node that was silent past its timeout
    refused_messages: Mapping[str, Mapping[Reason, int]] = field(default_factory=dict)  # by node: for flag or counter
    time_unit: str = ""  # that times are in another unit than the plant's, which explains what is doubtful

    def warnings(self) -> list[str]:
        """Return one line for each reason to doubt the network, the weightiest first.

        `silences` has by node how long it was silent past its timeout, `doubtful_estimates` lines on estimates that
        cannot be right, and `time_unit` the sentence on times in a wrong unit, "" if there is none.
        """
        lines = [*self.record.failures(), *self.describe_stuck_outputs().values(), *self.doubtful_estimates]
        lines += [f"{node}: {found.describe()}" for node, found in self.silences.items()]
        lines += self._describe_losses()
        if self.error_between_nodes is not None:
            lines.append(say_node_differs(self.error_between_nodes))
        if self.time_unit:
            lines.append(self.time_unit)
        return lines + [line for filter in self.list_doubted_filters() for line in self._describe_doubts(filter)]

    def _describe_losses(self) -> Iterator[str]:
        """Yield a line for each link that never delivers, or that loses more or less than the network says.

        A link is one received number of a node. `share` is the share of due messages that arrived; `contradicts` tests
        it against the stated share, at a level that all links share.
        """
        for link in self.links:
            name = f"{link.node}: {link.component}"
            if not link.arrived.any():
                yield f"{name} never arrived"
            elif link.refuses:  # what it refused is missing
                continue
            elif not link.may_be_lost and link.share < 1:
                yield f"{name} is missing in {1 - link.share:.1%} of the rows; the network says that it is never lost"
            elif link.contradicts(FALSE / len(self.links)):
                yield f"{name} arrived in {link.share:.1%}; the network says that {link.stated_share:.1%} do"

    def describe_stuck_outputs(self) -> dict[tuple[str, str], str]:
        """Return {(node, output): line} for each output that repeats one value for longer than its noise allows.

        Only filters that the network relies on (`trusted`) count. An output used by a node's filter and by a central
        one has one line, from the node's filter.
        """
        trusted = {(filter.node, filter.filter) for filter in self.filters if filter.trusted}
        # Central filters first, whose outputs are named "node: output": those of nodes' own filters replace them.
        held_outputs: dict[str, tuple[str, str, StuckValue]] = {}
        for health in sorted(self.outputs, key=lambda output: output.node != Network.FUSED):
            output = health.judged.output
            name = output if health.node == Network.FUSED else f"{health.node}: {output}"
            if health.judged.held is not None and (health.node, health.filter) in trusted:
                held_outputs[name] = health.node, output, health.judged.held
        # Outputs whose repeated values the node refuses already.
        watched = {f"{link.node}: {link.component}" for link in self.links if link.watched}
        return {
            (node, output): f"{name} is stuck, or has no noise: {held}, where its noise makes no run as long; "
            f"{say_how_to_refuse_repeats(held, name in watched)}"
            for name, (node, output, held) in held_outputs.items()
        }

    def list_doubted_filters(self) -> list[FilterHealth]:
        """Return the filters that the network relies on and whose claims the recording contradicts.

        Filters that use a stuck output are left out: their innovations show only that. `describe_stuck_outputs` has
        such outputs by (node, output); `_describe_doubts` yields a sentence for each doubt.
        """
        stuck = {node for node, _ in self.describe_stuck_outputs()}

        def is_doubted(health: FilterHealth) -> bool:
            """Return whether a filter is trusted, uses no stuck output, and has doubts."""
            uses_stuck = health.node in stuck or (bool(stuck) and health.node == Network.FUSED)
            return health.trusted and not uses_stuck and any(self._describe_doubts(health))

        return [health for health in self.filters if is_doubted(health)]

    def remarks(self) -> list[str]:
        """Return one line for each doubt about a filter that the network does not rely on, but has for comparison."""
        return [line for filter in self.filters if not filter.trusted for line in self._describe_doubts(filter)]

    def _describe_doubts(self, health: FilterHealth) -> Iterator[str]:
        """Yield sentences on how the innovations of a filter contradict its model, the gravest first.

        These are: outputs left out, a constant error, variances reported with messages (`declared`), an impossible
        innovation in a short recording, sizes other than claimed, and correlation in time (memory). A doubt that
        explains later ones ends the list. `health` holds the innovations of one filter of a node and their tests:
        `test` is that of size and whiteness, None with too few rows. `FALSE`: probability of a false warning by this
        test, over all filters together.
        """
        yield from self._describe_left_out(health)
        name = f"{health.node}/{health.filter}"
        error = self.constant_errors.get((health.node, health.filter))
        if error is not None:
            yield say_constant_error(name, error)
            if error.nothing_else:  # a constant error explains all other doubts too
                return
        on_declared = say_declared_variances_are_off(health.declared, health.unit)
        yield from (f"{name}: {sentence}" for sentence in on_declared)
        # Too few rows for a test: still, one innovation may be larger than chance allows among all numbers judged.
        if health.test is None:
            numbers = sum(filter.numbers for filter in self.filters)
            found = find_impossible_innovation(health.white, FALSE / numbers) if numbers else None
            if found is not None:
                yield say_innovation_is_impossible(name, found, FALSE)
        if on_declared or health.test is None:  # wrong declared variances explain sizes and memory
            return
        yield from self._describe_sizes(health, health.test)
        if self._has_memory(health, health.test):
            yield say_innovations_are_correlated(name, health.test)

    def _level_of_one_test(self) -> float:
        """Return the probability of a false alarm that the test of one filter may have.

        It is FALSE divided by the number of tested filters, so that all together are wrong with FALSE (Bonferroni).
        """
        return FALSE / sum(filter.test is not None for filter in self.filters)

    def _describe_sizes(self, health: FilterHealth, test: MemoryTest) -> Iterator[str]:
        """Yield a sentence on the outputs whose innovations are larger than claimed, and one on those that are smaller.

        Each output is judged by itself, since a mean over outputs hides the one that is wrong; all are judged together
        where none is wrong by itself. `health`: the filter's innovations. `test`: of these over all outputs, with their
        mean square `power` and its standard error. Enough are more than LAGS (10) innovations.
        """
        # `level`: probability of a false alarm that one test may have.
        name = f"{health.node}/{health.filter}"
        level = self._level_of_one_test()
        of_filter = [one for one in self.outputs if (one.node, one.filter) == (health.node, health.filter)]
        # Mean squares of the outputs with enough innovations, and their signs: 1 if significantly too large, -1 if too
        # small, else 0.
        judged = [output.judged for output in of_filter if output.judged.summary.received > LAGS]
        measured = {one.output: _MeanSquare(one.size, one.size_error, one.summary.received) for one in judged}
        signs = {output: judge_size(*square, level / len(measured)) for output, square in measured.items()}
        if not any(signs.values()):  # none is wrong by itself: judge all together, under the name ""
            measured = {"": _MeanSquare(test.power, test.power_error, health.numbers)}
            signs = {"": judge_size(*measured[""], level)}
        sizes = {output: square.size for output, square in measured.items()}
        larger = [output for output, sign in signs.items() if sign > 0]
        # An output that is far off spoils the estimates, so that others look a little larger too: these are not named.
        largest_excess = max((sizes[output] - 1 for output in larger), default=0.0)
        larger = [output for output in larger if sizes[output] - 1 >= PULLED * largest_excess]
        # A filter that weighs outliers down has smaller innovations where there are none: no fault.
        weighs_any = any(output.weighs for output in of_filter)
        smaller = [output for output, sign in signs.items() if sign < 0 and not weighs_any]
        for named, say in ((larger, say_overconfident), (smaller, say_underconfident)):
            if named:  # an only output, or all together, needs no name in the sentence
                yield say(name, named if len(sizes) > 1 else [""], [sizes[output] for output in named])

    def explains_all_innovations(self, health: FilterHealth, error: ConstantError) -> bool:
        """Return whether the innovations of a filter, less the effect of a constant error, are as the filter claims.

        Then their squares are as large as claimed, and they are not correlated in time. `error.white` are these
        innovations over their deviations, (time, m), and `error.squares` the squares, NaN where none came. `judge_size`
        returns 0 if a mean square, with its standard error, differs from 1 only by chance at `level`. `health`: the
        filter.
        """
        level = self._level_of_one_test() / error.squares.shape[1]
        for squares_of_output in error.squares.T:
            count = int(np.count_nonzero(~np.isnan(squares_of_output)))
            if count and judge_size(*average_correlated(squares_of_output), count, level):
                return False
        test = find_memory(error.white)
        return test is None or not self._has_memory(health, test)

    def _has_memory(self, health: FilterHealth, test: MemoryTest) -> bool:
        """Return whether innovations predict later ones (by the last one or by several) more than by chance.

        Among N independent numbers, each lag seems to predict 1 / N of the variance. LEAST_SHARE is 1 % of the
        variance: less is not worth a warning. `health`: the filter with its innovations. `test`: their correlations at
        each lag, with p-values of the first lag and of all, and the share of their variance that is `predictable`.
        """
        # Gains are optimal for the mean over all possible runs. `expected`: the mean square innovation of this run's
        # gains and losses over that mean. Beyond a factor TYPICAL innovations of a right model are correlated as well.
        if abs(np.log(health.expected)) > np.log(TYPICAL):
            return False
        by_chance = len(test.correlation) / health.numbers if health.numbers else 0.0
        probability = 2 * min(test.p_value, test.p_value_of_all)  # of two tests the smaller p-value counts (Bonferroni)
        return probability < self._level_of_one_test() and test.predictable - by_chance >= LEAST_SHARE

    def _describe_left_out(self, health: FilterHealth) -> Iterator[str]:
        """Yield sentences on outputs of which a filter that weighs outliers down left out many values.

        `heliograph.run` warns in the same words. `output.weighs` says whether the filter weighs outliers down;
        `summary.describe_left_out` yields the sentences.
        """
        for output in self.outputs:
            if output.weighs and (output.node, output.filter) == (health.node, health.filter):
                yield from output.judged.summary.describe_left_out(
                    f"{health.node}/{health.filter}", output.judged.output
                )
