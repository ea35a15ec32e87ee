"""Figure of standardised residuals: over time, their autocorrelations, and their quantiles beside the normal law's."""

from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from scipy.special import ndtri
from scipy.stats import beta

from heliograph.disk.colours_of_figures import COLOURS

if TYPE_CHECKING:  # it takes a second
    from matplotlib.figure import Figure

PROBABILITY_OUTSIDE = 0.025  # probability beyond each side of a band
MOST_OUTPUTS = 20  # outputs of a figure
WIDTH, HEIGHT_OF_TITLES, HEIGHT_OF_ROW = 9.0, 0.5, 1.9  # inches
TWO_DEVIATIONS = 2  # about which 95 % of normal residuals lie


class ResidualQuantiles(NamedTuple):
    """Residuals in order, beside what they would be of a normal law.

    Args:
        normal: quantiles of the normal law (n,).
        residuals: sorted residuals that came (n,).
        low: below which each of them lies with probability 2.5 % where the law is normal (n,).
        high: above which likewise (n,).
    """

    normal: np.ndarray
    residuals: np.ndarray
    low: np.ndarray
    high: np.ndarray


def compare_with_normal_quantiles(e: np.ndarray) -> ResidualQuantiles:
    """Return residuals (steps,) without NaN in order, beside normal quantiles, with a band for each.

    The normal probability of the i-th of n residuals has the law Beta(i, n + 1 - i). The band leaves
    PROBABILITY_OUTSIDE beyond each side.
    """
    sorted_residuals = np.sort(e[~np.isnan(e)])
    n = len(sorted_residuals)
    i = np.arange(1, n + 1)
    low, high = (np.asarray(ndtri(beta.ppf(p, i, n + 1 - i))) for p in (PROBABILITY_OUTSIDE, 1 - PROBABILITY_OUTSIDE))
    return ResidualQuantiles(normal=ndtri(i / (n + 1)), residuals=sorted_residuals, low=low, high=high)


def draw_residuals(
    names: tuple[str, ...], values: np.ndarray, autocorrelation: np.ndarray, band: np.ndarray, time: np.ndarray
) -> "Figure":
    """Return a figure with a row of three panels for each output, the first twenty of them.

    The panels are residuals over time, autocorrelations by lag, and sorted residuals against the quantiles of a normal
    law. Residuals are innovations over their claimed deviations: white and normal of variance 1 if all is right.

    Args:
        names: names of the outputs.
        values: residuals (steps, m).
        autocorrelation: autocorrelations over the first lags, from lag 1 (lags, m).
        band: half-width (m,) of the interval that holds 95 % of the autocorrelations of white residuals.
        time: times of the rows (steps,).
    """
    from matplotlib.figure import Figure

    count = min(len(names), MOST_OUTPUTS)
    figure = Figure(figsize=(WIDTH, HEIGHT_OF_TITLES + HEIGHT_OF_ROW * count), layout="constrained")
    grid = figure.subplots(count, 3, squeeze=False, width_ratios=[2, 1, 1])
    lags = np.arange(1, len(autocorrelation) + 1)
    # Dotted lines at -+2 deviations and grey bands hold about 95 % of the points if the model is right.
    for i, (over_time, by_lag, in_order) in enumerate(grid):
        over_time.plot(time, values[:, i], ".", markersize=3, color=COLOURS[0])
        for level in (-TWO_DEVIATIONS, 0, TWO_DEVIATIONS):
            over_time.axhline(level, color="0.6", linewidth=0.8, linestyle="-" if level == 0 else ":")
        over_time.set_ylabel(names[i])
        by_lag.bar(lags, autocorrelation[:, i], 0.5, color=COLOURS[0])
        by_lag.axhspan(-band[i], band[i], color="0.85", zorder=0)
        quantiles = compare_with_normal_quantiles(values[:, i])
        in_order.fill_between(quantiles.normal, quantiles.low, quantiles.high, color="0.85", linewidth=0)
        in_order.plot(quantiles.normal, quantiles.residuals, ".", markersize=3, color=COLOURS[0])
        for panel in (over_time, by_lag, in_order):
            panel.spines[["top", "right"]].set_visible(False)
    titles = "residuals in deviations", "autocorrelation", "quantiles, of a normal law"
    for panel, title in zip(grid[0], titles, strict=True):
        panel.set_title(title, fontsize=10, loc="left")
    for panel, label in zip(grid[-1], ("row or time", "rows apart", "normal quantile"), strict=True):
        panel.set_xlabel(label)
    return figure
