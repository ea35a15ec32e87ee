"""How the example is shown: its figures and its report."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

from heliograph.report.curves import Panel, curves_over_time
from heliograph.report.figures import AMBER, BLUE, GREEN, MUTED, PURPLE, VERMILION, Curve, paths
from heliograph.report.page import Code, KeyFigure, KeyFigures, Page, Picture, Points, Section, Table, Text
from heliograph_studies.late_data.compute import RUNS, Outcome, Through
from heliograph_studies.late_data.moving import BEGIN, DURATION
from heliograph_studies.late_data.plaza import DRIVE
from heliograph_studies.late_data.replay import WINDOW

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
SOURCE = (
    "Vilgelm, Gürsu, Zoppi, Kellerer, Time slotted channel hopping for smart metering: measurements and analysis of "
    "medium access, IEEE SmartGridComm 2016; ranges: Djugash, Hamner and Roth, Navigating with ranging radios: five "
    "data sets with ground truth, 2009."
)


def late_data_figures(outcome: Outcome) -> dict[str, Figure]:
    """Errors of the point and of the mower over time, and the mower on its map, by file name."""
    point, mower = outcome.point, outcome.mower
    map_of = [
        Curve(f"{ROWS[n][0]}: {mower.scores[n].rmse:.2f} m off", ROWS[n][1], mower.shown[n].mean[:, :2])
        for n in ("used_as_current", "rewound")
    ]
    stretch = slice(0, STRETCH)
    return {
        "point": curves_over_time(
            point.time[stretch], [Panel("position error (m)", _errors(point, SHOWN, stretch))], "time (s)"
        ),
        "mower": curves_over_time(
            mower.time, [Panel("position error (m)", _errors(mower, SHOWN, slice(None)))], "time (s)"
        ),
        "map": paths(mower.truth, map_of, DRIVE.beacons),
    }


def _errors(found: Through, names: Sequence[str], stretch: slice) -> list[Curve]:
    """Distances from the truth, at the moments that estimates are of."""
    curves = []
    for name in names:
        heard = found.shown[name]
        at = np.column_stack([np.interp(found.time, heard.time, heard.mean[:, i]) for i in range(2)])
        error = np.where(found.time <= heard.time[-1], np.linalg.norm(at - found.truth, axis=1), np.nan)
        curves.append(Curve(ROWS[name][0], ROWS[name][1], error[stretch]))
    return curves


def late_data_page(outcome: Outcome, drawings: Mapping[str, bytes]) -> Page:
    """The report; `drawings` holds each figure as SVG."""
    scores = outcome.point.scores
    lead = (
        f"{100 * outcome.network.out_of_order:.0f} % of the packets arrive after a newer one. A filter that takes each "
        f"as current is off by {scores['used_as_current'].rmse:.1f} m; one that puts it where it belongs and replays "
        f"what came after, by {scores['rewound'].rmse:.2f} m. Waiting two seconds leaves {scores['lag_2s'].rmse:.2f} m."
    )
    right, wrong = scores["rewound"].rmse, scores["used_as_current"].rmse
    title = f"Late packets put where they belong: {right:.2f} m off, not {wrong:.1f} m"
    sections = [_point(outcome, drawings), _mower(outcome, drawings), _network(outcome), _again(outcome)]
    return Page("Heliograph example", title, lead, sections, SOURCE)


def _network(outcome: Outcome) -> Section:
    n = outcome.network
    what = (
        "**No recording was given**: this is a synthetic network with the statistics of a recorded one, independent "
        "delays, and losses that come in runs. With `--trace FILE` it is the recorded one."
        if outcome.trace is None
        else f"The log `{outcome.trace}`, as the network's root heard it; {outcome.odd} of its rows are no packets."
    )
    table = Table(
        ["", "share or time"],
        [
            ["lost, of those sent", f"{100 * n.lost:.1f} %"],
            ["lost, of those after a loss", f"{100 * n.lost_after_lost:.0f} %"],
            ["after a newer one, from anywhere", f"{100 * n.out_of_order:.0f} %"],
            ["after a newer one of the same node", f"{100 * n.out_of_order_own:.1f} %"],
            ["copies, of all that is heard", f"{100 * n.copies:.1f} %"],
            ["delay, median", f"{n.delay_median:.2f} s"],
            ["delay, 95 %", f"{n.delay_95:.1f} s"],
            ["delay, largest", f"{n.delay_max:.0f} s"],
        ],
        f"{n.packets:,} packets of {n.nodes} nodes, which started {n.boots} times.",
    )
    return Section("The network", [Text([what]), table])


def _table(found: Through, caption: str) -> Table:
    rows = [
        [label, f"{found.scores[name].rmse:.3f}", _nees(found.scores[name].nees)] for name, (label, _) in ROWS.items()
    ]
    return Table(["method", "RMSE (m)", "NEES / dim"], rows, caption, [colour for _, colour in ROWS.values()])


def _nees(value: float) -> str:
    return f"{value:.2f}" if value < 10 else f"{value:.0f}"


def _verdicts(found: Through) -> str:
    return ", ".join(f"{count:,} {verdict}" for verdict, count in found.counts.items() if count)


def _point(outcome: Outcome, drawings: Mapping[str, bytes]) -> Section:
    found = outcome.point
    keys = [
        KeyFigure(ROWS[name][0], f"{found.scores[name].rmse:.2f} m", "position error", ROWS[name][1])
        for name in ("used_as_current", "rewound", "lag_2s")
    ]
    caption = (
        f"A point pushed at random; each packet sent between {BEGIN:g} and {BEGIN + DURATION:g} s holds its position "
        f"with an error of 0.5 m on each axis. {RUNS} paths, judged every second. **NEES / dim**: squared error in "
        f"units of the claimed covariance; 1 where that is right. What became of the packets that were rewound over "
        f"{WINDOW:g} s: {_verdicts(found)}."
    )
    picture = Picture(
        drawings["point"],
        "Position error over the first minutes: least for the estimate of ten seconds ago.",
        "Errors at the moments that the estimates are of.",
    )
    methods = [
        "**Taken as current**: what arrives is used as if it had just been measured.",
        "**Late dropped**: what is older than something that was used already is thrown away.",
        "**Rewound**: it is put where it belongs in time, and what came after it is computed again.",
        "**2 s ago, 10 s ago, smoothed**: the estimate of that moment, from all that has arrived since.",
        "**No delay**: the same packets, as if each had arrived at once.",
    ]
    return Section("A point that moves", [KeyFigures(keys), _table(found, caption), Points(methods), picture])


def _mower(outcome: Outcome, drawings: Mapping[str, bytes]) -> Section:
    found = outcome.mower
    text = (
        "The demonstration's mower, its recorded ranges and odometry. The k-th range of a beacon is delayed or lost "
        "as the k-th packet of one of the four nodes that were heard most. Odometry is the robot's own and comes at "
        "once. Both are recordings, the drive and the network."
        if outcome.trace is not None
        else "The demonstration's mower, its recorded ranges and odometry; each range is late or lost as a packet is."
    )
    caption = f"{outcome.unheard} ranges never came. What became of the others, rewound: {_verdicts(found)}."
    chart = Picture(
        drawings["map"],
        "The mower's path with four beacons: the rewound path stays near the truth.",
        "The number is the root mean square position error.",
    )
    over_time = Picture(drawings["mower"], "Position error of the mower over time.", "Errors of three methods.")
    return Section("A recorded drive", [Text([text]), _table(found, caption), chart, over_time])


def _again(outcome: Outcome) -> Section:
    points = [
        "A packet is refused as **late** only if one that was measured after it is older than "
        f"{WINDOW:g} s by now. All others are used, whatever their age.",
        "Estimates of a while ago are smoothed over all that is held; they cost nothing until they are asked for.",
    ]
    trace = "" if outcome.trace is None else f" --trace {outcome.trace}"
    return Section("How to run this again", [Points(points), Code(f"heliograph example late-data --out out{trace}")])
