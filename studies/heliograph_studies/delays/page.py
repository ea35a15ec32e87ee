"""How the example is shown: its figures and its report."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from heliograph.report.curves import Panel, curves_over_time
from heliograph.report.figures import AMBER, BLUE, GREEN, INK, PURPLE, VERMILION, Curve
from heliograph.report.page import Code, KeyFigure, KeyFigures, Page, Picture, Section, Table, Text
from heliograph_studies.delays.compute import RUNS, Outcome, Score
from heliograph_studies.delays.setting import CLOCK_STEPS, STEP

LATE = {  # filter: how it is called, and its colour
    "as_current": ("taken as current", VERMILION),
    "untold": ("delays not told", BLUE),
    "told": ("delays told", GREEN),
    "constant": ("all one step late", PURPLE),
    "none": ("not late", INK),
}
CLOCKS = {
    "ignored": ("stamps taken as true", VERMILION),
    "estimated": ("clock estimated", AMBER),
    "guarded": ("clock estimated while it can be", BLUE),
}
SITUATIONS = {"moving": "in motion", "at_rest": "at rest", "no_true_clock": "no true clock"}


def delay_figures(outcome: Outcome) -> dict[str, Figure]:
    """Claims beside truths of late data; clocks in motion, and where nobody can know them."""
    late = outcome.delays
    steps = np.arange(1.0, len(late["none"].true) + 1)
    claims = [Curve(short(name), colour, late[name].claimed) for name, (_, colour) in LATE.items()]
    truths = [Curve(short(name), colour, known(late[name])) for name, (_, colour) in LATE.items()]
    time = STEP * np.arange(1.0, CLOCK_STEPS + 1)
    motion, rest, alone = (outcome.clocks[name] for name in SITUATIONS)
    position = pair(motion["ignored"]["position"], VERMILION, "ignored")
    position += pair(motion["guarded"]["position"], BLUE, "estimated")
    traps = [
        Panel(f"offset in s, {SITUATIONS[name]}", _offsets(found))
        for name, found in (("at_rest", rest), ("no_true_clock", alone))
    ]
    both = pair(motion["guarded"]["offset"], BLUE, "estimated")
    return {
        "late": curves_over_time(steps, [Panel("claimed variance", claims), Panel("mean square error", truths)]),
        "clocks": curves_over_time(time, [Panel("position error", position), Panel("offset error in s", both)], "s"),
        "traps": curves_over_time(time, traps, "s"),
    }


def _offsets(found: Mapping[str, Mapping[str, Score]]) -> list[Curve]:
    return [
        *pair(found["estimated"]["offset"], AMBER, "always"),
        *pair(found["guarded"]["offset"], BLUE, "while it can be"),
    ]


def short(name: str) -> str:
    """A name at a curve's end."""
    return LATE[name][0]


def known(score: Score) -> np.ndarray:
    """Mean square errors before data where these are known, else as simulated."""
    return score.true if score.before is None else score.before


def error(score: Score) -> float:
    """The mean of these over the steps that count."""
    return score.mean(known(score))


def pair(score: Score, colour: str, name: str) -> list[Curve]:
    """What is true, and what is claimed in grey, as deviations."""
    return [
        Curve(f"{name}: true", colour, np.sqrt(score.true)),
        Curve(f"{name}: claims", INK if colour == VERMILION else GREEN, np.sqrt(score.claimed)),
    ]


def delay_page(outcome: Outcome, drawings: Mapping[str, bytes]) -> Page:
    """The report; `drawings` holds each figure as SVG."""
    late, wrong = outcome.delays, outcome.clocks["moving"]["ignored"]["position"]
    mistake, best = late["as_current"], late["untold"]
    claimed = mistake.mean(mistake.claimed)
    return Page(
        kicker="Heliograph example",
        title=f"Late data taken as current: {error(mistake) / claimed:.1f} times the claimed variance",
        lead=(
            "Measurements come up to two steps late. A filter that takes them as current has an error variance of "
            f"{error(mistake):.3f} and computes {claimed:.3f}. The best linear filter that knows "
            f"only how often they are late has {error(best):.3f} and says so; one that is told each delay has "
            f"{error(late['told']):.3f}. A clock that is trusted and half a second wrong makes the position error "
            f"{np.sqrt(wrong.true[-1]):.2f} where {np.sqrt(wrong.claimed[-1]):.2f} is claimed."
        ),
        sections=[_late(outcome, drawings), _clocks(outcome, drawings), _traps(outcome, drawings)],
        footer="All numbers: summary.json.",
    )


def _late(outcome: Outcome, drawings: Mapping[str, bytes]) -> Section:
    late = outcome.delays
    keys = [
        KeyFigure(LATE[n][0], f"{error(late[n]):.3f}", f"claims {late[n].mean(late[n].claimed):.3f}", LATE[n][1])
        for n in ("as_current", "untold", "told")
    ]
    rows = [
        [label, s.claim, f"{s.mean(s.claimed):.4f}", f"{s.mean(s.true):.4f} ± {s.true_se:.4f}", before(s)]
        for label, s in ((LATE[name][0], late[name]) for name in LATE)
    ]
    caption = (
        f"Variance of the position, means over the second half of the steps; {RUNS['delays']:,} runs. **Claim**: "
        "`exact` where the filter's own covariance is that of its errors, `nominal` where nothing is guaranteed."
    )
    headers = ["filter", "claim", "claimed", "mean square error", "known before data"]
    colours = [colour for _, colour in LATE.values()]
    text = (
        "Above, the variance that each filter claims; below, its mean square error, computed before any data where no "
        "gain depends on them."
    )
    alternative = (
        "Claimed variance and mean square error over time; only the filter that takes late as current differs."
    )
    picture = Picture(drawings["late"], alternative, text)
    return Section("Late values", [KeyFigures(keys), Table(headers, rows, caption, colours), picture])


def before(score: Score) -> str:
    """The last error before data, if it is known."""
    return "" if score.before is None else f"{score.mean(score.before):.4f}"


def _clocks(outcome: Outcome, drawings: Mapping[str, bytes]) -> Section:
    caption = f"Root mean square errors at the last step, and what the filter claims; {RUNS['clocks']:,} runs."
    headers = ["situation", "filter", "position", "offset in s", "drift"]
    rows = [
        [label, CLOCKS[name][0], *(cell(score[part]) for part in ("position", "offset", "drift"))]
        for kind, label in SITUATIONS.items()
        for name, score in outcome.clocks[kind].items()
    ]
    alternative = "Errors of position and offset over time beside what is claimed; of trusted stamps far above it."
    picture = Picture(drawings["clocks"], alternative, "In motion, beside a node whose clock is right.")
    return Section("A wrong clock", [Table(headers, rows, caption), picture])


def cell(score: Score) -> str:
    """True and claimed deviation."""
    return f"{np.sqrt(score.true[-1]):.3g} (claims {np.sqrt(score.claimed[-1]):.3g})"


def _traps(outcome: Outcome, drawings: Mapping[str, bytes]) -> Section:
    text = (
        "A clock's offset cannot be observed while nothing moves, nor where no other clock is right. A filter that "
        "linearises anew at each step finds an offset all the same, and claims to know it. The filter that first "
        "checks whether the offset can be observed keeps what it knew before."
    )
    alternative = (
        "Offset errors and claims at rest and without a true clock: the plain claim falls, the error does not."
    )
    picture = Picture(drawings["traps"], alternative, "Offsets where nobody can know them.")
    return Section("What cannot be known", [Text([text]), picture, Code("heliograph example delays --out out")])
