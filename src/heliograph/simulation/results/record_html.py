"""A record as HTML for notebooks: each state's estimates with their bands, without a plotting package."""

from collections.abc import Iterator, Mapping, Sequence
from html import escape
from typing import Protocol

import numpy as np

from heliograph.disk.colours_of_figures import COLOURS
from heliograph.disk.quoted_text import label_with_unit, visible
from heliograph.model.estimate import Estimate
from heliograph.numerics.times.dates import format_times

PANELS, FILTERS, POINTS = 6, 4, 500  # drawn at most: states, filters of a node, and rows of them
SIGMAS = 2.0  # half-width of bands in claimed deviations
WIDE, HIGH = 1000.0, 100.0  # the units of a drawing, which is as wide as there is room
LEAST = 1e-12  # the part of a value that is the least height of a panel


class DrawableRecord(Protocol):
    """What is drawn of a record."""

    @property
    def time(self) -> np.ndarray:
        """Return numbers or dates, (time,)."""

    @property
    def states(self) -> tuple[str, ...]:
        """Return the names of the states."""

    @property
    def units(self) -> dict[str, str]:
        """Return units by name."""

    @property
    def truth(self) -> np.ndarray | None:
        """Return the true states, where they are known."""

    @property
    def estimates(self) -> dict[str, dict[str, Estimate]]:
        """Return estimates by node and filter."""

    @property
    def runs(self) -> int | None:
        """Return the number of Monte Carlo runs."""

    def of_run(self, run: int) -> "DrawableRecord":
        """Return one of the runs."""


def write_record_html(record: DrawableRecord) -> str:
    """Draw the estimates of the first node that has any: means with bands of two claimed deviations, and the truth.

    Args:
        record: a record; of Monte Carlo runs the first is drawn.

    Returns:
        HTML that fetches nothing, runs nothing, and fits any width.
    """
    # The title, and the first node with estimates.
    node = next((name for name, filters in record.estimates.items() if filters), None)
    rows, runs = len(record.time), record.runs
    title = f"{type(record).__name__}: {rows} row{'s' * (rows != 1)}"
    title += "" if runs is None else f" of {runs} runs, the first drawn"
    if node is None or rows == 0 or runs == 0:
        return f"<div>{title}, no estimates</div>"
    one = record if runs is None else record.of_run(0)  # the first of Monte Carlo runs is drawn
    # At most FILTERS filters, POINTS rows and PANELS states are drawn, with notes on what is left out.
    filters = dict(list(one.estimates[node].items())[:FILTERS])
    chosen = np.unique(np.linspace(0, rows - 1, min(rows, POINTS)).round().astype(int))
    left_out = {"filters": len(one.estimates[node]) - len(filters), "states": len(one.states) - PANELS}
    notes = [f"{count} more {what}" for what, count in left_out.items() if count > 0]
    notes += [f"{len(chosen)} rows of {rows} drawn"] if len(chosen) < rows else []
    # A panel for each state, and the first and last time below.
    panels = [_write_panel(one, filters, i, chosen) for i in range(min(len(one.states), PANELS))]
    times = "".join(f"<span>{escape(time)}</span>" for time in format_times(record.time[[0, -1]]))
    note = f"<div>{escape('; '.join(notes))}</div>" if notes else ""
    return (
        '<div style="max-width:640px;font-size:13px;line-height:1.4">'
        f"<div><b>{escape(visible(title))}</b>, node {escape(visible(node))}</div>{_make_legend(filters, one)}"
        f'{"".join(panels)}<div style="display:flex;justify-content:space-between">{times}</div>{note}</div>'
    )


def _make_legend(filters: Mapping[str, Estimate], record: DrawableRecord) -> str:
    """Return a line of HTML with the filters' names, colours and claims, and the truth where it is drawn.

    A claim says what a covariance is, such as "exact". The truth is a dashed line, a filter a patch of its colour.
    """
    entries = [
        (f"background:{colour}", f"{name} ({estimate.claim})")
        for colour, (name, estimate) in zip(COLOURS, filters.items(), strict=False)
    ]
    entries += [("border-top:2px dashed;height:0", "truth")] if record.truth is not None else []
    spans = [
        f'<span style="margin-right:12px"><span style="display:inline-block;width:14px;height:8px;{style};'
        f'margin-right:4px"></span>{escape(visible(words))}</span>'
        for style, words in entries
    ]
    return f"<div>{''.join(spans)}</div>"


def _write_panel(record: DrawableRecord, filters: Mapping[str, Estimate], state: int, chosen: np.ndarray) -> str:
    """Return one state as HTML: its name and last value, the range of its axis, and the drawing.

    Args:
        record: one run.
        filters: estimates by name of the filter.
        state: number of the state.
        chosen: rows that are drawn.
    """
    # For each filter the mean and both ends of its band (rows,); the truth; and the range that holds all of them.
    curves = [_read_curve(estimate, state, chosen) for estimate in filters.values()]
    truth = None if record.truth is None else np.asarray(record.truth)[chosen, state]
    low, high = _find_range([part for curve in curves for part in curve] + ([] if truth is None else [truth]))

    def to_height(values: np.ndarray) -> np.ndarray:
        """Return the heights of values in the drawing, downwards from the top."""
        return HIGH * (high - values) / (high - low)

    # Band and mean of each filter in its colour; the truth dashed.
    parts = []
    for colour, (mean, lower, upper) in zip(COLOURS, curves, strict=False):
        parts += [f'<path d="{d}" fill="{colour}" fill-opacity="0.2" stroke="none"/>'
                  for d in _yield_band_paths(to_height(lower), to_height(upper))]  # fmt: skip
        parts.append(_write_curve_path(to_height(mean), colour))
    if truth is not None:
        parts.append(_write_curve_path(to_height(truth), "currentColor", ' stroke-dasharray="4 3"'))
    # Last mean of the first filter, with half of its band.
    (mean, _, upper), *_ = curves
    last = f"{mean[-1]:.4g}" + (f" ± {upper[-1] - mean[-1]:.2g}" if np.isfinite(upper[-1]) else "")
    name = escape(visible(label_with_unit(record.states[state], record.units)))
    return (
        f'<div style="display:flex;justify-content:space-between;margin-top:6px"><span>{name}</span>'
        f"<span>last {last}</span></div>"
        '<div style="display:grid;grid-template-columns:auto minmax(0,1fr);gap:0 6px">'
        '<div style="display:flex;flex-direction:column;justify-content:space-between;text-align:right">'
        f"<span>{high:.3g}</span><span>{low:.3g}</span></div>"
        f'<svg viewBox="0 0 {WIDE:g} {HIGH:g}" preserveAspectRatio="none" role="img" aria-label="{name}" '
        f'style="width:100%;height:110px;border:1px solid rgba(128,128,128,0.4)">{"".join(parts)}</svg></div>'
    )


def _read_curve(estimate: Estimate, state: int, rows: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return the mean, and the lower and upper end of the band, of a state in the chosen rows.

    The band is SIGMAS (2) claimed deviations to either side. Its ends are NaN if nothing is claimed.
    """
    mean = np.asarray(estimate.mean)[rows, state]
    variance = np.asarray(estimate.covariance)[rows, state, state]
    has_claim = (variance >= 0) & (estimate.claim != "none")
    half_width = SIGMAS * np.sqrt(np.where(has_claim, variance, np.nan))
    return mean, mean - half_width, mean + half_width


def _find_range(arrays: Sequence[np.ndarray]) -> tuple[float, float]:
    """Return the range of all finite values, a little wider, and never empty."""
    values = np.concatenate(arrays)
    values = values[np.isfinite(values)]
    if not len(values):
        return 0.0, 1.0
    low, high = float(values.min()), float(values.max())
    # Add 4 % on either side, or LEAST (1e-12) of the size if all values are equal.
    margin = max(0.04 * (high - low), LEAST * max(abs(low), abs(high), 1.0))
    return low - margin, high + margin


def _compute_x_places(count: int) -> np.ndarray:
    """Return where the `count` points of a curve are from left to right, in units of the drawing."""
    return WIDE * (np.arange(count) + 0.5) / count if count == 1 else np.linspace(0, WIDE, count)


def _split_at_gaps(finite: np.ndarray) -> Iterator[np.ndarray]:
    """Yield the numbers of each run of points that are `finite` without a gap."""
    numbers = np.flatnonzero(finite)
    yield from (piece for piece in np.split(numbers, np.flatnonzero(np.diff(numbers) > 1) + 1) if len(piece))


def _write_curve_path(y: np.ndarray, colour: str, attributes: str = "") -> str:
    """Return a curve of heights y as an SVG path, with gaps where y is NaN.

    In SVG, M moves the pen and L draws a line to a point. `attributes`: further attributes of the path.
    """
    x = _compute_x_places(len(y))
    path = ""
    for piece in _split_at_gaps(np.isfinite(y)):
        points = [f"{x[k]:.1f} {y[k]:.2f}" for k in piece]
        path += "M" + "L".join(points)
    return (
        f'<path d="{path}" fill="none" stroke="{colour}" stroke-width="1.5" vector-effect="non-scaling-stroke"'
        f' stroke-linecap="round"{attributes}/>'
    )


def _yield_band_paths(lower: np.ndarray, upper: np.ndarray) -> Iterator[str]:
    """Yield an SVG path around each piece without NaN of the band between two curves of heights.

    It goes along the upper curve and back along the lower one; Z closes it.
    """
    x = _compute_x_places(len(lower))
    for piece in _split_at_gaps(np.isfinite(lower) & np.isfinite(upper)):
        along_upper = [f"{x[k]:.1f} {upper[k]:.2f}" for k in piece]
        back_along_lower = [f"{x[k]:.1f} {lower[k]:.2f}" for k in piece[::-1]]
        yield f"M{'L'.join(along_upper + back_along_lower)}Z"
