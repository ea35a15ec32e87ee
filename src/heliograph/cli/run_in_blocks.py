"""`heliograph run` over a recording too long to be held: its rows are filtered and written in blocks."""

import re
import sys
from collections import Counter
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

from heliograph.cli.filter_plant import filter_rows
from heliograph.cli.measured_data import ReadingOptions, describe_refusals
from heliograph.files.stores.store_address import StoreAddress
from heliograph.files.tables.block_size import USUAL_BLOCK, BlockSize

if TYPE_CHECKING:
    from heliograph.report.progress import Advance
    from heliograph.simulation.network import Network
    from heliograph.simulation.results.record import Record

LONG = BlockSize(rows=1 << 18, bytes=1 << 24)  # a table beyond is filtered in blocks
MOST = 1 << 25  # rows out of order that are held at once
NUMBER = re.compile(r"(?<![\w'\"])[-+]?\d+(?:\.\d+)?(?:e[-+]?\d+)?(?![\w'\"])")  # that is no part of a name


class AllRowsNeededError(Exception):
    """Why all rows of a recording are held in memory at once, in words."""


class PrintedLines(NamedTuple):
    """Lines that the command prints on a table that it filtered in blocks: warnings, and what was written where."""

    warnings: list[str]
    summary: list[str]


def run_in_blocks(
    network: "Network",
    module: Mapping[str, object],
    measurements: Path | StoreAddress,
    out: Path | StoreAddress | None,
    others: Iterable[str],
    options: ReadingOptions,
    advance: "Advance",
) -> PrintedLines | None:
    """Filter a long table of rows of time, and write the estimates to a table.

    Blocks of rows are read, filtered and written one after another, so that memory does not grow with the table.

    Args:
        network: the network.
        module: names and values of the file of Python that the network stands in; "sources" may be one.
        measurements: the file.
        out: where the estimates go.
        others: options that the user gave and that need all rows at once.
        options: how the file is read.
        advance: called with the progress.

    Returns:
        Lines to print about the run. None if nothing was written, and the caller must read all rows at once: the table
        is not long, or has messages instead of rows of time, or an option needs all rows, which is then said on the
        standard error.

    Raises:
        ValueError: what cannot be read; very many rows that are out of order.
    """
    from heliograph.files.messages.messages_to_events import is_of_messages

    if not isinstance(measurements, Path) or options.are_for_messages or not is_long(measurements):
        return None
    if is_of_messages(measurements, module.get("sources")):
        return None
    try:
        _check_blocks_suffice(network, out, others)
        assert isinstance(out, Path)  # as was checked
        return filter_in_blocks(network, measurements, out, options, advance)
    except AllRowsNeededError as needed:
        from heliograph.disk.quoted_text import visible

        line = f"{measurements}: all rows are held in memory at once: {needed}"
        print("heliograph:", visible(line), file=sys.stderr)
        return None


def is_long(path: Path, limit: BlockSize = LONG) -> bool:
    """Return whether a table is too long to be read at once: CSV of too many bytes, or Parquet of too many rows.

    `limit`: by default 16 MiB and 262,144 rows.
    """
    from heliograph.files.text.text_file import find_extension

    if not path.is_file():
        return False
    if find_extension(path) != ".parquet":
        return find_extension(path) == ".csv" and path.stat().st_size > limit.bytes
    import pyarrow as pa
    import pyarrow.parquet as pq

    try:
        return int(pq.read_metadata(path).num_rows) > limit.rows
    except (pa.ArrowInvalid, OSError):  # the reader will say what is wrong
        return False


def _check_blocks_suffice(network: "Network", out: Path | StoreAddress | None, others: Iterable[str]) -> None:
    """Raise AllRowsNeededError where options, the output or the network need all rows at once.

    `others`: the options that are given and need all rows. Blocks are written as tables of FORMATS alone. `out`: where
    estimates go, None for nowhere.
    """
    from heliograph.disk.atomic_files import FORMATS
    from heliograph.fusion.network_fusion import Fusion

    options = list(others)
    if options:
        raise AllRowsNeededError(f"{' and '.join(options)} {'need' if len(options) > 1 else 'needs'} them")
    if not isinstance(out, Path) or out.suffix.lower() not in FORMATS:
        raise AllRowsNeededError(f"blocks go to {' or '.join(FORMATS)} alone, not to {out}")
    # Fusions whose messages take rows on their way, perhaps into the next block.
    of_centres = [name for name, fused in network.fused.items() if isinstance(fused, Fusion) and fused.by_report]
    with_delays = [*network.meshes, *of_centres]
    if with_delays:
        raise AllRowsNeededError(f"messages of the fusion {with_delays[0]} may come rows later")


def filter_in_blocks(
    network: "Network",
    path: Path,
    out: Path,
    options: ReadingOptions,
    advance: "Advance",
    block: BlockSize = USUAL_BLOCK,
    most: int = MOST,
) -> PrintedLines:
    """Filter the rows of a table and write the estimates, block by block; return what is to be said of it.

    `RecordingBlocks` yields parts of the table as recordings; after the last it has counts and reasons of refused rows,
    notes and doubts. A `RowsNotInBlocksError` says that only all rows together show their order.

    Args:
        network: the network.
        path: the table, CSV or Parquet.
        out: a file of one of these.
        options: how the table is read.
        advance: called with the progress.
        block: how much is in memory at a time.
        most: rows up to which those that are out of order are held at once.

    Raises:
        AllRowsNeededError: all rows are needed at once; nothing is written.
        ValueError: what cannot be read; more than `most` rows that are out of order.
    """
    from heliograph.files.estimates.estimates_table import estimate_columns
    from heliograph.files.recordings.recording_blocks import RecordingBlocks
    from heliograph.files.recordings.row_order_across_blocks import RowsNotInBlocksError
    from heliograph.files.tables.table_writer import open_table
    from heliograph.numerics.check import InputError

    def progress(done: int, total: int) -> None:
        """Show how much of the table is read and filtered."""
        advance(f"filtering {path}", done, total)

    blocks = RecordingBlocks(path, network, options.strict, options.ignore_unknown, block, progress)
    written, doubts = WrittenRowCounts(), MergedBlockWarnings()
    record: Record | None = None  # of the block before, from whose end the filters go on
    try:
        with open_table(out) as append:
            for recording in blocks:
                # Numbers over all rows are printed of errors, and of values that filters doubt.
                if recording.truth is not None:
                    raise AllRowsNeededError("errors are of the truth in all of them")
                record, warned = filter_rows(network, recording, after=record)
                if weighing := [f"{node}/{name}" for node, filters in record.weighed.items() for name in filters]:
                    raise AllRowsNeededError(f"what {weighing[0]} weighs is judged by all of them")
                append(estimate_columns(record))
                written.add(record)
                first_row = written.rows - len(record.time) + 1
                doubts.add([*record.failures(), *warned], first=first_row, last=written.rows)
    except RowsNotInBlocksError as error:
        # A table of up to `most` rows is read once more as a whole; of a longer one that would take too much memory.
        if blocks.expected_rows > most:
            limit = f"more than {most:,} rows are read in blocks of {block.rows:,}, and may be out of order within one"
            raise InputError(f"{error}: {limit}: sort the file by time, or correct the row") from None
        raise AllRowsNeededError(str(error)) from None
    refused = (
        [describe_refusals(path, "rows", blocks.refused, list(map(str, blocks.reasons)))] if blocks.refused else []
    )
    return PrintedLines(
        warnings=[*refused, *blocks.notes, *blocks.doubts, *doubts.list_lines()], summary=[written.describe(out)]
    )


class WrittenRowCounts:
    """Counts of the rows whose estimates were written, and of those in which a filter claims nothing.

    Attributes:
        rows: how many there are.
    """

    def __init__(self) -> None:
        """Begin before any row is written."""
        self.rows = 0
        # By "node/filter": what a filter's estimates claim, and in how many rows they claim nothing.
        self._claims, self._rows_without = dict[str, str](), Counter[str]()

    def add(self, record: "Record") -> None:
        """Count the rows of a record, and by "node/filter" the rows in which a filter with a claim claims nothing."""
        self.rows += len(record.time)
        for node, filters in record.estimates.items():
            for name, estimate in filters.items():
                self._claims[f"{node}/{name}"] = estimate.claim
                if estimate.claim != "none":
                    self._rows_without[f"{node}/{name}"] += int((estimate.claims == "none").sum())

    def describe(self, *targets: object) -> str:
        """Return a line on what was written where: "out.csv: 3 rows of a/kf (exact, none of 2 rows)".

        In the example the claim is "exact", but in 2 rows nothing is claimed.
        """
        filters = []
        for name, claim in self._claims.items():
            without = f", none of {self._rows_without[name]} rows" if self._rows_without[name] else ""
            filters.append(f"{name} ({claim}{without})")
        return f"{' and '.join(map(str, targets))}: {self.rows} rows of {', '.join(filters)}"


class MergedBlockWarnings:
    """Lines on blocks of rows: those that differ in their numbers alone are one, of the first block that has it."""

    def __init__(self) -> None:
        """Begin without blocks and lines; the keys of the dictionaries are lines without their numbers."""
        self._blocks = 0
        self._first = dict[str, tuple[str, str]]()  # words on the block's rows, and the first such line
        self._more = Counter[str]()  # in how many later blocks such a line came again

    def add(self, lines: Iterable[str], first: int, last: int) -> None:
        """Add the lines on a block, which count rows from 1; `first` and `last` are the numbers of its rows.

        Lines that differ only in numbers (NUMBER) are kept once. `self._more` counts later blocks with such a line.
        """
        self._blocks += 1
        kinds_in_block = set[str]()
        for line in lines:
            kind = NUMBER.sub("0", line)
            if kind not in self._first:
                self._first[kind] = f"of the rows {first} to {last}, counted from 1: ", line
            elif kind not in kinds_in_block:
                self._more[kind] += 1
            kinds_in_block.add(kind)

    def list_lines(self) -> list[str]:
        """Return the lines; if there are several blocks, each line names the rows of its block."""
        if self._blocks == 1:
            return [line for _, line in self._first.values()]
        lines = []
        for kind, (rows, line) in self._first.items():
            count = self._more[kind]
            lines.append(f"{rows}{line} (likewise in {count} later blocks)" if count else f"{rows}{line}")
        return lines
