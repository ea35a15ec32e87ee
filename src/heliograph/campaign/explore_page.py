"""Interactive page of a campaign's scores, of all states and of single ones over time, on which one chooses."""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import groupby
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
import zarr

from heliograph.campaign.definition import BITWISE, Campaign
from heliograph.campaign.report_page import describe_best_filter, draw_score_pictures, make_score_table
from heliograph.campaign.summary import SUMMARY, Score, read_summary
from heliograph.campaign.zarr_store import (
    CLAIM,
    STORE,
    AxisLabels,
    find_done_chunks,
    list_parameter_values,
    read_labels,
    restore_campaign,
)
from heliograph.numerics.check import fail, file_path
from heliograph.report.pages.explore import STATIC, ExploredTable, PlotColumn, Value, make_explorable_page_html
from heliograph.report.pages.page import Page, Points, Section


@dataclass(frozen=True)
class StateScore:
    """Scores of one state of one filter over the finite runs, at a step counted from 1, or over all steps (`step` 0).

    `claimed` is the root of the mean claimed variance, `nees_per_dimension` the mean of the squared error over the
    claimed variance, 1 if the claim is exact. Standard errors are from the scatter between runs; NaN without finite
    runs.
    """

    setting: int
    node: str
    filter: str
    claim: str
    state: str
    step: int
    rmse: float
    rmse_error: float
    claimed: float
    nees_per_dimension: float
    nees_error: float
    finite_runs: int


def list_state_scores(
    store: Path, campaign: Campaign, settings: Sequence[int], steps: Sequence[int]
) -> list[StateScore]:
    """Return the scores of every state of every filter: over all steps (0), then at each of `steps`.

    Args:
        store: path of the store, of which the runs that are there count.
        campaign: the campaign.
        settings: numbers of the settings.
        steps: numbers of the steps, from 1.
    """
    group, labels = zarr.open_group(store, mode="r"), read_labels(store)
    claims, done = np.asarray(group[CLAIM]), find_done_chunks(store, campaign)
    results: list[StateScore] = []
    for setting in settings:
        chunks = [chunk for chunk in campaign.chunks(setting) if (setting, chunk.number) in done]
        sums_of_chunks = [
            _sum_errors(group, setting, slice(chunk.start, chunk.stop), claims[setting], steps) for chunk in chunks
        ]
        if sums_of_chunks:
            runs, values, squares = (np.sum(of_field, axis=0) for of_field in zip(*sums_of_chunks, strict=True))
            sums = ErrorSums(runs, values, squares)  # of all chunks together
            results += _compute_state_scores(setting, labels, claims[setting], [0, *steps], sums)
    return results


class ErrorSums(NamedTuple):
    """Sums over the finite runs of a setting.

    Values are, along the first axis: squared error, claimed variance, and the quotient of the two. Along the second
    axis is their mean over all steps first, then they at each given step.
    Shapes: runs (node, filter), values and squares (value, step, node, filter, state).
    """

    runs: np.ndarray
    values: np.ndarray
    squares: np.ndarray


def _sum_errors(group: zarr.Group, setting: int, runs: slice, claims: np.ndarray, steps: Sequence[int]) -> ErrorSums:
    """Return how many of some runs are finite, and sums over them of squared errors, variances and their ratios.

    Sums of the squares of these three are returned too; standard errors need them.

    Args:
        group: the store, with errors and variances (setting, run, step, node, filter, state).
        setting: number of the setting.
        runs: which runs to sum over.
        claims: what each filter claims (node, filter); if a filter claims "none", its variance need not be finite.
        steps: the steps at which to sum, from 1.
    """
    error, variance = (np.asarray(group[name][setting, runs]) for name in ("error", "variance"))  # type: ignore[index]
    squared = error**2
    # (run, node, filter): whether a run is finite at all steps and in all states, and counts.
    has_variance = np.isfinite(variance).all(axis=(1, -1)) | (claims == "none")
    is_finite = np.isfinite(squared).all(axis=(1, -1)) & has_variance
    with np.errstate(divide="ignore", invalid="ignore"):
        numbers = np.stack([squared, variance, squared / variance])
    # Along the axis of steps of (number, run, step, node, filter, state): the mean over all, and then the given steps.
    mean_over_steps, at_steps = numbers.mean(axis=2, keepdims=True), numbers[:, :, [step - 1 for step in steps]]
    selected = np.concatenate([mean_over_steps, at_steps], axis=2)
    selected = np.where(is_finite[None, :, None, :, :, None], selected, 0.0)
    return ErrorSums(runs=is_finite.sum(axis=0), values=selected.sum(axis=1), squares=(selected**2).sum(axis=1))


def _compute_state_scores(
    setting: int, labels: AxisLabels, claims: np.ndarray, steps: Sequence[int], sums: ErrorSums
) -> list[StateScore]:
    """Return RMSE, claimed deviation and NEES with standard errors, by step, node, filter and state of one setting.

    A setting is a network with certain numbers, simulated in many runs. NEES: squared error over claimed variance.

    Args:
        setting: number of the setting.
        labels: names of nodes, filters and states.
        claims: what each filter says that its covariance is, such as "exact" (node, filter), "" where a node has no
            such filter.
        steps: numbers of the steps in the sums, 0 for the mean over all.
        sums: number of finite runs (node, filter), and over these sums and sums of squares of squared error, claimed
            variance and NEES (3, step, node, filter, state).
    """
    with np.errstate(divide="ignore", invalid="ignore"):
        # Mean over n runs and its standard error, sqrt((E[x^2] - E[x]^2) / (n - 1)).
        n = sums.runs[None, None, :, :, None]
        mean = sums.values / n
        standard_error = np.sqrt(np.maximum(sums.squares / n - mean**2, 0.0) / (n - 1))
        # The three values of `ErrorSums`, each (step, node, filter, state).
        mean_squared_error, mean_claimed_variance, nees = mean
        error_of_squared, _, nees_error = standard_error
        rmse, claimed = np.sqrt(mean_squared_error), np.sqrt(mean_claimed_variance)
        rmse_error = np.where(rmse > 0, error_of_squared / (2 * rmse), 0.0)  # of a root, to first order
    scores = []
    for k, i, j, s in np.ndindex(rmse.shape):  # step, node, filter, state
        if claims[i, j]:  # else the node has no such filter
            scores.append(
                StateScore(
                    setting=setting,
                    node=labels.nodes[i],
                    filter=labels.filters[j],
                    claim=str(claims[i, j]),
                    state=labels.states[s],
                    step=steps[k],
                    rmse=float(rmse[k, i, j, s]),
                    rmse_error=float(rmse_error[k, i, j, s]),
                    claimed=float(claimed[k, i, j, s]),
                    nees_per_dimension=float(nees[k, i, j, s]),
                    nees_error=float(nees_error[k, i, j, s]),
                    finite_runs=int(sums.runs[i, j]),
                )
            )
    return scores


EXPLORE = "explore.html"
ROWS = 20_000  # of each table on the page: about 2 MB, which a browser still filters at once
STEPS = 50  # at which errors over time are given
DIGITS = 6  # of a number on the page
ALL = "all together"  # states
NAMES = ("node", "filter", "state")
SCORED = ("claim", "rmse", "rmse_error", "nees_per_dimension", "nees_error", "finite_runs")
OVER_TIME = ("claim", "rmse", "rmse_error", "claimed", "nees_per_dimension", "nees_error", "finite_runs")
RMSE = PlotColumn("rmse", "RMSE", "rmse_error")
CLAIMED = PlotColumn("claimed", "claimed standard deviation")
NEES = PlotColumn("nees_per_dimension", "NEES / dim", "nees_error", 1.0)

# From settings and steps (numbers from 1) to the scores of each state, read from the store.
ReadStateScores: TypeAlias = Callable[[Sequence[int], Sequence[int]], list[StateScore]]


def write_explore_page_file(results: str | Path, out: str | Path) -> Path:
    """Write out/explore.html, one self-contained page of the campaign in the folder `results`; return its path.

    Args:
        results: the results folder of a campaign.
        out: the folder for the page, made if needed.

    Raises:
        ValueError: the folder has no results or no scores.
    """
    folder, target = file_path("results folder", results), file_path("output folder", out)
    for name in (STORE, SUMMARY):
        if not (folder / name).exists():
            raise fail(f"results folder {folder}", f"{STORE} and {SUMMARY}, as `heliograph sweep` writes", f"no {name}")
    campaign, scores = restore_campaign(folder / STORE), read_summary(folder / SUMMARY)
    if not scores:
        raise fail(f"results folder {folder}", "at least one score", "none yet")
    text = make_explore_page_html(campaign, scores, partial(list_state_scores, folder / STORE, campaign))
    target.mkdir(parents=True, exist_ok=True)
    path = target / EXPLORE
    path.write_text(text, encoding="utf-8")
    return path


def make_explore_page_html(
    campaign: Campaign, scores: Sequence[Score], read_state_scores: ReadStateScores | None = None
) -> str:
    """Return the page as HTML. It has the first settings, as many as have at most ROWS rows in each table.

    Args:
        campaign: the campaign.
        scores: scores of all states together, sorted by setting.
        read_state_scores: reads scores of single states and steps from the store; without it there are none.
    """
    shown = _keep_first_settings(scores)
    settings = len({score.setting for score in shown})
    page = Page(
        kicker="Explore a campaign",
        title=describe_best_filter(scores),
        lead=f"{Path(campaign.path).name}: {len(campaign.settings)} settings, {campaign.runs} runs each of "
        f"{campaign.horizon} steps; {_describe_shown_part(settings, campaign, shown, scores)} "
        "A case is a node in a setting.",
        sections=[
            Section("Results", draw_score_pictures(campaign, scores), STATIC),
            Section("All scores", [make_score_table(campaign, scores)], STATIC),
            Section("What the columns say", [Points(MEANING)]),
        ],
        footer=", ".join(f"{package} {campaign.versions[package]}" for package in BITWISE),
    )
    return make_explorable_page_html(page, _make_tables(campaign, shown, read_state_scores))


MEANING = (
    "**rmse**: root of the mean of the squared error over runs, and over steps unless they are shown apart; of all "
    "states together that of its sum over them.",
    "**claimed**: root of the mean variance that the filter claims.",
    "**nees_per_dimension**: squared error in units of the claimed covariance, per dimension; 1 where that is right, "
    "above 1 is too sure.",
    "**rmse_error**, **nees_error**: one standard error, from the scatter between runs. Only finite runs count.",
    "**claim**: what the filter says of its covariance: `exact`, an `upper` bound, `nominal` (no guarantee) or `none`.",
)


def _describe_shown_part(settings: int, campaign: Campaign, shown: Sequence[Score], scores: Sequence[Score]) -> str:
    """Return in words how many settings and rows are on the page, and where to find all."""
    if len(shown) == len(scores):
        return f"{len(shown)} rows, one for each setting, node and filter."
    return (
        f"the first {settings} of {len(campaign.settings)} settings are on this page, {len(shown)} of {len(scores)} "
        f"rows; `{SUMMARY}` has all."
    )


def _keep_first_settings(scores: Sequence[Score]) -> list[Score]:
    """Return the scores of the first whole settings: at most ROWS, but at least those of one setting."""
    shown: list[Score] = []
    for _, of_setting in groupby(scores, key=lambda score: score.setting):
        rows = list(of_setting)
        if shown and len(shown) + len(rows) > ROWS:
            break
        shown += rows
    return shown


def _make_tables(
    campaign: Campaign, scores: Sequence[Score], read_state_scores: ReadStateScores | None
) -> list[ExploredTable]:
    """Return the tables of the page: scores over all steps, of all states and of each of several; then over time.

    Scores of single states and steps take time to read. So they are read only for the first settings, with at most
    about ROWS rows in all if each setting has as many rows as the first.
    """
    scored = [_convert_to_state_score(score) for score in scores]
    if read_state_scores is None:
        return [_make_scores_table(campaign, scored)]
    settings = list(dict.fromkeys(score.setting for score in scores))
    # At most STEPS steps, spread evenly from the first to the last.
    steps = sorted({round(step) for step in np.linspace(1, campaign.horizon, min(STEPS, campaign.horizon))})
    detailed = read_state_scores(settings[:1], steps)
    rows_of_a_setting = max(len(detailed), 1)
    detailed += read_state_scores(settings[1 : ROWS // rows_of_a_setting], steps)
    if len({detail.state for detail in detailed}) > 1:
        scored += [detail for detail in detailed if not detail.step]
    at_steps = [detail for detail in detailed if detail.step]
    return [_make_scores_table(campaign, scored), _make_steps_table(campaign, at_steps)]


def _convert_to_state_score(score: Score) -> StateScore:
    """Return a score of all states together in the form of those of single states; it has no claimed deviation."""
    return StateScore(
        setting=score.setting,
        node=score.node,
        filter=score.filter,
        claim=score.claim,
        state=ALL,
        step=0,
        rmse=score.rmse,
        rmse_error=score.rmse_error,
        claimed=math.nan,
        nees_per_dimension=score.nees_per_dimension,
        nees_error=score.nees_error,
        finite_runs=score.finite_runs,
    )


def _make_scores_table(campaign: Campaign, rows: Sequence[StateScore]) -> ExploredTable:
    """Return the table of each filter's scores over all steps, and how it is drawn at first.

    `x` is the column of the horizontal axis, `panel` a column with one plot for each of its values, `whole` are columns
    whose values are all shown at first, and points along the column `unordered` are not connected.
    """
    columns, parameters = _make_columns(campaign, rows, SCORED), list(campaign.parameters)
    x = _choose_axis(columns, parameters)
    panel = next((name for name in ("node", *parameters) if name != x and len(set(columns[name])) > 1), "")
    whole = {"setting", "node", "filter", x, panel, *(parameters if x == "setting" else ())} - {""}
    return ExploredTable(
        "all steps together",
        columns,
        dimensions=["setting", *parameters, *NAMES],
        quantities=(RMSE, NEES),
        x=x,
        panel=panel,
        colour="filter",
        whole=sorted(whole),
        unordered="setting",
    )


def _make_steps_table(campaign: Campaign, rows: Sequence[StateScore]) -> ExploredTable:
    """Return the table of scores step by step; it is drawn at first over time, with a panel for each state.

    All values of the columns `whole` are shown at first. Points along the column `unordered` are not connected.
    """
    steps: dict[str, list[Value]] = {"time": [row.step for row in rows]}
    return ExploredTable(
        "step by step",
        columns=steps | _make_columns(campaign, rows, OVER_TIME),
        dimensions=["time", "setting", *campaign.parameters, *NAMES],
        quantities=(RMSE, CLAIMED, NEES),
        x="time",
        panel="state",
        colour="filter",
        whole=["filter", "setting", "state", "time"],
        unordered="setting",
    )


def _make_columns(campaign: Campaign, rows: Sequence[StateScore], fields: Sequence[str]) -> dict[str, list[Value]]:
    """Return the columns of a table of scores by name, each with a value for each score in `rows`.

    They are the setting, its parameters, node, filter and state, and the fields of `StateScore` that `fields` names.
    """
    parameters = {name: list_parameter_values(campaign, name).tolist() for name in campaign.parameters}
    return {
        "setting": [row.setting for row in rows],
        **{name: [_round_value(values[row.setting]) for row in rows] for name, values in parameters.items()},
        **{name: [_round_value(getattr(row, name)) for row in rows] for name in (*NAMES, *fields)},
    }


def _choose_axis(columns: dict[str, list[Value]], parameters: Sequence[str]) -> str:
    """Return the column for the axis: the first numeric parameter with several values, or any such, or "setting"."""
    varying = [name for name in parameters if len(set(columns[name])) > 1]
    numeric = [name for name in varying if {type(value) for value in columns[name]} <= {int, float}]
    return [*numeric, *varying, "setting"][0]


def _round_value(value: object) -> Value:
    """Return a value for the page: a real number to DIGITS digits, None if it is not finite, and others as text."""
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
    return value if isinstance(value, int | bool) else str(value)
