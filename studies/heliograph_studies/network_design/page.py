"""The example's figures and page."""

from collections.abc import Mapping

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from heliograph.report.design_page import front_figure
from heliograph.report.figures import AMBER, BLUE, GREEN, INK, STYLE, VERMILION, WIDTH
from heliograph.report.page import Code, KeyFigure, KeyFigures, Page, Picture, Points, Section, Table, Text
from heliograph_studies.network_design import setting
from heliograph_studies.network_design.compute import EXPONENT, Case, Outcome, path_powers
from heliograph_studies.network_design.theory import relay_line

COLOURS = (BLUE, AMBER, GREEN)  # of total powers
EVEN = 60  # values of the noise in the picture of sites


def design_figures(outcome: Outcome) -> dict[str, Figure]:
    """Error against power, the powers of the paths, schedules and bursts, and where one relay stands best."""
    equal = {f"equal powers of {total:g} in all": (total, one.equal) for total, one in outcome.two_hops.items()}
    return {
        "front": front_figure(outcome.front, equal),
        "powers": _powers(outcome),
        "schedules": _schedules(outcome),
        "sites": _sites(),
    }


@matplotlib.rc_context(STYLE)
def _powers(outcome: Outcome) -> Figure:
    figure = Figure(figsize=(WIDTH, 3.0), layout="constrained")
    grid = figure.subplots(1, 2, sharey=True)
    cases = [("one hop", outcome.one_hop), ("two hops", outcome.two_hops)]
    for axes, (name, each) in zip(grid, cases, strict=True):
        width = 0.8 / len(each)
        for i, ((total, one), colour) in enumerate(zip(each.items(), COLOURS, strict=False)):
            shares = np.array(list(path_powers(one.best).values())) / total
            places = np.arange(len(shares)) + (i - (len(each) - 1) / 2) * width
            axes.bar(places, 100 * shares, width, color=colour, label=f"{total:g} in all")
        axes.axhline(100 / len(setting.NAMES), color=INK, linewidth=1.0, linestyle=(0, (4, 1.6)))
        axes.set_xticks(range(len(setting.NAMES)), setting.NAMES)
        axes.set(title=name, xlabel="sensor")
        axes.grid(visible=False, axis="x")
        axes.legend(frameon=False, fontsize=9)
    grid[0].set_ylabel("share of the power (%)")
    return figure


@matplotlib.rc_context(STYLE)
def _schedules(outcome: Outcome) -> Figure:
    figure = Figure(figsize=(WIDTH, 3.0), layout="constrained")
    left, right = figure.subplots(1, 2)
    found, bursts = outcome.schedule, outcome.bursts
    for axes, title, values, bound in (
        (left, "one of six at a step", found.by_period, found.bound),
        (right, "two hops, seldom but loud", bursts.errors, bursts.bound),
    ):
        axes.plot(list(values), list(values.values()), "o-", color=BLUE, label="found")
        axes.axhline(bound, color=VERMILION, linewidth=1.2, linestyle=(0, (4, 1.6)), label="nothing is below")
        axes.set(title=title)
        axes.legend(frameon=False, fontsize=9)
    left.set(xlabel="period", ylabel="mean error", xticks=list(found.by_period))
    right.set(xlabel="sending every n-th step, n")
    return figure


@matplotlib.rc_context(STYLE)
def _sites() -> Figure:
    figure = Figure(figsize=(WIDTH, 3.2), layout="constrained")
    axes = figure.subplots()
    for exponent, colour in ((2.5, GREEN), (3.0, BLUE), (4.0, VERMILION)):
        ratio = 2**exponent * (exponent / 2 - 1)  # of rho, up to which the midpoint is best
        rho = np.geomspace(0.2 * ratio, 20 * ratio, EVEN)
        sites = np.array([relay_line(r, exponent).sites[0] for r in rho])
        nearer = np.minimum(sites, 1 - sites)
        axes.plot(rho, nearer, color=colour, linewidth=1.6, label=f"path loss exponent {exponent:g}")
        axes.plot([ratio], [0.5], "o", color=colour)
    axes.set(xscale="log", xlabel="noise of the whole way over the power, ρ", ylabel="best site (1: the whole way)")
    axes.legend(frameon=False, fontsize=9)
    return figure


def design_page(outcome: Outcome, drawings: Mapping[str, bytes]) -> Page:
    """The report; `drawings` holds each figure as SVG."""
    plain, least = (outcome.demonstration[name] for name in ("as_it_is", "centred_thousandth"))
    total = min(outcome.two_hops)
    two = outcome.two_hops[total]
    saved = f"{100 * (1 - two.least.total / total):.0f} %"
    keys = [
        KeyFigure("two hops, little power", saved, "less power for the "
                  "error of equal powers", BLUE),
        KeyFigure("the demonstration", f"1/{plain.power / least.power:.0f}", "of the power for "
                  f"{100 * least.rmse / plain.rmse:.0f} % of the error", GREEN),
        KeyFigure("published relays that filter", f"{outcome.circuit.power_saved_percent:.0f} %",
                  "less relay power for the published error", VERMILION),
    ]  # fmt: skip
    return Page(
        kicker="Heliograph example",
        title=f"Sharing power by design saves {saved} of it",
        lead=(
            f"Six sensors behind relays need {two.least.total:.3g} units of power in all for the error that "
            f"{total:g} units give when all transmit alike. How much power, how many relays, where "
            "they stand and who sends when is chosen here, each time beside a proof of how much better any other "
            "choice could be at most."
        ),
        sections=[
            Section("What designing saves", [KeyFigures(keys)]),
            _six(outcome, drawings),
            _less(outcome),
            _published(outcome),
            _when(outcome, drawings),
            _where(outcome, drawings),
            Section("Run it again", [Code("heliograph example network-design --out out")]),
        ],
    )


def _six(outcome: Outcome, drawings: Mapping[str, bytes]) -> Section:
    rows = [_row("one hop", total, one) for total, one in outcome.one_hop.items()]
    rows += [_row("two hops", total, one) for total, one in outcome.two_hops.items()]
    caption = (
        "Steady error (trace) of the best linear filter, with all transmitters equal and with the best powers found; "
        "**not below**: proven for every choice; **power**: the least that was found for the error of equal powers."
    )
    words = [
        "Six sensors of three states share a total power. Heard directly, the problem is convex and is solved to a "
        "proven gap. Behind relays it is not convex: what a weak path tells grows with the square of its power at "
        "first, so that some paths are best silent; concave envelopes prove below which error nothing can be."
    ]
    return Section(
        "Six sensors",
        [
            Text(words),
            Table(("hops", "total", "equal powers", "best", "not below", "power"), rows, caption),
            Picture(drawings["powers"], "Bars: the share of the power that each sensor's path gets.",
                    "How the best powers are shared; the dashed line is an equal share."),
            Picture(drawings["front"], "Error over total power behind relays, with the region that is impossible.",
                    "Two hops: the least error found at each total power, and the errors of equal powers."),
        ],
    )  # fmt: skip


def _row(hops: str, total: float, one: Case) -> list[str]:
    saved = 1 - one.least.total / total
    return [hops, f"{total:g}", f"{one.equal:.5f}", f"{one.best.error:.5f}", f"{one.best.certificate.bound:.5f}",
            f"{one.least.total:.3f} (−{100 * saved:.0f} %)"]  # fmt: skip


def _less(outcome: Outcome) -> Section:
    names = {
        "as_it_is": "ranges as they are", "centred": "less those at the start",
        "centred_thousandth": "a thousandth of that power",
    }  # fmt: skip
    rows = [
        [words, f"{one.power:.4g}", f"{one.rmse:.3f}", f"{one.claimed:.3f}"]
        for words, one in ((words, outcome.demonstration[name]) for name, words in names.items())
    ]
    text = (
        "The demonstration's relays multiply what they hear by a random gain, and so make an error in proportion to "
        "what is sent. If the sensor sends how far the range is from that at the known start, less is sent, which "
        "costs less power, and the random gain does less harm."
    )
    caption = "Power of a beacon's sensor and relay together (m²); errors are means over the seeds (m)."
    return Section(
        "Sending less of the signal", [Text([text]), Table(("what is sent", "power", "RMSE", "claimed"), rows, caption)]
    )


def _published(outcome: Outcome) -> Section:
    found, lines = outcome.circuit, []
    lines.append(
        f"**Two relays in turn that filter and forward**: each published gain makes the relay's own error least. "
        f"Designed for the receiver, at the same power the error is {found.error_saved_percent:.1f} % smaller; the "
        f"published error takes {found.power_saved_percent:.0f} % less relay power."
    )
    for times, saved in outcome.packets.items():
        lines.append(
            f"**A relay for packets, halfway**, where the error may be {times:g} times that without losses: "
            f"{saved['silent']:.0f} % less mean power if the relay is silent when nothing came, "
            f"{saved['always']:.0f} % if it always sends. Published: 30 to 40 %."
        )
    return Section("Published designs", [Points(lines)])


def _when(outcome: Outcome, drawings: Mapping[str, bytes]) -> Section:
    found, bursts = outcome.schedule, outcome.bursts
    order = " ".join(setting.NAMES[i] for step in found.steps for i in step)
    caption = (
        f"Left: of six sensors one sends at each step; the best schedule found repeats {order} ({found.error:.4g}), "
        f"the greedy one reaches {found.greedy:.4g}. Right: a state heard over two hops; sending every "
        f"{bursts.every}th step with {bursts.every} times the power has the error {bursts.error:.4g}, every step "
        f"{bursts.errors[1]:.4g}."
    )
    return Section(
        "Who sends when", [Picture(drawings["schedules"], "Errors by period and by spacing, with bounds.", caption)]
    )


def _where(outcome: Outcome, drawings: Mapping[str, bytes]) -> Section:
    rows = [
        [f"{rho:g}", f"{one.sites[0]:.3f}", f"{one.noise:.4g}", f"{one.even:.4g}", f"{one.direct:.4g}",
         f"{len(best.lengths) - 1}"]
        for rho, (one, best) in outcome.lines.items()
    ]  # fmt: skip
    caption = (
        f"The signal falls with distance to the power {EXPONENT:g}. **ρ**: noise of the whole way without a relay, in "
        "units of the power; **best site**: the relay's distance from one end, the whole way being 1; **noise**: of "
        "the path, with a relay there. **relays**: how many are best, of at most eight, if E g² of each hop's gain is "
        "1.02 (E g)², that is if it fades a little."
    )
    table = Table(("ρ", "best site", "noise", "at the midpoint", "without a relay", "relays"), rows, caption)
    words = "The midpoint (dots: up to where) is the best site only while noise is small; then nearer to one end."
    return Section(
        "Where a relay stands best",
        [Picture(drawings["sites"], "The best site of one relay over the noise.", words), table],
    )
