"""Estimates as lines of JSON, for a batch of rows at once, by a template that their numbers fill."""

import re
from collections.abc import Sequence
from math import isfinite

import numpy as np
from pydantic_core import to_json

from heliograph.filters.plausibility import Judgement
from heliograph.live.network_step_program import NetworkProgram
from heliograph.numerics.types import Float
from heliograph.simulation.rows.output_columns import FilterColumns

# A line begins with its kind, plant and time. The kind comes as text, plant and time come as JSON.
HEAD = b'{"kind":"%b","plant":%b,"time":%b,"estimates":'
FIRST = 2**52  # the number of column 0 where a row holds column numbers: no name contains it
COLUMN = re.compile(rb"(4503599627[0-9]{6})(\.0)?")


def encode_line(parts: object) -> bytes:
    """Return a value as one line of JSON, without the newline; numbers that are not finite become null."""
    return to_json(parts, inf_nan_mode="null")


class EstimateWriter:
    """Writer of the estimates of a network as lines of JSON.

    A row of which every filter has an estimate with a sound covariance, and used what it received, fills a template,
    the line of a row that holds column numbers. Any other row is written filter by filter.
    """

    def __init__(self, program: NetworkProgram):
        """Make the template of a line with the estimates of all filters of a network's program.

        The template is such a line with gaps in place of numbers. Most rows fit it: no variance is negative, no filter
        has a reason not to use what arrived, and all estimates are finite. The columns of a row's outputs that decide
        this are noted here.
        """
        all_filters = program.filter_columns  # for each filter the columns of its outputs
        n = self._n = len(program.network.states)
        self._nodes: dict[str, list[FilterColumns]] = {}
        for columns in all_filters:
            self._nodes.setdefault(columns.node, []).append(columns)
        # Variances of claimed covariances: the diagonal of (n, n) numbers that stand row after row.
        claimed = [columns.covariance for columns in all_filters if columns.claim != "none"]
        self._variances = [begin + i * (n + 1) for begin in claimed for i in range(n)]
        # Why a filter did not use what arrived; 0 if it did.
        self._reasons = [columns.judgement.reason for columns in all_filters if columns.judgement is not None]
        # What has to be finite: means, covariances, and the squared distances of the tests.
        self._finite = [i for columns in all_filters for i in range(columns.mean, columns.mean + n)]
        self._finite += [i for columns in all_filters for i in range(columns.covariance, columns.covariance + n * n)]
        self._finite += [columns.tested.distance for columns in all_filters if columns.tested is not None]
        # The template; by gap the column that fills it; the gaps that are written as whole numbers.
        self._template, self._order, self._whole = self._make_template(program.step_rows.outputs.size)

    def _make_template(self, size: int) -> tuple[bytes, list[int], list[int]]:
        """Return a template of the line of a row with `size` outputs, and two lists that say what fills it.

        The template has %b for each real number and %d for each integer. The lists hold the column of each gap in the
        template, and the gaps of integers. To find them, a line is written from a row with FIRST + its column number
        in each column. A number in this line (found by COLUMN) tells its column; without a point it is an integer.
        """
        column_numbers = FIRST + np.arange(float(size))
        column_numbers[self._reasons] = 0.0  # 0 means that nothing is refused
        line = encode_line(self._write_estimates(column_numbers.tolist()))
        gaps = COLUMN.findall(line)  # (digits, ".0" or nothing)
        template = COLUMN.sub(lambda match: b"%b" if match[2] else b"%d", line.replace(b"%", b"%%"))
        column_of_gap = [int(digits) - FIRST for digits, _ in gaps]
        integer_gaps = [i for i, (_, point) in enumerate(gaps) if not point]
        return HEAD + template + b"}", column_of_gap, integer_gaps

    def write_lines(
        self, kind: bytes, rows: Sequence[tuple[str, float | str]], outputs: Float[np.ndarray, "row outputs"]
    ) -> list[bytes]:
        """Return a line with the estimates of all filters for each row.

        Most lines differ in numbers only, so they fill a template (text with gaps for numbers), which is faster than
        writing JSON. `self._order` has the column of `outputs` for each gap.

        Args:
            kind: "final" or "provisional".
            rows: plant and time of each row.
            outputs: outputs of the network after each row.
        """
        if not rows:
            return []
        # The template fits rows whose numbers are finite, whose variances are not negative, and whose filters used all
        # that had arrived (reason 0). The three lists hold columns of `outputs`.
        is_finite = np.isfinite(outputs[:, self._finite]).all(axis=1)
        is_sound = (outputs[:, self._variances] >= 0).all(axis=1)
        is_used = (outputs[:, self._reasons] <= 0).all(axis=1)
        fits = is_finite & is_sound & is_used
        # The texts of all numbers at once, row after row, in the order in which a line has them.
        gap_count, texts = len(self._order), _write_numbers(outputs[:, self._order].ravel().tolist())
        # By gap of the template, what each row has there: every `gap_count`-th text. Whole numbers have no point.
        by_gap: list[Sequence[bytes | int]] = [texts[gap::gap_count] for gap in range(gap_count)]
        for gap in self._whole:
            by_gap[gap] = outputs[:, self._order[gap]].astype(int).tolist()
        # Each line begins with the kind, plant and time of its row; then the template takes the texts of its gaps.
        names = {plant: encode_line(plant) for plant in {plant for plant, _ in rows}}
        times = _write_numbers([time for _, time in rows])
        head = [kind] * len(rows), [names[plant] for plant, _ in rows], times
        lines = [self._template % of_row for of_row in zip(*head, *by_gap, strict=True)]
        # Rows that the template does not fit are written anew, filter by filter.
        for i in np.flatnonzero(~fits).tolist():
            estimates = self._write_estimates(outputs[i].tolist())
            lines[i] = HEAD % tuple(column[i] for column in head) + encode_line(estimates) + b"}"
        return lines

    def _write_estimates(self, outputs: list[float]) -> dict[str, dict[str, object]]:
        """Return all filters' estimates after a row, by node and filter, from the row's numbers `outputs`.

        `_nodes` maps a node to the columns of its filters among these numbers.
        """
        return {
            node: {columns.filter: self._tabulate_estimate(columns, outputs) for columns in filters}
            for node, filters in self._nodes.items()
        }

    def _tabulate_estimate(self, columns: FilterColumns, outputs: list[float]) -> dict[str, object]:
        """Return one filter's estimate, its claim and its innovation, as a table for JSON.

        `columns` are the filter's columns among `outputs`, the numbers of a row. The claim says what the covariance is
        worth: "exact", "upper" (a bound), "none" and so on.
        """
        n, begin = self._n, columns.covariance
        mean, covariance = outputs[columns.mean : columns.mean + n], outputs[begin : begin + n * n]  # row by row
        # An estimate with NaN, infinity or a negative variance claims nothing.
        claim, variances = columns.claim, covariance[:: n + 1]  # the diagonal
        if claim != "none":
            is_sound = all(map(isfinite, (*mean, *covariance))) and min(variances) >= 0
            claim = claim if is_sound else "none"
        rows = None if columns.claim == "none" else [covariance[i : i + n] for i in range(0, n * n, n)]
        results: dict[str, object] = {"mean": mean, "covariance": rows, "claim": claim}
        if columns.modes is not None:
            results["modes"] = outputs[slice(*columns.modes)]
        return results | self._tabulate_innovation(columns, outputs)

    def _tabulate_innovation(self, columns: FilterColumns, outputs: list[float]) -> dict[str, object]:
        """Return nis, the normalised innovation squared, and the count of numbers received; {} if there is no test.

        If the filter weighs outputs singly, "outputs" has each one's value, variance and weight. If it did not use the
        measurement, "implausible" is the reason. `columns`: where these are among the `outputs` of a row.
        """
        # A fusion: the nis of all that its nodes received, in the columns `tested` = (distance, number that arrived).
        if columns.tested is not None:
            nis, received = (outputs[column] for column in columns.tested)
            return {"nis": nis, "received": int(received) if isfinite(nis) else 0}
        # A filter: its own judgement of what it received. A fusion without a test has neither.
        judged = columns.judgement
        if judged is None:
            return {}
        results: dict[str, object] = {}
        if columns.weighed is not None:  # value, variance and weight: each the columns of all received numbers
            parts = columns.weighed._asdict().items()
            results["outputs"] = {name: [outputs[i] for i in indices] for name, indices in parts}
        if outputs[judged.reason] > 0:  # it did not use the measurement
            why = Judgement.describe(outputs[judged.reason], outputs[judged.distance])
            return results | {"nis": None, "received": 0, "implausible": why}
        return results | {"nis": outputs[judged.distance], "received": int(outputs[judged.arrived])}


def _write_numbers(numbers: Sequence[float | str]) -> list[bytes]:
    """Return each number, or text without a comma, as JSON writes it."""
    return encode_line(numbers)[1:-1].split(b",")
