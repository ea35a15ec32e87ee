"""Packets that a recorded radio network delivered late, out of order and twice, and what a filter makes of them."""

import numpy as np
from matplotlib.figure import Figure

from heliograph.report.figures import AMBER, BLUE, GREEN, MUTED, PURPLE, VERMILION
from heliograph_studies import Study
from heliograph_studies.curves import Curve, Panel, curves_over_time, paths
from heliograph_studies.demo.recording import plaza2
from heliograph_studies.late_data import compute
from heliograph_studies.late_data.compute import Outcome, Through
from heliograph_studies.late_data.compute import Setting as Setting
from heliograph_studies.late_data.moving import BEGIN as BEGIN
from heliograph_studies.late_data.plaza import DRIVE
from heliograph_studies.late_data.replay import WINDOW as WINDOW

NEEDS = ("gtsam",)
ROWS = {  # method: how it is called, and its colour
    "used_as_current": ("taken as current", VERMILION),
    "late_dropped": ("late dropped", AMBER),
    "rewound": ("rewound", BLUE),
    "lag_2s": ("2 s ago, smoothed", PURPLE),
    "lag_10s": ("10 s ago, smoothed", GREEN),
    "no_delay": ("no delay", MUTED),
}
SHOWN = ("late_dropped", "rewound", "lag_10s")
STRETCH = 150  # moments: wide enough to read


def figures(outcome: Outcome) -> dict[str, Figure]:
    """Errors of the point and of the mower over time, and the mower on its map."""
    mower = outcome.plaza.through
    routes = [
        Curve(f"{ROWS[name][0]}: {mower.rmse[name]:.2f} m off", ROWS[name][1], mower.shown[name].mean[:, :2])
        for name in ("used_as_current", "rewound")
    ]
    return {
        "point": errors_over_time(outcome.point, slice(0, STRETCH)),
        "mower": errors_over_time(mower, slice(None)),
        "map": paths(mower.truth, routes, DRIVE.beacons),
    }


def errors_over_time(through: Through, stretch: slice) -> Figure:
    """Distances from the truth, at the moments that estimates are of."""
    curves = []
    for name in SHOWN:
        shown = through.shown[name]
        x, y = (np.interp(through.time, shown.time, shown.mean[:, i]) for i in range(2))
        at = np.column_stack([x, y])
        error = np.where(through.time <= shown.time[-1], np.linalg.norm(at - through.truth, axis=1), np.nan)
        curves.append(Curve(*ROWS[name], error[stretch]))
    return curves_over_time(through.time[stretch], [Panel("position error (m)", curves)], "time (s)")


example = Study("late-data", Setting, compute.compute, 3, figures, needs=NEEDS, files=plaza2)
run = example.run
