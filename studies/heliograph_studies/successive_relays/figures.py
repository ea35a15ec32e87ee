"""Figures of the reproduction, and what its page says beside the numbers."""

import numpy as np
from matplotlib.figure import Figure

from heliograph.report.figures import AMBER, BLUE, GREEN, INK, MUTED, PURPLE, VERMILION
from heliograph_studies.curves import Curve, Panel, curves_over_time
from heliograph_studies.successive_relays.compute import FILTERS, Outcome
from heliograph_studies.successive_relays.setting import STATES
from heliograph_studies.successive_relays.statements import worst_z, z_limit

COLOURS = {"relay_1": AMBER, "relay_2": VERMILION, "receiver": BLUE}
LABELS = {"relay_1": "relay 1", "relay_2": "relay 2", "receiver": "receiver"}
TITLES = {
    "paper": "the paper's gains", "joint": "all gains chosen for the receiver",
    "joint_quiet": "the same, at the paper's power",
    "lmmse": "the paper's relays, best linear receiver",
    "lmmse_tuned_from_paper": "best linear receiver, relays chosen for it",
    "lmmse_tuned": "the same, searched from another start", "lmmse_quiet": "the same, at the paper's power",
    "no_relay": "no relay: one hop, as late", "sensor_itself": "no relay, no channel: as late",
    "no_relay_filtered": "no relay: one hop, without delay",
    "sensor_itself_filtered": "no relay, no channel: without delay", "nothing_received": "nothing received",
}  # fmt: skip
UNITS = ("V", "V", "A")


def figures(outcome: Outcome) -> dict[str, Figure]:
    """Figs 2 to 5 by file name, and the tuned designs."""
    drawn = {f"fig{2 + i}_{state}": _trajectory(outcome, i) for i, state in enumerate(STATES)}
    drawn["fig5_traces"] = _traces(outcome)
    drawn["tuned"] = _tuned(outcome)
    return drawn


def _trajectory(outcome: Outcome, i: int) -> Figure:
    assert outcome.shown.truth is not None
    curves = [Curve("true", INK, outcome.shown.truth[0, :, i])]
    for name in FILTERS:
        curves.append(
            Curve(LABELS[name], COLOURS[name], np.asarray(outcome.shown.estimates[name]["local"].mean)[0, :, i])
        )
    label = f"{STATES[i].replace('_', ' ')} ({UNITS[i]})"
    return curves_over_time(outcome.shown.time, [Panel(label, curves)], "step k")


def _traces(outcome: Outcome) -> Figure:
    time = np.arange(outcome.setting.horizon + 1)
    designed = [Curve(LABELS[f], COLOURS[f], np.log10(outcome.designs.paper.trace(f))) for f in FILTERS]
    simulated = outcome.simulated
    ratio = simulated.mean["receiver"] / outcome.designs.paper.trace("receiver")
    band = simulated.error["receiver"] / outcome.designs.paper.trace("receiver")
    panels = [
        Panel("log10 of error variance", designed),
        Panel("simulated / computed", [Curve("receiver", BLUE, ratio), Curve("+2 s.e.", MUTED, 1 + 2 * band),
                                       Curve("−2 s.e.", MUTED, 1 - 2 * band)]),
    ]  # fmt: skip
    return curves_over_time(time, panels, "step k")


def _tuned(outcome: Outcome) -> Figure:
    time, paper = np.arange(1, outcome.setting.horizon + 1), outcome.designs.paper
    designs = {"free power": (GREEN, outcome.designs.tuned), "same power": (PURPLE, outcome.designs.bounded)}
    trace, power = paper.trace("receiver")[1:], paper.total_power()
    panels = [
        Panel("error / paper's", [Curve(n, c, d.trace("receiver")[1:] / trace) for n, (c, d) in designs.items()]),
        Panel("power / paper's", [Curve(n, c, d.total_power() / power) for n, (c, d) in designs.items()]),
    ]
    return curves_over_time(time, panels, "step k")


def words(outcome: Outcome) -> dict[str, object]:
    """Titles, colours, and the rows of three tables."""
    designs, total = outcome.designs, {name: s.even + s.odd for name, s in outcome.states.items()}
    z, where = worst_z(outcome)
    rows = [
        (TITLES[name], s.even, s.odd, total[name] / total["paper"],
         " / ".join(f"{p:.3f}" for p in s.power / outcome.states["paper"].power) if np.any(s.power) else "none")
        for name, s in ((name, outcome.states[name]) for name in TITLES if name in outcome.states)
    ]  # fmt: skip
    names = {"the paper's gains": designs.paper, "chosen for the receiver": designs.tuned,
             "the same, at the paper's power": designs.bounded}  # fmt: skip
    return {
        "colours": {"green": GREEN, "purple": PURPLE, "blue": BLUE},
        "titles": TITLES,
        "free": designs.mean_ratio(designs.tuned),
        "same": designs.mean_ratio(designs.bounded),
        "total": total,
        "worse": [designs.tuned.trace(f)[-1] / designs.paper.trace(f)[-1] for f in ("relay_2", "receiver")],
        "z": z,
        "where": where,
        "limit": z_limit(outcome.setting.horizon + 1),
        "rows": rows,
        "early": [
            (name, d.trace("receiver") / designs.paper.trace("receiver"),
             d.total_power() / designs.paper.total_power(), d.trace("relay_2")[-1])
            for name, d in names.items()
        ],
        "published_bounds": outcome.certificates["paper"].bounds.values(),
    }  # fmt: skip
