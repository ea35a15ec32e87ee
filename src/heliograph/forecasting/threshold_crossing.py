"""When a level is passed: at each horizon, at any time before it, and for the first time."""

from dataclasses import dataclass

import numpy as np

from heliograph.forecasting.horizons import Horizons, Inputs
from heliograph.forecasting.sample_paths import DRAWS, draw_paths
from heliograph.model.forecast_origin import HasOrigin
from heliograph.numerics.check import scalar
from heliograph.numerics.module import readable


@readable
@dataclass(frozen=True)
class Crossing:
    """Probabilities that a number is beyond a level, from drawn paths; errors are standard errors of the drawing.

    Args:
        name: of the state or output.
        level: c.
        above: whether beyond is above c; below it otherwise.
        steps: how far each time is: in steps, or in the unit of time where the plant has an input dt.
        time: of each, on the clock of the data.
        beyond: probability that it is beyond at this time (times,).
        beyond_error: its standard error (times,).
        by: probability that it has been beyond at this or any earlier of the times (times,).
        by_error: its standard error (times,).
        draws: number of paths.
    """

    name: str
    level: float
    above: bool
    steps: np.ndarray
    time: np.ndarray
    beyond: np.ndarray
    beyond_error: np.ndarray
    by: np.ndarray
    by_error: np.ndarray
    draws: int

    @property
    def first(self) -> np.ndarray:
        """Probability that each time is the first at which it is beyond (times,); with `never` they sum to 1."""
        return np.diff(self.by, prepend=0.0)

    @property
    def never(self) -> float:
        """Probability that it is not beyond up to the last time."""
        return float(1 - self.by[-1])

    def quantile(self, level: float) -> float:
        """Return the first time by which the number has been beyond the level with this probability, or infinity.

        The time is how far ahead it is, in the unit of `self.steps`. Infinity means that no time reaches the
        probability.

        Raises:
            ValueError: a level that is no probability between 0 and 1.
        """
        p = float(scalar("level of a quantile", level, 0, 1))
        # self.by: the probability to have been beyond by each of the times self.steps.
        reaching_steps = self.steps[self.by >= p]
        return float(reaching_steps[0]) if len(reaching_steps) else float("inf")


def crossing(
    source: HasOrigin,
    name: str,
    level: float,
    horizons: Horizons,
    above: bool = True,
    inputs: Inputs = None,
    draws: int = DRAWS,
    seed: int = 0,
    node: str | None = None,
    filter: str | None = None,
) -> Crossing:
    """Find the probabilities that a state or output passes a level, and the law of the first time that it does.

    By paths drawn from the last estimate; "any time" is any of the times up to the last horizon: between them nobody
    looks, so where time is continuous the list of times decides.

    Args:
        source: what one can forecast from, as `hg.forecast` takes it.
        name: of a state, or of an output of the filter's sensor, with its noise.
        level: what is passed.
        horizons: a number of steps, or a list of times, as of `hg.forecast`.
        above: whether beyond is above the level (default) or below it.
        inputs: what the plant will get, as of `hg.forecast`; none by default.
        draws: number of paths; 10,000 by default.
        seed: of the random numbers; 0 by default.
        node: whose filter; by default the only one.
        filter: name of the filter; by default the only one.

    Raises:
        ValueError: what `draw_paths` refuses, a name that is no state or output, a level that is no number.

    Source: simulation of the state space model from its filtered law; probabilities are shares of the paths, with
        standard errors sqrt(p (1 - p) / draws).
    """
    limit = float(scalar("level", level))
    paths = draw_paths(source, horizons, inputs, draws, seed, node, filter)
    # Shares of the paths that are beyond at each time, and that have been beyond at this or an earlier one.
    is_beyond = paths.is_beyond(name, limit, above)
    has_been_beyond = np.logical_or.accumulate(is_beyond, axis=1)
    beyond, by = is_beyond.mean(axis=0), has_been_beyond.mean(axis=0)
    beyond_error, by_error = (np.sqrt(p * (1 - p) / draws) for p in (beyond, by))
    return Crossing(
        name=name,
        level=limit,
        above=above,
        steps=paths.steps,
        time=paths.time,
        beyond=beyond,
        beyond_error=beyond_error,
        by=by,
        by_error=by_error,
        draws=draws,
    )
