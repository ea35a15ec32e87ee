"""Combinations of states, such as the components of a time series: mean, deviation, bands and a figure."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Protocol, runtime_checkable

import numpy as np
from scipy.special import ndtri
from typing_extensions import TypeAliasType

from heliograph.disk.colours_of_figures import COLOURS
from heliograph.model.estimate import Claim
from heliograph.numerics.check import array, fail, scalar, show_value, table
from heliograph.numerics.module import readable
from heliograph.numerics.types import ArrayLike, Float

if TYPE_CHECKING:  # it takes a second
    from matplotlib.figure import Figure

BAND = 0.95  # probability of a figure's bands
Weights = TypeAliasType("Weights", Mapping[str, Float[ArrayLike, "..."]])


@runtime_checkable
class HasMeans(Protocol):
    """What a filter or smoother returns of rows of data: means (steps, n), covariances (steps, n, n), their claim."""

    means: np.ndarray
    covariances: np.ndarray
    claim: Claim


@runtime_checkable
class HasMean(Protocol):
    """An estimate, of one time or of several, or the states of a forecast: mean (..., n), covariance (..., n, n)."""

    mean: np.ndarray
    covariance: np.ndarray
    claim: Claim


@readable
@dataclass(frozen=True)
class Components:
    """Combinations of states over time, each with what is claimed of its error.

    Args:
        names: of the combinations, m of them.
        mean: (steps, m).
        covariance: of their errors (steps, m, m); NaN where nothing is claimed.
        claim: what the covariance is: "exact", "upper", "nominal" or "none".
    """

    names: tuple[str, ...]
    mean: np.ndarray
    covariance: np.ndarray
    claim: Claim

    @property
    def deviation(self) -> Float[np.ndarray, "steps m"]:
        """Standard deviations (steps, m) of the errors, roots of the claimed variances; NaN where none is claimed."""
        variances = np.diagonal(self.covariance, axis1=-2, axis2=-1)
        return np.asarray(np.sqrt(np.maximum(variances, 0.0)))

    def interval(self, coverage: float = BAND) -> tuple[np.ndarray, np.ndarray]:
        """Return both ends (steps, m) of the Gaussian interval that holds each component with this probability.

        Args:
            coverage: probability inside, above 0 and below 1.

        Raises:
            ValueError: a coverage that is no probability between 0 and 1.
        """
        p = float(scalar("coverage", coverage, 0.0, 1.0))
        if not 0 < p < 1:
            raise fail("coverage", "a probability between 0 and 1", coverage)
        half_width = ndtri((1 + p) / 2) * self.deviation  # ndtri: quantile of the standard normal law
        return self.mean - half_width, self.mean + half_width

    def of(self, name: str) -> tuple[np.ndarray, np.ndarray]:
        """Return mean and standard deviation (steps,) of one combination of states, by its name.

        Raises:
            ValueError: no combination of this name.
        """
        if name not in self.names:
            raise fail("component", f"one of {list(self.names)}", show_value(name))
        index = self.names.index(name)
        return self.mean[..., index], self.deviation[..., index]

    def figure(self, time: "Float[ArrayLike, ' steps'] | None" = None, coverage: float = BAND) -> "Figure":
        """Return a figure with a panel for each combination: its mean, and the band that holds it.

        Args:
            time: numbers or dates (steps,); 0, 1, ... by default.
            coverage: probability with which the band holds the combination, under the claimed covariance; BAND by
                default.

        Raises:
            ValueError: times of another number, a coverage that is no probability between 0 and 1.
        """
        from matplotlib.figure import Figure

        low, high = self.interval(coverage)
        clock = np.arange(len(self.mean)) if time is None else np.asarray(time)
        if clock.shape != (len(self.mean),):
            raise fail("time", f"{len(self.mean)} times", f"shape {clock.shape}")
        figure = Figure(figsize=(7.0, 0.6 + 1.7 * len(self.names)), layout="constrained")
        panels = figure.subplots(len(self.names), 1, sharex=True, squeeze=False)[:, 0]
        for i, (panel, name) in enumerate(zip(panels, self.names, strict=True)):
            colour = COLOURS[i % len(COLOURS)]
            panel.plot(clock, self.mean[:, i], color=colour, linewidth=1.2)
            panel.fill_between(clock, low[:, i], high[:, i], color=colour, alpha=0.25, linewidth=0)
            panel.set_title(name, loc="left", fontsize=10)
            panel.spines[["top", "right"]].set_visible(False)
        return figure


def components(source: HasMeans | HasMean, weights: Weights) -> Components:
    """Take combinations of states out of estimates: sums of states, each times its weight.

    Args:
        source: what `filter.run`, `hg.rts_smoother` or a forecast's `states` is, or an `Estimate`.
        weights: by name the weights of the states, (n,), or of each row (steps, n); `model.components` of a structural
            model.

    Raises:
        ValueError: no estimates, no weights, weights of another number of states.
    """
    if isinstance(source, HasMeans):
        mean, covariance = np.asarray(source.means), np.asarray(source.covariances)
    elif isinstance(source, HasMean):
        mean, covariance = np.asarray(source.mean), np.asarray(source.covariance)
    else:
        raise fail("estimates", "what filter.run or hg.rts_smoother returns, or an Estimate", show_value(source))
    named = table("weights", weights, "weights of states")
    if not named:
        raise fail("weights", "at least one combination", "none")
    # Combination j has the weights w_j: the mean w_j' m, and the covariance w_i' P w_j of two of them.
    weights_by_combination = [_read_weights(name, value, mean) for name, value in named.items()]
    W = np.stack(weights_by_combination, axis=-2)  # (..., m, n)
    combined_mean = np.einsum("...mn,...n->...m", W, mean)
    combined_covariance = np.einsum("...mi,...ij,...kj->...mk", W, covariance, W)
    return Components(tuple(named), combined_mean, combined_covariance, source.claim)


def _read_weights(name: str, value: ArrayLike, mean: np.ndarray) -> np.ndarray:
    """Return the weights of a combination of states for each row, in the shape of `mean` (..., n).

    Weights (n,) hold for all rows. `name`: the name of the combination, for errors.
    """
    is_given_by_row = np.ndim(value) > 1
    shape = mean.shape if is_given_by_row else mean.shape[-1:]
    weights: np.ndarray = np.broadcast_to(array(f"weights of {name!r}", value, shape), mean.shape)
    return weights
