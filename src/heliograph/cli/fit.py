"""`heliograph fit`: the free numbers of a network, learned from measured data."""

import re
import sys
from fractions import Fraction
from functools import partial
from math import isfinite
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from heliograph.cli.app_and_option_types import integer_option, measured_option, path_option
from heliograph.cli.measured_data import MeasuredPlant, ReadingOptions, read_measured_plants, take_only_plant
from heliograph.cli.stop_signals import GentleStop
from heliograph.files.stores.store_address import StoreAddress

if TYPE_CHECKING:
    from collections.abc import Callable

    from heliograph.files.recordings.recording import Recording
    from heliograph.learning import Fit, Share
    from heliograph.learning.held_out_comparison import HeldOutTransforms, PredictionBeforeAndAfter
    from heliograph.learning.packet_losses.learn_losses import Losses
    from heliograph.learning.packet_losses.packet_fates import Fates
    from heliograph.report.pages.fit import FitResults
    from heliograph.report.progress import Advance
    from heliograph.report.results_folder import Json, ResultsContent
    from heliograph.simulation.network import Network

STAGES = 6  # of the work, for the progress bar
STEPS = 100  # that a climb takes at most


def fit(
    network: str,
    /,
    *,
    measurements: Annotated[Path | StoreAddress, measured_option()],
    out: Annotated[Path, path_option("Folder of fitted.json, fitted_network.py, figures and page; made if missing.")],
    starts: Annotated[int, integer_option("From how many points to climb.")] = 6,
    seed: Annotated[int, integer_option("Seed of the starts.")] = 0,
    held_out: Annotated[float, Parameter(help="Share of the rows, the last ones, that only judge.")] = 0.25,
    truth: Annotated[bool, Parameter(help="Learn from the true states (columns truth.STATE).", negative="")] = False,
    reading: ReadingOptions | None = None,
) -> int:
    """Learn the numbers that your own network marks as free by hg.free, with intervals and identifiability.

    The estimates come from the earlier rows; the filters with them are judged on the later ones. Ctrl-C (or SIGTERM)
    ends the search and keeps the best so far; a second one ends at once.

    Parameters
    ----------
    network:
        A Python file or module that holds a heliograph.Network with hg.free in it: my_network.py, or my_network.py:name
        where it holds several. The name may be that of a function that returns one.
    """
    from heliograph.disk.kept_inputs import find_network_file, refuse_replacing
    from heliograph.numerics.check import check_count, check_seed, scalar
    from heliograph.report.results_folder import write_results

    # Check the options before the work starts.
    share = float(scalar("--held-out", held_out, 0.0, 0.9))
    check_count("--starts", starts)
    check_seed("--seed", seed)
    refuse_replacing([measurements, truth, find_network_file(network)], [], out)

    with GentleStop() as stop:

        def learn(advance: "Advance") -> "FitResults":
            """Return what is learned with the command line's options, until a signal stops it (`stop`).

            `share` is the share of the rows, the last ones, that only judge. `advance` shows the progress.
            """
            return fit_and_judge(
                network, measurements, starts, seed, share, advance, truth, reading or ReadingOptions(), stop
            )

        learned = write_results(out, STAGES, learn, lambda results: collect_results_files(results, out, network))
        print(learned.fit)
    for name in ("report.html", "fitted_network.py"):
        print(out / name)
    if stop.requested or learned.fit.stopped:
        print("heliograph: warning: stopped before the end; this is the best so far", file=sys.stderr)
    return stop.code


def fit_and_judge(
    network: str,
    measurements: Path | StoreAddress,
    starts: int,
    seed: int,
    held_out: float,
    advance: "Advance",
    truth: bool,
    reading: ReadingOptions,
    stop: GentleStop,
) -> "FitResults":
    """Fit the free numbers to the earlier rows; return the fit with what the filters make of the later (held-out) ones.

    `stop.run_unless_stopped(work)` returns what work returns, or None after a signal.

    Args:
        network: the network as the user names it, FILE or FILE:NAME.
        measurements: where the data are.
        starts: from how many points to climb.
        seed: seed of the starts.
        held_out: share of the rows, the last ones, that only judge.
        advance: called with the progress.
        truth: whether to learn from true states.
        reading: how the data are read.
        stop: signals of the user; after one no further part begins, and what is left out is empty.
    """
    advance("starting")
    from dataclasses import replace

    from heliograph.files.fitted import NetworkAgain
    from heliograph.learning.held_out_comparison import compare_before_and_after, transform_held_out
    from heliograph.learning.sender_fit import has_deciding_sender
    from heliograph.numerics.check import fail
    from heliograph.report.pages.fit import FitResults

    # The network as it starts, and the data.
    build = NetworkAgain(network)
    start = build()
    if has_deciding_sender(start):
        call = "hg.fit(hg.files.fitted.NetworkAgain(FILE), recording)"
        raise fail("network to be learned", f"no trigger of a node (in Python {call} learns it)", "one with a trigger")
    data = _read_rows_to_fit(measurements, network, start, advance, truth, reading)
    kept = start.drop_refused_readings(data.recording.measurements, data.recording.inputs)
    recording = data.recording._replace(measurements=kept)
    # Earlier rows to learn from, later ones to judge.
    rows = len(recording.time)
    learned_rows = rows - int(Fraction(str(held_out)) * rows)  # of 0.29 as it is written, not of the nearest double
    fitted = _fit_with_progress(build, recording, learned_rows, starts, seed, truth, advance, stop)
    fitted = replace(fitted, delays={} if data.events is None else data.events.delays())
    # How well each filter predicted the later rows before and after the fit (log-likelihood), and whether the fitted
    # laws hold there: the probability integral transforms of those rows are uniform then.
    z, u = recording.measurements, recording.inputs
    advance("judging on held-out rows")
    changes: list[PredictionBeforeAndAfter] = []
    uniform: list[HeldOutTransforms] = []
    if learned_rows < rows:
        compare = partial(compare_before_and_after, start, fitted.network, z, u, learned_rows)
        changes = stop.run_unless_stopped(compare) or []
    if changes:
        transform = partial(transform_held_out, fitted.network, changes, z, u, learned_rows)
        uniform = stop.run_unless_stopped(transform) or []
    # The law of lost messages, by node of which some were lost.
    advance("looking at losses")
    losses = stop.run_unless_stopped(lambda: _estimate_losses_by_node(start, data.recording)) or {}
    return FitResults(network, str(measurements), fitted, learned_rows, rows - learned_rows, changes, uniform, losses)


def _estimate_losses_by_node(network: "Network", recording: "Recording") -> "dict[str, Losses]":
    """Return the statistics of losses for each node with both arrived and lost messages.

    `fates` are a node's sequences of flags: whether each message arrived. `learn_losses` fits laws of losses to them.
    """
    from heliograph.learning.packet_losses.learn_losses import learn_losses

    losses = {}
    for name, fates in _find_message_fates(network, recording).items():
        some_were_lost = any(0 < fates_in_sequence.mean() < 1 for fates_in_sequence in fates)
        if some_were_lost:
            losses[name] = learn_losses(fates)
    return losses


def _find_message_fates(network: "Network", recording: "Recording") -> "dict[str, Fates]":
    """Return which messages of each node arrived, of all that were due, by node or "node.component".

    Nodes are left out of which nobody knows when a message is due. Those are nodes without a rate of their own, where
    each row is a message of one node. `list_arrivals` says of each received number when it arrived: `due` is None if
    nobody knows when messages are due, and `numbers` are those of the arrived among the due.
    """
    from heliograph.learning.packet_losses.packet_fates import fates_of_measurements, fates_of_sequence
    from heliograph.report.diagnosis.arrivals import list_arrivals

    fates = fates_of_measurements(recording.measurements)
    for arrivals in list_arrivals(network, recording.time, recording.measurements):
        component = network.nodes[arrivals.node].received_names.index(arrivals.component)
        # The node's components are one packet, or each is one of its own.
        name = arrivals.node if arrivals.node in fates else f"{arrivals.node}.{component}"
        if arrivals.due is None:
            fates.pop(name, None)
        elif arrivals.due_in != "each row" and name in fates and arrivals.arrived.any():
            fates[name] = fates_of_sequence(arrivals.numbers)
    return fates


def _read_rows_to_fit(
    measurements: Path | StoreAddress,
    reference: str,
    network: "Network",
    advance: "Advance",
    truth: bool,
    reading: ReadingOptions,
) -> MeasuredPlant:
    """Return the measured rows of the only plant, and print what was used, left out, or could not be read.

    Args:
        measurements: a table of rows, messages (put in rows by the time of measuring), or a store.
        reference: the network as the user named it, FILE or FILE:NAME.
        network: the network.
        advance: called with the progress.
        truth: whether the rows must have the true states.
        reading: how the data are read.

    Raises:
        ValueError: data of several plants, or no true states where they are needed.
    """
    from heliograph.disk.quoted_text import visible
    from heliograph.files.network_file import load_module
    from heliograph.numerics.check import fail

    module = load_module(reference)[1]
    data = take_only_plant(
        measurements, read_measured_plants(measurements, reference, network, module, reading, advance)
    )
    for line in data.warnings:
        print(f"heliograph: warning: {visible(line)}", file=sys.stderr)
    for line in data.summary:
        print(visible(line))
    if truth and data.recording.truth is None:
        raise fail(f"{measurements}", "columns of the true states, truth.STATE, for --truth", "none")
    return data


def _fit_with_progress(
    build: "Callable[[], Network]",
    recording: "Recording",
    rows: int,
    starts: int,
    seed: int,
    truth: bool,
    advance: "Advance",
    stop: GentleStop,
) -> "Fit":
    """Return the fit to the first rows, with progress by iterations of the search; after each it may be stopped.

    Args:
        build: returns the network, in which some numbers are free to be learned.
        recording: measurements by node, inputs, times and, if known, true states, a row for each time.
        rows: number of rows to learn from.
        starts: number of starting points of the search.
        seed: seed of the starting points.
        truth: whether estimates are compared with true states, not predictions with measurements.
        advance: shows a text and how many of how many iterations are done.
        stop: holds signals such as Ctrl-C; the first ends the search with the best result so far.
    """
    from heliograph.files.recordings.recording import Recording
    from heliograph.learning.fit_result import Fit
    from heliograph.learning.fitting import fit as learn_from

    first_rows = Recording(
        {node: z[:rows] for node, z in recording.measurements.items()},
        recording.inputs[:rows],
        recording.time[:rows],
        None if recording.truth is None else recording.truth[:rows],
    )

    def show_progress(line: str) -> None:
        """Show a line of the search, such as "linear: step 3", on the bar; end the search after a signal.

        A search has at most STEPS steps. `stop` holds the signals that came.
        """
        stop.raise_if_requested()
        stop.note_next_signal_only()  # there is a best result so far, which the next signal keeps
        form, _, state_of_search = line.partition(":")
        match = re.match(r" step ([0-9]+)", state_of_search)
        step = int(match[1]) if match else STEPS
        advance(f"learning from {rows} rows ({form})", step, STEPS)

    fitted = learn_from(build, first_rows, starts=starts, seed=seed, progress=show_progress, truth=truth)
    assert isinstance(fitted, Fit)  # since no sender decides
    return fitted


def collect_results_files(learned: "FitResults", out: Path, network: str) -> "ResultsContent":
    """Return what goes into the results folder `out` of a fit: figures, page, summary, network with the fitted numbers.

    `network` is the network as the user named it, FILE or FILE:NAME. `learned`: the fit, with what filters predict of
    the rows that were held out.
    """
    from heliograph.files.fitted import as_json, write_fitted
    from heliograph.report.pages.fit import draw_fit_figures, make_page_of_drawings
    from heliograph.report.results_folder import ResultsContent

    content = as_json(learned.fit, network=learned.network, measurements=learned.measurements, rows=learned.learned)

    def write(folder: Path) -> None:
        """Write fitted.json and the network with the fitted numbers into a folder, which is later renamed to `out`.

        `content` has the fitted numbers; `network` is the network as the user names it, FILE or FILE:NAME.
        """
        write_fitted(content, network, learned.measurements, folder, out)

    summary = {**content, "held_out_rows": learned.held_out, **_convert_comparison_to_json(learned)}
    return ResultsContent(draw_fit_figures(learned), make_page_of_drawings(learned), summary, write)


def _convert_comparison_to_json(learned: "FitResults") -> "dict[str, Json]":
    """Return how each filter predicted before and after the fit, and the laws of lost messages by node, for JSON.

    Args:
        learned: results of a fit of a network to a recording. `changes` has for each filter its node and name, the
            `gain` of the log-likelihood per row (`difference` with `standard_error`, or None), and tests of its
            innovations `before` and `after` (None where there is none). `losses` has for each node the laws of its lost
            messages.
    """
    # Each filter, on rows that were not fitted. "size": the mean square of the innovations over the claimed one
    # (`power` of their test). "p": the p-value of their whiteness.
    filters: list[Json] = [
        {
            "node": change.node,
            "filter": change.filter,
            "gain": change.gain and change.gain.difference,
            "gain_error": change.gain and change.gain.standard_error,
            "size_before": None if change.before.test is None else change.before.test.power,
            "size_after": None if change.after.test is None else change.after.test.power,
            "p_before": None if change.before.test is None else change.before.test.p_value,
            "p_after": None if change.after.test is None else change.after.test.p_value,
        }
        for change in learned.changes
    ]
    # Each node: numbers of packets, the law of losses that predicts best, the p-value of independent losses, the
    # probabilities of each fitted law, and each law's gain on packets that were not fitted.
    losses: dict[str, Json] = {
        name: {
            "packets": loss.packets,
            "lost": loss.lost,
            "best": loss.best,
            "memory_p": loss.memory.likelihood_p,
            "laws": {
                name_of_law: {key: _convert_share_to_json(share) for key, share in law.shares().items()}
                for name_of_law, law in loss.laws.items()
            },
            "gains": {name_of_law: score.gain for name_of_law, score in loss.held_out.items()},
        }
        for name, loss in learned.losses.items()
    }
    return {"filters": filters, "losses": losses}


def _convert_share_to_json(share: "Share") -> "dict[str, Json]":
    """Return a share and its interval by name; None if nothing was counted."""
    return {key: value if isfinite(value) else None for key, value in share._asdict().items()}
