"""What a forecast says of several numbers at several horizons: mean, covariance, quantiles, probabilities."""

from collections.abc import Callable
from dataclasses import dataclass, field, replace
from typing import Literal, TypeAlias

import numpy as np
from scipy.special import ndtr, ndtri
from typing_extensions import TypeAliasType

from heliograph.model.estimate import Claim
from heliograph.numerics.check import array, fail, is_whole, scalar, show_value
from heliograph.numerics.module import readable
from heliograph.numerics.types import ArrayLike, Float

BISECTIONS = 80  # of a bracket of a quantile: from some deviations to the last digit
Array = TypeAliasType("Array", np.ndarray)
InputsAhead: TypeAlias = Literal["none", "given", "held"]


@readable
@dataclass(frozen=True)
class Prediction:
    """The law of some numbers at each horizon: a Gaussian, or a mixture of K of them, of which each part is Gaussian.

    Quantiles and probabilities are of the mixture, cut to the limits of states that have some; mean and covariance are
    the first two moments, and the claim is about these alone. Noise with outliers (`StudentT`, `Contaminated`) of the
    sensor and of the last hop is in the law of what is measured and received as the mixture that it is. The quantiles
    of an angle go on from its mean, so that a band about pi stays a band. Of several sources all arrays have one more
    axis, of sources, before that of horizons. Of what nothing has been heard yet (`hg.diffuse`), and behind noise that
    has no variance (`StudentT` of at most two degrees), the deviation is infinite, and so are the ends of intervals; a
    probability there is none, NaN.

    Args:
        names: of the numbers, m of them.
        mean: (horizons, m), angles between -pi and pi.
        covariance: of the error (horizons, m, m); NaN where nothing is claimed.
        claim: what the covariance is: "exact", "upper", "nominal" or "none".
        weights: of the parts of each number (horizons, K, m).
        part_means: (horizons, K, m), angles within half a turn of the mean's; before they are cut to limits.
        part_variances: (horizons, K, m), likewise.
        limits: lowest and highest value of each number, infinite where there is no limit.
    """

    names: tuple[str, ...]
    mean: Array
    covariance: Array
    claim: Claim
    weights: Array = field(repr=False)
    part_means: Array = field(repr=False)
    part_variances: Array = field(repr=False)
    limits: tuple[tuple[float, float], ...] = field(repr=False)

    @property
    def deviation(self) -> Float[np.ndarray, "horizons m"]:
        """Claimed standard deviations (horizons, m)."""
        variances = np.diagonal(self.covariance, axis1=-2, axis2=-1)
        return np.sqrt(np.where(variances >= 0, variances, np.nan))

    def quantile(self, level: float) -> Float[np.ndarray, "horizons m"]:
        """Return the number below which each lies with probability `level`, (horizons, m).

        Raises:
            ValueError: a level that is no probability between 0 and 1.
        """
        p = float(scalar("level of a quantile", level, 0, 1))
        if not 0 < p < 1:
            raise fail("level of a quantile", "a probability between 0 and 1", level)
        means, deviations = self.part_means, np.sqrt(self.part_variances)
        low_end, high_end = np.transpose(self.limits)
        with np.errstate(invalid="ignore"):  # no median of what is unknown
            below_low = self._find_part_probabilities(low_end)
            below_high = self._find_part_probabilities(high_end)
            probabilities = below_low + p * (below_high - below_low)
            quantiles = np.clip(means + ndtri(probabilities) * deviations, low_end, high_end)  # of each part
        # The mixture's lies between the least and the greatest of its parts': halve that interval.
        low, high = quantiles.min(axis=-2), quantiles.max(axis=-2)
        for _ in range(BISECTIONS if means.shape[-2] > 1 else 0):
            middle = (low + high) / 2
            is_below = self._find_probability_below(middle) < p
            low = np.where(is_below, middle, low)
            high = np.where(is_below, high, middle)
        return np.where(np.isnan(self.deviation), np.nan, (low + high) / 2)

    def interval(self, coverage: float = 0.95) -> tuple[np.ndarray, np.ndarray]:
        """Return both ends (horizons, m) of the central interval that holds each number with this probability.

        Args:
            coverage: probability inside, between 0 and 1.

        Raises:
            ValueError: a coverage that is no probability between 0 and 1.
        """
        p = float(scalar("coverage", coverage, 0, 1))
        return self.quantile((1 - p) / 2), self.quantile((1 + p) / 2)

    def below(self, values: ArrayLike) -> Float[np.ndarray, "horizons m"]:
        """Return the probability that each number lies below its value; values are (), (m,) or (horizons, m).

        Raises:
            ValueError: values of another shape.
        """
        numbers = np.asarray(values, dtype=float)
        if numbers.shape not in ((), self.mean.shape[-1:], self.mean.shape):
            raise fail("values", f"one, or shape {self.mean.shape[-1:]} or {self.mean.shape}", f"shape {numbers.shape}")
        limits = np.broadcast_to(array("values", numbers, numbers.shape), self.mean.shape)
        return np.where(np.isfinite(self.deviation), self._find_probability_below(limits), np.nan)

    def map_arrays(self, change: Callable[[np.ndarray, int], np.ndarray]) -> "Prediction":
        """Return the prediction with each of its arrays replaced by what `change` makes of it.

        Args:
            change: function of an array and of its number of axes after the axis of horizons.
        """
        return replace(
            self,
            mean=change(self.mean, 1),
            covariance=change(self.covariance, 2),
            weights=change(self.weights, 2),
            part_means=change(self.part_means, 2),
            part_variances=change(self.part_variances, 2),
        )

    def _find_probability_below(self, values: np.ndarray) -> np.ndarray:
        """Return P(number < value) (horizons, m) = sum_k weight_k P(x_k < value | low <= x_k <= high), x_k Gaussian.

        x_k are the parts of the mixture, and low and high are the limits of the number. `values` are (horizons, m).
        """
        low, high = np.transpose(self.limits)
        # P(x_k < value), P(x_k < low) and P(x_k < high), each (horizons, K, m).
        below = self._find_part_probabilities(np.clip(values, low, high))
        below_low = self._find_part_probabilities(low)
        below_high = self._find_part_probabilities(high)
        inside = below_high - below_low
        conditional = np.where(inside > 0, (below - below_low) / np.where(inside > 0, inside, 1.0), below)
        # No probability is beyond the limits, even if a part is almost certainly there.
        is_at_low = (values <= low)[..., None, :]
        is_beyond_high = (values > high)[..., None, :]
        conditional = np.where(is_at_low, 0.0, np.where(is_beyond_high, 1.0, conditional))
        total: np.ndarray = np.sum(self.weights * conditional, axis=-2)
        return total

    def _find_part_probabilities(self, values: np.ndarray) -> np.ndarray:
        """Return P(x_k < value) (horizons, K, m) for each Gaussian x_k of the mixture, without regard to limits.

        `values` are (m,) or (horizons, m). A Gaussian of variance 0 is its mean, which counts half if it equals the
        value.
        """
        distance = values[..., None, :] - self.part_means
        deviation = np.sqrt(self.part_variances)
        without_variance = np.where(distance > 0, np.inf, np.where(distance < 0, -np.inf, 0.0))
        with np.errstate(invalid="ignore"):
            in_deviations = distance / np.where(deviation > 0, deviation, 1.0)
            in_deviations = np.where(deviation > 0, in_deviations, without_variance)
        beyond_all = np.isinf(values)[..., None, :]  # also beyond parts whose variance is infinite
        probabilities: np.ndarray = ndtr(np.where(beyond_all, values[..., None, :], in_deviations))
        return probabilities


@readable
@dataclass(frozen=True)
class Forecast:
    """What one filter says of the future, given what has arrived so far.

    Args:
        steps: how far each horizon is: in steps, or in the unit of time where the plant has an input dt.
        time: of each horizon (horizons,), on the clock of the data: numbers or dates; of several sources
            (sources, horizons), as are all arrays of the predictions.
        states: the states.
        outputs: what the sensor would measure; None of a filter that does not say which sensor it is for.
        received: what would arrive of it through the channel, if anything arrives; None of a filter that uses no
            measurements, or for which not to receive one is a measurement.
        inputs: whether inputs were "given" or "held" at those of the last step; "none" of a plant without.
    """

    steps: np.ndarray
    time: np.ndarray
    states: Prediction
    outputs: Prediction | None
    received: Prediction | None
    inputs: InputsAhead

    def select(self, rows: ArrayLike) -> "Forecast":
        """Return the forecast at some of its horizons.

        Args:
            rows: flags (horizons,), True for the horizons to keep.

        Raises:
            ValueError: another number of flags.
        """
        mask = np.asarray(rows)
        if mask.shape != self.steps.shape or mask.dtype.kind != "b":
            raise fail("rows", f"{len(self.steps)} of true and false", f"shape {mask.shape} of {mask.dtype}")
        selected = self._map_arrays(lambda array, behind: np.compress(mask, array, axis=array.ndim - 1 - behind))
        return replace(selected, steps=self.steps[mask])

    def of_source(self, number: int) -> "Forecast":
        """Return the forecast of one of several sources.

        Args:
            number: its place in the list, from 0.

        Raises:
            ValueError: the forecast of a single source, no such place.
        """
        if self.time.ndim == 1:
            raise fail("source", "the forecast of a list of sources", "that of a single one")
        if not is_whole(number) or not 0 <= number < len(self.time):
            raise fail("source", f"a number from 0 to {len(self.time) - 1}", show_value(number))
        return self._map_arrays(lambda array, _: array[number])

    def _map_arrays(self, change: Callable[[np.ndarray, int], np.ndarray]) -> "Forecast":
        """Return the forecast with each of its arrays replaced by what `change` makes of it.

        `change`: function of an array and of its number of axes after the axis of horizons.
        """
        states, outputs, received = (
            prediction and prediction.map_arrays(change) for prediction in (self.states, self.outputs, self.received)
        )
        assert states is not None
        return replace(self, time=change(self.time, 0), states=states, outputs=outputs, received=received)

    def named(self, name: str) -> tuple[Prediction, int]:
        """Return the prediction that has a number of this name, looking at states first, and the number's place in it.

        Raises:
            ValueError: no state, output or received number of this name.
        """
        predictions = list(filter(None, (self.states, self.outputs, self.received)))
        for prediction in predictions:
            if name in prediction.names:
                return prediction, prediction.names.index(name)
        known = dict.fromkeys(known_name for prediction in predictions for known_name in prediction.names)
        raise fail("name", f"one of {', '.join(known)}", repr(name))
