"""A campaign's scores as one page in which axes, settings, nodes and filters are chosen."""

import math
from collections.abc import Sequence
from itertools import groupby
from pathlib import Path

from heliograph.campaign.page import pictures, score_table
from heliograph.campaign.plan import BITWISE, Campaign
from heliograph.campaign.store import STORE, parameter_values, stored_campaign
from heliograph.campaign.summary import SUMMARY, Score, read_summary
from heliograph.numerics.check import fail, file_path
from heliograph.report.explore_page import STATIC, Explored, Quantity, Value, explore_html
from heliograph.report.page import Page, Points, Section

EXPLORE = "explore.html"
ROWS = 20_000  # on the page: about 2 MB, which a browser still filters at once
DIGITS = 6  # of a number on the page
FIELDS = ("claim", "rmse", "rmse_error", "nees_per_dimension", "nees_error", "finite_runs")
QUANTITIES = (Quantity("rmse", "RMSE", "rmse_error"), Quantity("nees_per_dimension", "NEES / dim", "nees_error", 1.0))


def explore_results(results: str | Path, out: str | Path) -> Path:
    """Write out/explore.html, one self-contained page of the campaign in the folder `results`; returns where it is.

    Raises:
        ValueError: a folder without a campaign's results, or that holds no score yet.
        ModuleNotFoundError: an extra of `sweep`, `report`, `explore` is not installed.
    """
    folder, place = file_path("results folder", results), file_path("output folder", out)
    for name in (STORE, SUMMARY):
        if not (folder / name).exists():
            raise fail(f"results folder {folder}", f"{STORE} and {SUMMARY}, as `heliograph sweep` writes", f"no {name}")
    campaign, scores = stored_campaign(folder / STORE), read_summary(folder / SUMMARY)
    if not scores:
        raise fail(f"results folder {folder}", "at least one score", "none yet")
    text = explore_page(campaign, scores)
    place.mkdir(parents=True, exist_ok=True)
    path = place / EXPLORE
    path.write_text(text, encoding="utf-8")
    return path


def explore_page(campaign: Campaign, scores: Sequence[Score]) -> str:
    """The page as HTML. Whole settings are on it, the first that have together at most ROWS rows."""
    shown = _first(scores)
    settings = len({score.setting for score in shown})
    page = Page(
        kicker="Explore a campaign",
        title=f"{len(campaign.settings)} settings, {campaign.runs} runs each",
        lead=f"{Path(campaign.path).name}: {campaign.horizon} steps; {_told(settings, campaign, shown, scores)}",
        sections=[
            Section("Results", pictures(campaign, scores), STATIC),
            Section("All scores", [score_table(campaign, scores)], STATIC),
            Section("What the columns say", [Points(MEANING)]),
        ],
        footer=", ".join(f"{package} {campaign.versions[package]}" for package in BITWISE),
    )
    return explore_html(page, _explored(campaign, shown))


MEANING = (
    "**rmse**: root of the mean over runs and steps of the squared error summed over the state.",
    "**nees_per_dimension**: squared error in units of the claimed covariance, per dimension; 1 where that is right, "
    "above is too sure.",
    "**rmse_error**, **nees_error**: one standard error, from the scatter between runs. Only finite runs count.",
    "**claim**: what the filter says of its covariance, `exact`, `upper`, `nominal` or `none`.",
)


def _told(settings: int, campaign: Campaign, shown: Sequence[Score], scores: Sequence[Score]) -> str:
    if len(shown) == len(scores):
        return f"{len(shown)} rows, one for each setting, node and filter."
    return (
        f"the first {settings} of {len(campaign.settings)} settings are on this page, {len(shown)} of {len(scores)} "
        f"rows; `{SUMMARY}` has all."
    )


def _first(scores: Sequence[Score]) -> list[Score]:
    shown: list[Score] = []
    for _, part in groupby(scores, key=lambda score: score.setting):
        rows = list(part)
        if shown and len(shown) + len(rows) > ROWS:
            break
        shown += rows
    return shown


def _explored(campaign: Campaign, scores: Sequence[Score]) -> Explored:
    parameters = {name: parameter_values(campaign, name).tolist() for name in campaign.parameters}
    columns: dict[str, list[Value]] = {
        "setting": [score.setting for score in scores],
        **{name: [_value(values[score.setting]) for score in scores] for name, values in parameters.items()},
        "node": [score.node for score in scores],
        "filter": [score.filter for score in scores],
        **{name: [_value(getattr(score, name)) for score in scores] for name in FIELDS},
    }
    x = _axis(columns, list(parameters))
    panel = next((name for name in ("node", *parameters) if name != x and len(set(columns[name])) > 1), "")
    whole = {"setting", "node", "filter", x, panel, *(parameters if x == "setting" else ())} - {""}
    dimensions = ["setting", *parameters, "node", "filter"]
    return Explored(columns, dimensions, QUANTITIES, x, panel, "filter", sorted(whole), "setting")


def _axis(columns: dict[str, list[Value]], parameters: Sequence[str]) -> str:
    """The first number that takes several values, else the first parameter that does, else the setting."""
    several = [name for name in parameters if len(set(columns[name])) > 1]
    numbers = [name for name in several if {type(value) for value in columns[name]} <= {int, float}]
    return next(iter([*numbers, *several]), "setting")


def _value(value: object) -> Value:
    if isinstance(value, float):
        return float(f"{value:.{DIGITS}g}") if math.isfinite(value) else None
    return value if isinstance(value, int | bool) else str(value)
