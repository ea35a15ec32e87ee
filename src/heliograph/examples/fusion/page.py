"""How the example is shown."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from heliograph.examples.fusion.compute import CASES, MANY, MEASURED_STEPS, RUNS, STEPS, Outcome
from heliograph.report.curves import Panel, curves_over_time
from heliograph.report.figures import AMBER, BLUE, GREEN, PURPLE, VERMILION, Curve
from heliograph.report.page import KeyFigure, KeyFigures, Page, Picture, Section, Table, Text

DRAWN = {"matrix": BLUE, "matrix_with_mean": AMBER, "all_reports": PURPLE, "central": GREEN}
LABELS = {
    "equal_intersection_claimed": "equal intersection, claimed",
    "equal_intersection_true": "equal intersection, its error",
    "scalar": "scalar weights",
    "matrix": "matrix weights",
    "matrix_with_mean": "matrix weights and the plant's mean",
    "all_reports": "all reports ever heard",
    "central": "central filter",
}
SHOWN_STEPS = 60


def fusion_figures(outcome: Outcome) -> dict[str, Figure]:
    """Traces over time, a panel for each case."""
    clock = np.arange(1, SHOWN_STEPS + 1)
    panels = [
        Panel(name.replace("_", " "), [
            Curve(LABELS[rule], colour, outcome.traces[name][rule][:SHOWN_STEPS]) for rule, colour in DRAWN.items()
        ])
        for name in CASES
    ]  # fmt: skip
    return {"traces": curves_over_time(clock, panels, "step")}


def fusion_page(outcome: Outcome, pictures: Mapping[str, bytes]) -> Page:
    """The report."""
    rooms, equal, tree = outcome.cases["three_rooms"], outcome.cases["four_equal"], outcome.tree
    rows = [[label, *(_number(outcome.cases[case][rule]) for case in CASES)] for rule, label in LABELS.items()]
    judged = [
        [LABELS[rule], f"{m['claimed']:.4f}", f"{m['measured']:.4f} ± {m['standard_error']:.4f}"]
        for rule, m in outcome.measured.items()
    ]
    scale = outcome.scale
    sections = [
        Section("What each rule reaches", [
            KeyFigures([
                _key("equal intersection claims", rooms["equal_intersection_claimed"], "three rooms", VERMILION),
                _key("matrix weights", rooms["matrix"], "three rooms", BLUE),
                _key("matrix weights", equal["matrix"], "four equal sensors", BLUE),
                _key("all reports", equal["all_reports"], "four equal sensors", PURPLE),
            ]),
            Table(["rule", *(name.replace("_", " ") for name in CASES)], rows,
                  f"Traces of the error's covariance after {STEPS} steps."),
            Picture(pictures["traces"], "Traces of four rules over time in three networks",
                    "Trace of the error's covariance over time."),
        ]),
        Section("Is it so?", [
            Table(["rule", "claimed", "measured"], judged,
                  f"Three rooms, mean square error at step {MEASURED_STEPS} of {RUNS} simulated runs."),
        ]),
        Section("Trees and many nodes", [
            Text([
                "Twelve nodes heard by four relays, these by two, these by a root, each forwarding its matrix-"
                f"weighted estimate: {tree['root']:.4f} at the root, {tree['flat']:.4f} where one centre hears all "
                f"nodes, {tree['central']:.4f} for the central filter.",
                f"All cross-covariances and weights of {MANY} nodes took {scale['seconds']:.1f} s and "
                f"{scale['peak_gb']:.2f} GB: {scale['matrix']:.4f} instead of {scale['local']:.2f} at a node.",
            ]),
        ]),
    ]  # fmt: skip
    lead = (
        "Local filters of one plant share its noise, so their errors are correlated; for linear filters behind known "
        "laws the correlation is known before any data. Intersection claims what holds for every correlation; weights "
        "that know this one claim, exactly, what they have."
    )
    return Page("Heliograph example", "Fusion that knows what is shared", lead, sections)


def _key(label: str, value: float | list[float], note: str, colour: str) -> KeyFigure:
    return KeyFigure(label, _number(value), note, colour)


def _number(value: float | list[float]) -> str:
    return f"{value:.4f}" if isinstance(value, float) else ", ".join(f"{v:.4g}" for v in value)
