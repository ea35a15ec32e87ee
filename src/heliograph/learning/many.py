"""Many recordings of one network, each fitted by itself, side by side: how good estimates and intervals would be."""

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import numpy as np

from heliograph.learning.description import describe
from heliograph.learning.free_marks import Build
from heliograph.learning.intervals import Method, long_run, quantile, sandwich
from heliograph.learning.maximise import Evaluated, maximise
from heliograph.learning.objective import Form, Found, Objective, objectives, one_recording
from heliograph.learning.parameters import Parameters
from heliograph.learning.surface import DIFFERENCE
from heliograph.learning.transforms import unlink
from heliograph.numerics.check import array, fail, shown
from heliograph.numerics.compiler import quickly_compiled
from heliograph.numerics.float64 import to_numpy
from heliograph.numerics.readable import readable
from heliograph.numerics.types import Array, ArrayLike, Bool, Float

SEEN = 0.05  # information of a coordinate below which the number has run to a limit


@readable
@dataclass(frozen=True)
class FitEach:
    """Estimates from each of many recordings, on the line on which steps are taken.

    Of each: x; the Hessian of the negative log-likelihood; the scores of each step; whether the climb converged to a
    point at which no number has run to a limit (`inside`).

    Shapes: x (runs, p), hessian (runs, p, p), scores (runs, steps, p), inside (runs,).
    """

    parameters: Parameters
    x: Float[np.ndarray, "runs p"]
    hessian: Float[np.ndarray, "runs p p"]
    scores: Float[np.ndarray, "runs steps p"]
    inside: Bool[np.ndarray, " runs"]

    @property
    def estimates(self) -> Float[np.ndarray, "runs p"]:
        """The numbers themselves."""
        return self._back(self.x)

    def intervals(self, method: Method) -> tuple[Float[np.ndarray, "runs p"], Float[np.ndarray, "runs p"]]:
        """Lower and upper ends of 95 % intervals, as `Fit.rows` makes them; NaN where a number has run to a limit."""
        reach = np.full(self.x.shape, np.nan)
        for i in np.flatnonzero(self.inside):
            found = long_run(method, [self.scores[i]], self.hessian[i])
            spread = np.diag(sandwich(self.hessian[i], found.covariance))
            reach[i] = quantile(found.freedom) * np.sqrt(np.maximum(spread, 0.0))
        return self._back(self.x - reach), self._back(self.x + reach)

    def _back(self, x: np.ndarray) -> np.ndarray:
        columns = [unlink(e.domain, x[:, i]) for i, e in enumerate(self.parameters.entries)]
        return np.stack(columns, axis=1)


def fit_each(
    network: Build, measurements: ArrayLike, inputs: ArrayLike | None = None, form: Form | None = None
) -> FitEach:
    """Fit each of many recordings of one length by itself, from the network's start, in one compiled program.

    For studies: what `fit` finds of each, without its other starts and sentences, for free numbers that are single.

    Shapes: measurements (runs, steps, received) of all nodes in their order, inputs (steps, inputs) common to all.

    Raises:
        ValueError: as `fit`; a form that the network has not, free numbers that are no single ones.
    """
    description = describe(network)
    parameters = description.parameters
    if any(one.start.ndim for one in parameters.every):
        raise fail("free numbers", "single ones", [one.name for one in parameters.every if one.start.ndim])
    known: Sequence[Objective] = objectives(description)
    chosen = [one for one in known if form in (None, one.form)]
    if not chosen:
        raise fail("form", f"one of {', '.join(one.form for one in known)}", shown(form))
    z = array("measurements", measurements, (None, None, None), missing=True)
    count = len(description.start.inputs)
    u = np.zeros((z.shape[1], 0)) if inputs is None else array("inputs", inputs, (z.shape[1], count))
    objective = chosen[-1]

    def found(x: np.ndarray) -> Found:
        with jax.enable_x64(True):
            result: Found = to_numpy(_each(objective, x, z, u))
        return result

    def evaluate(x: np.ndarray) -> Evaluated:
        at = found(x)
        return np.asarray(at.density.sum(axis=1)), np.asarray(at.score.sum(axis=1)), np.asarray(at.halves.sum(axis=1))

    best = maximise(evaluate, np.repeat(parameters.start[None], len(z), axis=0))
    top = found(best.x)
    own = np.diagonal(np.asarray(top.halves).sum(axis=1), axis1=1, axis2=2)
    inside = best.converged & np.all(own > SEEN, axis=1)
    hessian = np.asarray(top.halves).sum(axis=1)
    width = DIFFERENCE / np.sqrt(np.maximum(own, SEEN))
    slopes = np.empty(hessian.shape)
    for i in range(best.x.shape[1]):
        shift = np.zeros(best.x.shape)
        shift[:, i] = width[:, i]
        slopes[:, i] = (evaluate(best.x - shift)[1] - evaluate(best.x + shift)[1]) / (2 * width[:, i, None])
    slopes = (slopes + slopes.swapaxes(1, 2)) / 2
    concave = inside & (np.linalg.eigvalsh(np.nan_to_num(slopes))[:, 0] > 0)
    hessian = np.where(concave[:, None, None], slopes, hessian)
    return FitEach(parameters, best.x, hessian, np.asarray(top.score), inside)


@quickly_compiled
def _each(objective: Objective, x: Array, z: Array, u: Array) -> Found:
    found: Found = jax.vmap(lambda point, one: one_recording(objective, point, one, u))(x, z)
    return found
