"""Networks that are designed: powers, relays, sites and schedules, each beside what nothing can beat."""

import matplotlib
import numpy as np
from matplotlib.figure import Figure

from heliograph.report.design_page import front_figure
from heliograph.report.figures import AMBER, BLUE, GREEN, INK, STYLE, VERMILION, WIDTH
from heliograph_studies import Study
from heliograph_studies.demo.recording import plaza2
from heliograph_studies.network_design import compute
from heliograph_studies.network_design.compute import FADING as FADING
from heliograph_studies.network_design.compute import Case, Outcome, Schedules
from heliograph_studies.network_design.setting import NAMES
from heliograph_studies.network_design.setting import Setting as Setting
from heliograph_studies.network_design.theory import relay_line

COLOURS = (BLUE, AMBER, GREEN)  # of total powers
POINTS = 60  # values of the noise in the picture of sites
DASHES = (0, (4, 1.6))


def figures(outcome: Outcome) -> dict[str, Figure]:
    """Error against power, the powers of the paths, schedules and bursts, and where one relay stands best."""
    equal = {f"equal powers of {total:g} in all": (total, c["equal"]) for total, c in outcome.two_hops.items()}
    return {
        "front": front_figure(outcome.front, equal),
        "powers": _powers(outcome),
        "schedules": _schedules(outcome.schedules),
        "sites": _sites(),
    }


@matplotlib.rc_context(STYLE)
def _powers(outcome: Outcome) -> Figure:
    figure = Figure(figsize=(WIDTH, 3.0), layout="constrained")
    grid = figure.subplots(1, 2, sharey=True)
    for axes, (name, cases) in zip(grid, _designs(outcome).items(), strict=True):
        width = 0.8 / len(cases)
        for i, (total, case) in enumerate(cases.items()):
            places = np.arange(len(NAMES)) + (i - (len(cases) - 1) / 2) * width
            shares, colour = 100 * case["powers"] / total, COLOURS[i % len(COLOURS)]
            axes.bar(places, shares, width, color=colour, label=f"{total:g} in all")
        axes.axhline(100 / len(NAMES), color=INK, linewidth=1.0, linestyle=DASHES)
        axes.set_xticks(range(len(NAMES)), NAMES)
        axes.set(title=name, xlabel="sensor")
        axes.grid(visible=False, axis="x")
        axes.legend(frameon=False, fontsize=9)
    grid[0].set_ylabel("share of the power (%)")
    return figure


@matplotlib.rc_context(STYLE)
def _schedules(schedules: Schedules) -> Figure:
    figure = Figure(figsize=(WIDTH, 3.0), layout="constrained")
    left, right = figure.subplots(1, 2)
    turns, bursts = schedules.turns, schedules.bursts
    for axes, title, values, bound in (
        (left, "one of six at a step", turns.by_period, turns.bound),
        (right, "two hops, seldom but loud", bursts.errors, bursts.bound),
    ):
        axes.plot(list(values), list(values.values()), "o-", color=BLUE, label="found")
        axes.axhline(bound, color=VERMILION, linewidth=1.2, linestyle=DASHES, label="nothing is below")
        axes.set(title=title)
        axes.legend(frameon=False, fontsize=9)
    left.set(xlabel="period", ylabel="mean error", xticks=list(turns.by_period))
    right.set(xlabel="sending every n-th step, n")
    return figure


@matplotlib.rc_context(STYLE)
def _sites() -> Figure:
    figure = Figure(figsize=(WIDTH, 3.2), layout="constrained")
    axes = figure.subplots()
    for exponent, colour in ((2.5, GREEN), (3.0, BLUE), (4.0, VERMILION)):
        ratio = 2**exponent * (exponent / 2 - 1)  # of rho, up to which the midpoint is best
        rho = np.geomspace(0.2 * ratio, 20 * ratio, POINTS)
        sites = np.array([relay_line(r, exponent).sites[0] for r in rho])
        nearer = np.minimum(sites, 1 - sites)
        axes.plot(rho, nearer, color=colour, linewidth=1.6, label=f"path loss exponent {exponent:g}")
        axes.plot([ratio], [0.5], "o", color=colour)
    axes.set(xscale="log", xlabel="noise of the whole way over the power, ρ", ylabel="best site (1: the whole way)")
    axes.legend(frameon=False, fontsize=9)
    return figure


def _designs(outcome: Outcome) -> dict[str, dict[float, Case]]:
    return {"one hop": outcome.one_hop, "two hops": outcome.two_hops}


example = Study("network-design", Setting, compute.compute, 7, figures, files=plaza2)
run = example.run
