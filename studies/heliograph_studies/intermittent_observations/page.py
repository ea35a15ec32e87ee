"""Figures and report of the reproduction."""

from collections.abc import Mapping

import numpy as np
from matplotlib.figure import Figure

from heliograph.report.curves import Panel, curves_over, curves_over_time
from heliograph.report.figures import AMBER, BLUE, GREEN, MUTED, VERMILION, Curve
from heliograph.report.page import Code, KeyFigure, KeyFigures, Page, Picture, Points, Section, Table, Text
from heliograph_studies.intermittent_observations import setting
from heliograph_studies.intermittent_observations.compute import Link, Reproduction
from heliograph_studies.intermittent_observations.statements import statements
from heliograph_studies.verdicts import verdict_blocks

BURST_COLOURS = (GREEN, BLUE, AMBER)


def drawings(result: Reproduction) -> dict[str, Figure]:
    """Figures by file name."""
    return {
        "scalar": _over_arrival(result, "scalar"),
        "coupled": _over_arrival(result, "coupled"),
        "bursts": _bursts(result),
        "patterns": _patterns(result),
        "rounding": _rounding(result),
    }


def _over_arrival(result: Reproduction, name: str) -> Figure:
    found, critical = result.curves[name], result.critical[name]
    curves = [Curve("upper bound", VERMILION, found.upper), Curve("lower bound", MUTED, found.lower)]
    if np.isfinite(found.mean).any():
        curves.insert(1, Curve("mean", BLUE, found.mean))
    marks = {f"{critical.lower:.3f}": critical.lower}
    if critical.upper - critical.lower > 0.01:
        marks[f"{critical.upper:.3f}"] = critical.upper
    label = "mean of tr P" if name != "scalar" else "mean of P"
    return curves_over(found.arrival, Panel(label, curves), "arrival probability", marks)


def _bursts(result: Reproduction) -> Figure:
    curves = [
        Curve(f"begin: {fail:g}", colour, mean)
        for (fail, (_, _, mean)), colour in zip(result.burst_curves.items(), BURST_COLOURS, strict=True)
    ]
    threshold = max(result.recovery.values())
    recover = next(iter(result.burst_curves.values()))[0]
    return curves_over(
        recover, Panel("mean of P", curves), "probability that losses end", {f"{threshold:.3f}": threshold}
    )


def _patterns(result: Reproduction) -> Figure:
    steps = np.arange(2, len(result.between))
    curves = []
    for name, colour, values in (("arrival 0.42", BLUE, result.between), ("arrival 0.30", VERMILION, result.below)):
        increments = np.diff(values)
        curves.append(Curve(name, colour, increments[1:] / increments[:-1]))
    curves.append(Curve("bound at 0.42", MUTED, np.full(len(steps), result.between_bound)))
    return curves_over_time(steps, [Panel("increment over the last one", curves)])


def _rounding(result: Reproduction) -> Figure:
    it = result.iterated
    curves = [
        Curve("as printed, skew part", VERMILION, np.where(it.skew > 0, it.skew, np.nan)),
        Curve("as squares, tr V", BLUE, it.joseph),
    ]
    steps = np.arange(1, len(it.joseph) + 1)
    return curves_over(steps, Panel("skew part of V, and tr V", curves), "step")


def page(result: Reproduction, pictures: Mapping[str, bytes]) -> Page:
    """The report; `pictures` holds each figure as SVG."""
    critical = result.critical
    return Page(
        kicker="Reproduction: Kalman filtering with intermittent observations, and its successors",
        title=f"{100 * critical['scalar'].lower:.0f} % of the packets must arrive, or the mean error has no bound",
        lead=(
            "A Kalman filter that knows which packets were lost skips them. For an unstable scalar plant (a = −1.25) "
            f"its mean error is bounded if and only if more than {100 * critical['scalar'].upper:.0f} % of the packets "
            "arrive. In the classic example of two states the mean error is proven bounded above an arrival "
            f"probability of {critical['coupled'].upper:.3f} and unbounded below {critical['coupled'].lower:.2f}; "
            "nothing is proven in between. Where losses come in bursts it matters how soon they end, not how seldom "
            "they begin."
        ),
        sections=[
            _result(result),
            _statements(result),
            _arrival(pictures),
            _in_bursts(pictures),
            _gap(pictures),
            _arithmetic(pictures),
            _notes(),
            _rerun(result),
        ],
        footer="Every number is in summary.json; the curves are in curves.npz.",
    )


def _result(result: Reproduction) -> Section:
    keys = [
        KeyFigure("scalar", f"{result.critical['scalar'].upper:.2f}", "of the packets must arrive, a = −1.25", BLUE),
        KeyFigure("two states", f"{result.critical['coupled'].upper:.3f}", "from here on a bound is proven", VERMILION),
        KeyFigure(
            "in bursts",
            f"{max(result.recovery.values()):.2f}",
            "probability of an end that is needed, however seldom losses begin",
            GREEN,
        ),
    ]
    rows = [
        _row(name, link)
        for name, link in (
            ("scalar", result.scalar),
            ("two states", result.coupled),
            ("three states, one unstable", result.one_unstable),
            *((f"scalar, fail {b.fail:g}, recover {b.recover:g}", b) for b in result.bursts),
        )
    ]
    caption = (
        "Traces of the error covariance in the long run, before each measurement. **Mean**: of P, by quadrature where "
        "the plant is scalar. **Simulated**: from filters that ran, ± one standard error. **Radius**: spectral radius "
        "of the operator that proves the upper bound; it does below 1."
    )
    headers = ["plant and link", "lower bound", "mean", "simulated", "upper bound", "radius"]
    return Section("Bounds and what lies between them", [KeyFigures(keys), Table(headers, rows, caption)])


def _row(name: str, link: Link) -> list[str]:
    mean = "–" if np.isnan(link.mean_error) else f"{link.mean_error:.4f}"
    simulated = f"{link.simulated.mean:.5g} ± {link.simulated.error:.2g}"
    return [name, f"{link.lower:.6g}", mean, simulated, f"{link.bound:.7g}", f"{link.judged.radius:.4f}"]


def _arrival(pictures: Mapping[str, bytes]) -> Section:
    return Section(
        "Error against arrival probability",
        [
            Picture(
                pictures["scalar"],
                "Mean error and its bounds rise without end as arrivals fall to 0.36.",
                "Scalar plant: both conditions are one, at the dashed line.",
            ),
            Picture(
                pictures["coupled"],
                "The upper bound ends at 0.471, the lower one at 0.36.",
                "Two states, one output: left of the first line nothing helps, right of the second one a bound holds.",
            ),
        ],
    )


def _in_bursts(pictures: Mapping[str, bytes]) -> Section:
    caption = "Scalar plant, losses in bursts. How often losses begin moves the error, not the threshold (dashed)."
    return Section("Losses in bursts", [Picture(pictures["bursts"], "E P over recovery for three rates.", caption)])


def _gap(pictures: Mapping[str, bytes]) -> Section:
    text = (
        "Between the two conditions nothing is proven. Listing every pattern of losses shows what happens "
        f"there for a few steps: at an arrival of {setting.BETWEEN:g} the mean settles, although its bound would not."
    )
    caption = "Ratio of successive increments of the mean of tr P, two states; below 1 it settles."
    return Section("Between the conditions", [Text([text]), Picture(pictures["patterns"], "Ratios by step.", caption)])


def _arithmetic(pictures: Mapping[str, bytes]) -> Section:
    caption = (
        "The modified Riccati equation iterated as printed: rounding's skew part grows as the plant does, until "
        "nothing is left of V. As a sum of squares V settles."
    )
    return Section("In floating-point arithmetic", [Picture(pictures["rounding"], "Skew part over steps.", caption)])


def _statements(result: Reproduction) -> Section:
    return Section("What the publications state", verdict_blocks(statements(result)))


def _notes() -> Section:
    points = [
        "**Upper bound:** the steady second moment of the error under fixed gains, one for each set of losses; the "
        "gains are searched, then judged by the spectral radius of their own operator.",
        "**Lower bound:** losses carry everything on, arrivals leave nothing but the process noise of one step.",
        "**Mean** is all that is spoken of: below a threshold P itself need not be large at most times.",
        "The publications are cited for what is known of them in the field; all numbers are computed here.",
    ]
    return Section("What is compared", [Points(points)])


def _rerun(result: Reproduction) -> Section:
    command = f"heliograph reproduce intermittent-observations --out out --runs {result.runs} --seed {result.seed}"
    return Section("Run it again", [Code(command)])
