"""How the example is shown: its figures and its report."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from heliograph.report.curves import Panel, curves_over, curves_over_time
from heliograph.report.figures import AMBER, BLUE, GREEN, INK, MUTED, PURPLE, VERMILION, Curve
from heliograph.report.page import Code, KeyFigure, KeyFigures, Page, Picture, Points, Section, Table, Text
from heliograph_studies.links_with_memory.compute import RUNS, Outcome, Score

ROWS = {  # filter: how it is called, and its colour
    "memoryless": ("linear, no memory", VERMILION),
    "exact": ("linear, with the modes", BLUE),
    "gpb1": ("one Gaussian (GPB1)", AMBER),
    "imm": ("a Gaussian per mode (IMM)", PURPLE),
    "gpb2": ("a Gaussian per mode (GPB2)", GREEN),
    "particle": ("particles", MUTED),
    "mode_late": ("told the mode one step late", INK),
    "mode_known": ("told the mode", INK),
}
TOLD = {"losses": "losses, likelier while the link is bad", "classes": "a class of strength, right 4 times in 5"}
HEADERS = ["filter", "claim", "claimed", "mean square error", "true, before data"]
COLOURS = [colour for _, colour in ROWS.values()]


def memory_figures(outcome: Outcome) -> dict[str, Figure]:
    """Errors over time beside claims, what telling is worth, and how wrong no memory is, by file name."""
    first = outcome.e1
    pairs = [(name, ROWS[name][1], first[name]) for name in ("memoryless", "exact", "gpb2")]
    short = {"memoryless": "no memory", "exact": "linear, modes", "gpb2": "GPB2"}
    claims = [Curve(short[name], colour, s.claimed_over_time) for name, colour, s in pairs]
    truths = [Curve(short[name], colour, s.true_over_time) for name, colour, s in pairs]
    known = [
        Curve("nothing told", BLUE, first["exact"].true_over_time),
        Curve("one step late", PURPLE, first["mode_late"].true_over_time),
        Curve("mode known", INK, first["mode_known"].true_over_time),
    ]
    time = np.arange(1.0, len(first["exact"].true_over_time) + 1)
    ratio = Panel("true over claimed variance", [Curve("no memory", VERMILION, outcome.ratios)])
    return {
        "claims": curves_over_time(time, [Panel("claimed variance", claims), Panel("mean square error", truths)]),
        "telling": curves_over_time(time, [Panel("mean square error", known)]),
        "correlation": curves_over(outcome.lags, ratio, "correlation of the gain from step to step", logarithmic=False),
    }


def rows(scores: Mapping[str, Score]) -> list[list[str]]:
    """One row for each filter."""
    result = []
    for name, (label, _) in ROWS.items():
        s = scores[name]
        exact = "" if s.exact is None else f"{s.exact:.4f}"
        result.append([label, s.claim, f"{s.claimed:.4f}", f"{s.true:.4f} ± {s.true_se:.4f}", exact])
    return result


def memory_page(outcome: Outcome, drawings: Mapping[str, bytes]) -> Page:
    """The report; `drawings` holds each figure as SVG."""
    e1, shadow = outcome.e1, outcome.shadow
    none, exact = e1["memoryless"], e1["exact"]
    return Page(
        kicker="Heliograph example",
        title=f"Taking a slow fade for a fast one: {none.true / none.claimed:.1f} times the claimed variance",
        lead=(
            "The gain of a link stays at 0.2 or at 1 for some twenty steps. A filter that assumes a new gain at each "
            f"step has an error variance of {none.true:.3f} and claims {none.claimed:.3f}; the best linear filter that "
            f"knows how long the gain stays has {exact.claimed:.3f} and says so. These numbers are computed before any "
            "data."
        ),
        sections=[
            _bursts(outcome, drawings),
            _worth(outcome, drawings),
            _wrong(outcome, drawings),
            _drift(outcome),
            _again(shadow),
        ],
        footer="All numbers: summary.json.",
    )


def _bursts(outcome: Outcome, drawings: Mapping[str, bytes]) -> Section:
    e1 = outcome.e1
    keys = [
        KeyFigure(ROWS[n][0], f"{e1[n].true:.3f}", f"claims {e1[n].claimed:.3f}", ROWS[n][1])
        for n in ("memoryless", "exact", "gpb2")
    ]
    caption = (
        f"Means over steps 101 to 300; {RUNS['e1']:,} runs, fewer of the particles. **Claim**: `exact` "
        "where the filter's own covariance is that of its errors, `nominal` where nothing is guaranteed."
    )
    picture = Picture(
        drawings["claims"],
        "Claimed variance and mean square error over time of three filters; without memory they differ.",
        "Above, the variance that each filter claims; below, its mean square error.",
    )
    return Section("Fading in bursts", [KeyFigures(keys), Table(HEADERS, rows(e1), caption, COLOURS), picture])


def _worth(outcome: Outcome, drawings: Mapping[str, bytes]) -> Section:
    headers = ["what is told", "claimed", "mean square error"]
    cells = [["nothing", f"{outcome.e1['exact'].claimed:.4f}", f"{outcome.e1['exact'].true:.4f}"]]
    told = {label: outcome.told[name] for name, label in TOLD.items()}
    told |= {"the mode one step late": outcome.e1["mode_late"], "the mode": outcome.e1["mode_known"]}
    cells += [[label, f"{s.claimed:.4f}", f"{s.true:.4f} ± {s.true_se:.4f}"] for label, s in told.items()]
    picture = Picture(
        drawings["telling"],
        "Mean square error over time, lower the more is told.",
        "Linear filters, told nothing, the mode one step late, or the mode.",
    )
    return Section(
        "What it helps to be told",
        [
            Table(
                headers,
                cells,
                "Linear filters, whose covariance is that of their errors. **Mode**: which of its two gains the link "
                "has.",
            ),
            picture,
        ],
    )


def _wrong(outcome: Outcome, drawings: Mapping[str, bytes]) -> Section:
    found = outcome.memory
    picture = Picture(
        drawings["correlation"],
        "True over claimed variance rises from 1 to almost 3 with the gain's correlation.",
        "The same two levels, as often each; the filter assumes none of the correlation.",
    )
    text = (
        f"Data show it too: in one recording of 10,000 steps the filter's innovations have a correlation of "
        f"{found.correlation[0]:.2f} ± {found.standard_error[0]:.2f} at lag 1 and {found.correlation[1]:.2f} at lag 2, "
        f"and earlier ones predict {100 * found.predictable:.0f} % of their variance."
    )
    return Section("How wrong a filter without memory is", [picture, Text([text])])


def _drift(outcome: Outcome) -> Section:
    caption = (
        f"First state, means over steps 51 to 100; {RUNS['e2']:,} runs, fewer of the particles. The filters with "
        "Gaussians and particles take each drifting gain as three levels; all of them claim too little here."
    )
    return Section("Two hops that drift", [Table(HEADERS, rows(outcome.e2), caption, COLOURS)])


def _again(shadow: Mapping[str, float]) -> Section:
    points = [
        f"Two sensors whose links fade together: the best linear filter has {shadow['shared']:.4f}. A filter that "
        f"takes the fades for independent claims {shadow['separate_claimed']:.4f} and has "
        f"{shadow['separate_true']:.4f}.",
    ]
    return Section(
        "Two links that fade together, and how to run this again",
        [Points(points), Code("heliograph example links-with-memory --out out")],
    )
