"""Report of a campaign: one self-contained page."""

import math
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from heliograph.campaign.failures import FAILURES, Failure, read_failures
from heliograph.campaign.figures import PANELS, campaign_figures
from heliograph.campaign.plan import BITWISE, Campaign
from heliograph.campaign.summary import SUMMARY, Score, score_headers, score_row
from heliograph.disk.quoting import visible
from heliograph.report.figures import svg
from heliograph.report.page import Block, Code, Page, Picture, Points, Section, Table, Text

REPORT = "report.html"
ROWS = 200  # of the table on the page
REPORTED = 20  # failures on the page


def write_report(campaign: Campaign, scores: Sequence[Score], out: Path) -> Path:
    """Write the report next to the store; return its path."""
    path = out / REPORT
    path.write_text(campaign_page(campaign, scores, read_failures(out)).html(), encoding="utf-8")
    return path


def campaign_page(campaign: Campaign, scores: Sequence[Score], failures: Sequence[Failure]) -> Page:
    """Return the report of a campaign with its scores and failures."""
    name = Path(campaign.path).name
    there = sum({score.setting: score.runs for score in scores}.values())
    # Failures first, so that nobody reads the results without them.
    return Page(
        kicker="Heliograph campaign",
        title=finding(scores),
        lead=f"{name}: {len(campaign.settings)} settings, {campaign.runs} runs each of {campaign.horizon} steps; "
        f"{there} of {len(campaign.settings) * campaign.runs} runs are there. {_failed(failures)} A case "
        "is a node in a setting.",
        sections=[
            *([_failures(failures)] if failures else []),
            Section("Results", pictures(campaign, scores)),
            Section("All scores", [score_table(campaign, scores)]),
            _reading(campaign),
            Section("The campaign", [Code(campaign.text.strip())]),
        ],
        footer=", ".join(f"{package} {campaign.versions[package]}" for package in BITWISE),
    )


def finding(scores: Sequence[Score]) -> str:
    """Summarise which filter has the least error, and how often; of a single filter, the range of errors."""
    cases: dict[tuple[int, str], list[Score]] = {}
    for score in scores:
        if math.isfinite(score.rmse):
            cases.setdefault((score.setting, score.node), []).append(score)
    if not cases:
        return "No run is there yet"
    compared = [case for case in cases.values() if len(case) > 1]
    if not compared:
        errors = sorted(score.rmse for case in cases.values() for score in case)
        return f"RMSE from {errors[0]:.3g} to {errors[-1]:.3g}"
    wins = Counter(min(case, key=lambda score: score.rmse).filter for case in compared)
    name, count = wins.most_common(1)[0]
    return f"“{visible(name)}” has the least error in {count} of {len(compared)} cases"


def _failed(failures: Sequence[Failure]) -> str:
    return f"{len(failures)} pieces of work failed and are missing here." if failures else "Nothing failed."


def _failures(failures: Sequence[Failure]) -> Section:
    points = [
        f"setting {failure.setting} {failure.parameters}, runs {failure.runs[0]} to {failure.runs[1]}: {failure.error}"
        for failure in failures[:REPORTED]
    ]
    text = f"Tried three times. All of them, with tracebacks, are in {FAILURES}; run one again alone by its command:"
    return Section("What failed", [Points(points), Text([text]), Code(failures[0].command)])


def pictures(campaign: Campaign, scores: Sequence[Score]) -> list[Block]:
    """Return the figures of a campaign's scores."""
    caption = f"Bars: two standard errors to both sides. At most {PANELS} panels are drawn; {SUMMARY} has all."
    return [
        Picture(svg(figure), f"{name} of every filter.", caption if i == 0 else "")
        for i, (name, figure) in enumerate(campaign_figures(campaign, scores).items())
    ]


def score_table(campaign: Campaign, scores: Sequence[Score]) -> Table:
    """Return the first rows of the table of scores, with an explanation of its columns."""
    rows = [[str(score.setting), *score_row(campaign, score)] for score in scores[:ROWS]]
    more = f" The first {ROWS} rows of {len(scores)}." if len(scores) > ROWS else ""
    caption = (
        "**RMSE**: root of the mean over runs and steps of the squared error summed over the state. **NEES / dim**: "
        "squared error in units of the claimed covariance, per dimension; 1 where that is right, above 1 is too sure. "
        "**±**: one standard error of the number before it, from the scatter between runs. Only finite runs "
        f"count.{more}"
    )
    return Table(["setting", *score_headers(campaign)], rows, caption)


def _reading(campaign: Campaign) -> Section:
    lines = [
        "import heliograph as hg",
        "",
        'results = hg.campaign.open_results("THIS FOLDER")  # an xarray.Dataset',
        'results.error.sel(setting=0).mean("run")',
    ]
    text = f"The errors of every run are in the store; axes: {', '.join(['setting', 'run', 'time', 'node', 'filter'])}."
    return Section("All runs", [Text([text]), Code("\n".join(lines))])
