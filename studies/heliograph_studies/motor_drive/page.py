"""How the example is shown: its figures and its report."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from heliograph.report.curves import Panel, curves_over_time
from heliograph.report.figures import (
    AMBER,
    BLUE,
    GREEN,
    INK,
    MUTED,
    PURPLE,
    VERMILION,
    Curve,
    consistency_over_time,
    errors_with_bands,
)
from heliograph.report.page import Code, KeyFigure, KeyFigures, Page, Picture, Points, Section, Table, Text
from heliograph_studies.motor_drive.compute import CASES, TRUSTS, UNITS, Outcome, Score
from heliograph_studies.motor_drive.drive import LOAD_STEP, LOAD_STEP_AT
from heliograph_studies.motor_drive.machine import RATED, STEP

ROWS = {  # filter: how it is called, and its colour
    "fused/zero_mean": ("both relays, zero-mean", BLUE),
    "fused/polytope": ("both relays, polytope", BLUE),
    "fused/equal_weights": ("both relays, equal weights", BLUE),
    "relay_1/zero_mean": ("relay 1, zero-mean", PURPLE),
    "relay_1/polytope": ("relay 1, polytope", PURPLE),
    "relay_1/mean_gain": ("relay 1, mean gain", VERMILION),
    "relay_2/zero_mean": ("relay 2, zero-mean", PURPLE),
    "relay_2/polytope": ("relay 2, polytope", PURPLE),
    "relay_2/mean_gain": ("relay 2, mean gain", VERMILION),
    "wired/perfect": ("no relay", GREEN),
    "wired/open_loop": ("no measurements", MUTED),
}
FUSED, MEAN_GAIN, WIRED = "fused/zero_mean", "relay_1/mean_gain", "wired/perfect"
SHORT = {FUSED: "both relays", MEAN_GAIN: "mean gain", WIRED: "no relay"}
DRAWN = {"own_model": GREEN, "load": AMBER, "resistance": PURPLE, "dead_time": VERMILION, "load_as_state": BLUE}
CASE_LABELS = {name: name.replace("_", " ") for name in CASES}
AVERAGED = 80  # rows, 40 ms


def motor_figures(outcome: Outcome) -> dict[str, Figure]:
    """The drive with its estimates, the errors of the speed within their claims, and consistency, by file name."""
    clock, truth = outcome.drive.time, outcome.drive.truth[:, :5] * RATED[:5]
    drawn = [("truth", INK, truth)]
    drawn += [(label, ROWS[name][1], outcome.shown["stated"][name]) for name, label in list(SHORT.items())[:2]]
    panels = [
        Panel("speed (rad/s)", [Curve(label, colour, x[:, 4]) for label, colour, x in reversed(drawn)]),
        Panel(
            "rotor flux (Vs)",
            [Curve(label, colour, np.hypot(x[:, 2], x[:, 3])) for label, colour, x in reversed(drawn)],
        ),
    ]
    errors = [
        Curve(
            label,
            ROWS[name][1],
            np.column_stack([outcome.shown[trust][name][:, 4] - truth[:, 4] for trust in TRUSTS]),
            np.column_stack([outcome.scores[trust]["load"][name].claimed_over_time["speed"] for trust in TRUSTS]),
        )
        for name, label in SHORT.items()
    ]
    nees = [
        Curve(CASE_LABELS[case], colour, outcome.scores["tenth"][case][FUSED].nees_over_time)
        for case, colour in DRAWN.items()
    ]
    return {
        "drive": curves_over_time(clock, panels, "time (s)"),
        "speed_errors": errors_with_bands(clock, errors, ("stated noise", "a tenth"), unit="rad/s"),
        "consistency": consistency_over_time(clock, nees, AVERAGED),
    }


def percent(score: Score, quantity: str) -> str:
    """Root mean square error in percent of the rated value."""
    return f"{100 * score.rmse[quantity] / UNITS[quantity]:.2f} %"


def number(value: float) -> str:
    """Three digits, whatever the size."""
    return f"{value:.0f}" if value >= 100 else f"{value:.3g}"


def filter_rows(scores: Mapping[str, Score]) -> list[list[str]]:
    """One row for each filter: errors in SI units and percent of rated, actual over claimed, NEES per dimension."""
    rows = []
    for name, (label, _) in ROWS.items():
        s = scores[name]
        rows.append([
            label,
            f"{s.rmse['flux'] * 1e3:.2f}", percent(s, "flux"), f"{s.rmse['speed']:.2f}", percent(s, "speed"),
            *(number(s.ratio(q)) for q in UNITS), number(s.nees[0]),
        ])  # fmt: skip
    return rows


def case_rows(outcome: Outcome, trust: str) -> list[list[str]]:
    """One row for each case, of the fused zero-mean filter and NEES of two others."""
    rows = []
    for case in CASES:
        scores = outcome.scores[trust][case]
        s = scores[FUSED]
        nees = (number(scores[name].nees[0]) for name in (FUSED, MEAN_GAIN, WIRED))
        share = (f"{100 * max(s.common[q], 0.0):.0f} %" for q in ("flux", "speed"))
        rows.append([CASE_LABELS[case], percent(s, "flux"), percent(s, "speed"),
                     number(s.ratio("flux")), number(s.ratio("speed")), *share, *nees])  # fmt: skip
    return rows


def motor_page(outcome: Outcome, drawings: Mapping[str, bytes]) -> Page:
    """The report; `drawings` holds each figure as SVG."""
    load = outcome.scores["stated"]["load"]
    fused, mean = load[FUSED], load[MEAN_GAIN]
    nees = {case: number(scores[FUSED].nees[0]) for case, scores in outcome.scores["stated"].items()}
    return Page(
        kicker="Heliograph example",
        title=f"A motor's speed through two fading relays: known to {percent(fused, 'speed')} of rated",
        lead=(
            "A drive simulator that this project did not write makes the truth; the filters know a model of it. "
            f"Through two fading relays the fused filter finds the speed to {percent(fused, 'speed')} and the flux to "
            f"{percent(fused, 'flux')} of rated; a filter that takes each gain for its mean has "
            f"{mean.rmse['speed'] / fused.rmse['speed']:.1f} times its error of the speed. Its NEES per dimension (1 "
            f"where the claimed covariance is right) is {nees['own_model']} on truth drawn from its own model, "
            f"{nees['load']} on the simulator, {nees['dead_time']} if the inverter has a dead time of 2 µs, and "
            f"{nees['euler']} with Euler's rule."
        ),
        sections=[_result(outcome, drawings), _why(outcome, drawings), _origin(), _limits(outcome), _rerun()],
        footer="Simulator: gym-electric-motor, its squirrel-cage induction motor with default parameters.",
    )


def _result(outcome: Outcome, drawings: Mapping[str, bytes]) -> Section:
    load = outcome.scores["stated"]["load"]
    keys = [
        KeyFigure(
            ROWS[n][0], f"{load[n].rmse['speed']:.2f} rad/s", f"claims {load[n].claimed['speed']:.2f}", ROWS[n][1]
        )
        for n in (FUSED, MEAN_GAIN, WIRED)
    ]
    headers = ["filter", "flux (mVs)", "of rated", "speed (rad/s)", "of rated",
               "current, actual / claimed", "flux, actual / claimed", "speed, actual / claimed",
               "NEES / dim"]  # fmt: skip
    caption = (
        f"Loaded drive, process noise as stated, {outcome.seeds} seeds of sensors and relays. Root mean square errors "
        "over all steps; **actual / claimed** above 1 is too sure, below 1 too cautious; NEES per dimension is 1 if "
        "the claim is exact."
    )
    table = Table(headers, filter_rows(load), caption, [colour for _, colour in ROWS.values()])
    picture = Picture(
        drawings["drive"],
        "Speed and flux over a second: truth and the fused estimate together, the mean-gain one scattered around.",
        f"The drive starts by voltage over frequency; {LOAD_STEP:g} Nm more load at {LOAD_STEP_AT:g} s. First seed.",
    )
    return Section("The result", [KeyFigures(keys), table, picture])


def _why(outcome: Outcome, drawings: Mapping[str, bytes]) -> Section:
    headers = ["case", "flux, of rated", "speed, of rated", "flux, actual / claimed", "speed, actual / claimed",
               "flux, from the model", "speed, from the model", "NEES / dim", "mean gain", "no relay"]  # fmt: skip
    blocks: list[Text | Points | Table | Picture] = [
        Points([f"**{CASE_LABELS[name]}**: {what}." for name, what in CASES.items()])
    ]
    for trust, what in {"stated": "as stated", "tenth": "of a tenth of the stated deviations"}.items():
        caption = (
            f"Both relays, zero-mean, process noise {what}. **From the model**: share of the squared error that is "
            "the same whatever sensors and relays draw. The last two columns: NEES per dimension of the mean-gain "
            "filter at relay 1 and of the filter without relay."
        )
        blocks.append(Table(headers, case_rows(outcome, trust), caption))
    blocks += [
        Picture(
            drawings["speed_errors"],
            "Speed errors of three filters within claimed bands, for two levels of process noise.",
            "Loaded drive, first seed: error of the speed (line) and two claimed deviations (band).",
        ),
        Picture(
            drawings["consistency"],
            "NEES per dimension over time in five cases.",
            f"Both relays, zero-mean, a tenth of the process noise: NEES per dimension over {AVERAGED} rows (40 ms). "
            "Load as state counts the error of the load's torque too.",
        ),
    ]
    return Section("How far off the claims are, and why", blocks)


def _origin() -> Section:
    points = [
        "**Truth:** currents, rotor flux and speed of the simulator's own differential equation, solved to its "
        f"tolerance, on an averaged inverter; the voltage is held over each step of {STEP * 1e3:g} ms.",
        "**Filters:** five states (two currents, two fluxes, speed) per unit, one Runge-Kutta step; the load's torque "
        "is not known and stands in the speed's process noise; the commanded voltage is taken as applied.",
        "**Simulated by heliograph:** current sensors of 0.05 A and two-hop relays whose gains fade at each step, the "
        "probabilities known to 0.02, with 0.05 A of noise at each hop.",
        "**Control:** the case own model runs the same filters on truth drawn from their own model, so that what is "
        "left there is the filter's, and the difference is the model's.",
    ]
    return Section("What is simulated, and by whom", [Points(points)])


def _limits(outcome: Outcome) -> Section:
    points = [
        "One drive and one load profile: the spread is over sensors and relays alone.",
        "The simulator has linear iron and an averaged inverter: saturation and switching ripple are not in the truth.",
        "The process noise was stated before any run: 1 Nm of load that lasts 50 ms, 0.05 A, 0.5 mVs for each step.",
        "Share from the model is an estimate from a few seeds; below zero it is shown as zero.",
    ]
    blocks: list[Points | Text] = [Points(points)]
    if outcome.failures:
        blocks.append(Text(["**Filters that failed:** " + "; ".join(outcome.failures) + "."]))
    return Section("What to keep in mind", blocks)


def _rerun() -> Section:
    command = "heliograph example motor-drive --out out"
    return Section("Run it again", [Code(command), Text(["Beside this page: `summary.json` and the figures."])])
