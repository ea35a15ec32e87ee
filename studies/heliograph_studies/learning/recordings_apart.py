"""Fits of many recordings of one network, each without the others: how good estimates and intervals would be."""

from collections.abc import Sequence
from dataclasses import dataclass

import jax
import numpy as np

from heliograph.engine.choice import chosen
from heliograph.learning.description import Build, describe
from heliograph.learning.intervals import Method, long_run, quantile, sandwich
from heliograph.learning.likelihood.maximise import Evaluated, maximise
from heliograph.learning.likelihood.objective import Evaluation, Form, Objective, objectives, one_recording
from heliograph.learning.likelihood.surface import DIFFERENCE
from heliograph.learning.likelihood.transforms import unlink
from heliograph.learning.parameters import Parameters
from heliograph.numerics.check import array, fail, shown
from heliograph.numerics.float64 import quickly_compiled, to_numpy
from heliograph.numerics.module import readable
from heliograph.numerics.types import Array, ArrayLike, Bool, Float

SEEN = 0.05  # information of a coordinate below which the number has run to a limit


@readable
@dataclass(frozen=True)
class FitEach:
    """Estimates from each of many recordings, on the line on which steps are taken.

    Args:
        parameters: the free numbers.
        x: estimates on the line (runs, p).
        hessian: Hessian of the negative log-likelihood at each (runs, p, p).
        scores: scores of each step (runs, steps, p).
        inside: true if the climb converged to a point at which no number has run to a limit (runs,).
    """

    parameters: Parameters
    x: Float[np.ndarray, "runs p"]
    hessian: Float[np.ndarray, "runs p p"]
    scores: Float[np.ndarray, "runs steps p"]
    inside: Bool[np.ndarray, " runs"]

    @property
    def estimates(self) -> Float[np.ndarray, "runs p"]:
        """Estimates of the numbers themselves."""
        return self._back(self.x)

    def intervals(self, method: Method) -> tuple[Float[np.ndarray, "runs p"], Float[np.ndarray, "runs p"]]:
        """Ends of 95 % intervals, lower and upper, as `Fit.rows` makes them; NaN where a number has run to a limit."""
        reach = np.full(self.x.shape, np.nan)
        for i in np.flatnonzero(self.inside):
            result = long_run(method, [self.scores[i]], self.hessian[i])
            spread = np.diag(sandwich(self.hessian[i], result.covariance))
            reach[i] = quantile(result.freedom) * np.sqrt(np.maximum(spread, 0.0))
        return self._back(self.x - reach), self._back(self.x + reach)

    def _back(self, x: np.ndarray) -> np.ndarray:
        columns = [unlink(e.domain, x[:, i]) for i, e in enumerate(self.parameters.entries)]
        return np.stack(columns, axis=1)


def fit_each(
    network: Build,
    measurements: "Float[ArrayLike, 'runs steps received']",
    inputs: "Float[ArrayLike, 'steps inputs'] | None" = None,
    form: Form | None = None,
) -> FitEach:
    """Fit each of many recordings of one length by itself, from the network's start, in one compiled program.

    As `fit`, without its other starts and sentences, for free numbers that are single.

    Args:
        network: a function that returns a Network in which numbers are marked by `hg.free`.
        measurements: of all nodes in their order (runs, steps, received), NaN where one did not arrive.
        inputs: inputs of the plant, common to all recordings (steps, inputs); a plant without inputs needs none.
        form: "linear" or "conditional"; the last that the network allows unless given.

    Raises:
        ValueError: as `fit`; a form that the network has not, free numbers that are no single ones.
    """
    description = describe(network)
    parameters = description.parameters
    if any(item.start.ndim for item in parameters.every):
        raise fail("free numbers", "single ones", [item.name for item in parameters.every if item.start.ndim])
    # the form, and the data
    known: Sequence[Objective] = objectives(description)
    fitting = [item for item in known if form in (None, item.form)]
    if not fitting:
        raise fail("form", f"one of {', '.join(item.form for item in known)}", shown(form))
    z = array("measurements", measurements, (None, None, None), missing=True)
    count = len(description.start.inputs)
    u = np.zeros((z.shape[1], 0)) if inputs is None else array("inputs", inputs, (z.shape[1], count))
    objective = fitting[-1]

    def outcome(x: np.ndarray) -> Evaluation:
        with jax.enable_x64(True):
            choice = chosen(one_recording, (objective, x, z, u), [False, True, True, False])
            if choice.code is None:
                return to_numpy(_by_xla(objective, x, z, u))  # type: ignore[no-any-return]
            return choice.results()  # type: ignore[no-any-return]

    def evaluate(x: np.ndarray) -> Evaluated:
        at = outcome(x)
        return np.asarray(at.density.sum(axis=1)), np.asarray(at.score.sum(axis=1)), np.asarray(at.halves.sum(axis=1))

    # climb from the start in every recording
    best = maximise(evaluate, np.repeat(parameters.start[None], len(z), axis=0))
    top = outcome(best.x)
    local = np.diagonal(np.asarray(top.halves).sum(axis=1), axis1=1, axis2=2)
    inside = best.converged & np.all(local > SEEN, axis=1)
    hessian = np.asarray(top.halves).sum(axis=1)
    # Hessian by central differences of the scores; the information where it is not concave
    width = DIFFERENCE / np.sqrt(np.maximum(local, SEEN))
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
def _by_xla(objective: Objective, x: Array, z: Array, u: Array) -> Evaluation:
    evaluation: Evaluation = jax.vmap(lambda point, item: one_recording(objective, point, item, u))(x, z)
    return evaluation
