"""Flux and speed of an induction machine that gym-electric-motor simulates, its currents received through relays."""

import numpy as np
from matplotlib.figure import Figure

from heliograph.report.figures import AMBER, BLUE, GREEN, INK, MUTED, PURPLE, VERMILION
from heliograph_studies import Study
from heliograph_studies.curves import Curve, Panel, consistency_over_time, curves_over_time, errors_with_bands
from heliograph_studies.motor_drive import compute
from heliograph_studies.motor_drive.compute import CASES, TRUSTS, Outcome
from heliograph_studies.motor_drive.compute import Setting as Setting
from heliograph_studies.motor_drive.machine import LOAD_STEP as LOAD_STEP
from heliograph_studies.motor_drive.machine import LOAD_STEP_AT as LOAD_STEP_AT
from heliograph_studies.motor_drive.machine import RATED
from heliograph_studies.motor_drive.machine import STEP as STEP

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
SHORT = {"fused/zero_mean": "both relays", "relay_1/mean_gain": "mean gain", "wired/perfect": "no relay"}
DRAWN = {"own_model": GREEN, "load": AMBER, "resistance": PURPLE, "dead_time": VERMILION, "load_as_state": BLUE}
CASE_LABELS = {name: name.replace("_", " ") for name in CASES}
AVERAGED = 80  # rows, 40 ms


def figures(outcome: Outcome) -> dict[str, Figure]:
    """The drive with its estimates, the errors of the speed within their claims, and consistency."""
    clock, truth = outcome.drive.time, outcome.drive.truth[:, :5] * RATED[:5]
    drawn = [
        (SHORT[name], ROWS[name][1], outcome.shown["stated"][name]) for name in ("relay_1/mean_gain", "fused/zero_mean")
    ]
    drawn.append(("truth", INK, truth))
    panels = [
        Panel("speed (rad/s)", [Curve(label, colour, x[:, 4]) for label, colour, x in drawn]),
        Panel("rotor flux (Vs)", [Curve(label, colour, np.hypot(x[:, 2], x[:, 3])) for label, colour, x in drawn]),
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
        Curve(CASE_LABELS[case], colour, outcome.scores["tenth"][case]["fused/zero_mean"].nees_over_time)
        for case, colour in DRAWN.items()
    ]
    return {
        "drive": curves_over_time(clock, panels, "time (s)"),
        "speed_errors": errors_with_bands(clock, errors, ("stated noise", "a tenth"), unit="rad/s"),
        "consistency": consistency_over_time(clock, nees, AVERAGED),
    }


example = Study("motor-drive", Setting, compute.compute, 3, figures, needs=["gym_electric_motor"])
run = example.run
