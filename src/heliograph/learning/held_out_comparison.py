"""Comparison on rows that were not learned from: networks before and after learning, and laws by likelihood."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
import scipy
from scipy.special import ndtr

from heliograph.filters.base import AbstractFilter
from heliograph.learning.likelihood.predictive_density import Predictive, predictive
from heliograph.learning.long_run_covariance import estimate_mean_and_error
from heliograph.model.over_time import OverTime, first
from heliograph.numerics.check import InputError, fail, instance
from heliograph.numerics.module import readable
from heliograph.numerics.types import Float
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node
from heliograph.simulation.results.whiteness import MemoryTest, score_innovations

LAGS = 10  # of the test for memory, with ten rows for each at least


@readable
@dataclass(frozen=True)
class PredictedRows:
    """Predictions of some rows by one filter: log-likelihoods, white innovations and the test of their memory.

    White innovations are divided by their claimed deviations and made uncorrelated within a row: all are of variance 1
    and independent where the filter is right.

    Shapes: log_likelihood (rows,), white (rows, received); the test is None for too few rows.
    """

    log_likelihood: Float[np.ndarray, " rows"]
    white: Float[np.ndarray, "rows received"]
    test: MemoryTest | None


@readable
class Comparison(NamedTuple):
    """Test of whether a recording speaks for the first of two laws, a and b, or for the second.

    Args:
        difference: mean of log p_a - log p_b per step, in nats.
        standard_error: its standard error, which allows for correlation over time.
        z: difference over standard error.
        p_value: two-sided p-value of z.
    """

    difference: float
    standard_error: float
    z: float
    p_value: float

    @property
    def decided(self) -> bool:
        """True if the data speak for one law at 5 %, the first where the difference is positive."""
        return self.p_value < 0.05


@readable
@dataclass(frozen=True)
class PredictionBeforeAndAfter:
    """Filter on the held-out rows, with the numbers that the network began with and with those learned.

    Args:
        node: node of the filter.
        filter: its name.
        before: its predictions with the numbers before learning.
        after: its predictions with those learned.
        gain: mean gain of log-likelihood per row, with its test; None where fewer than 10 rows arrived.
    """

    node: str
    filter: str
    before: PredictedRows
    after: PredictedRows
    gain: Comparison | None


@readable
@dataclass(frozen=True)
class HeldOutTransforms:
    """Probability integral transforms of one node's held-out rows: uniform on (0, 1) if the learned network is right.

    Args:
        node: the node.
        pit: P(z < what came | earlier rows) of each number (rows, received), NaN where none came.
        by_law: whether laws of gains count in full, or as the filter's Gaussians.
    """

    node: str
    pit: Float[np.ndarray, "rows received"]
    by_law: bool


def compare_before_and_after(
    before: Network, after: Network, measurements: dict[str, np.ndarray], inputs: np.ndarray, cut: int
) -> list[PredictionBeforeAndAfter]:
    """Return how each filter that claims a covariance predicts the rows from `cut` on, before and after learning.

    Args:
        before: the network before learning.
        after: the same with the numbers learned.
        measurements: measurements by node (rows, received); the filters run over all rows.
        inputs: inputs of the plant (rows, inputs).
        cut: number of the first row that was not learned from.
    """
    results = []
    for name, z in measurements.items():
        for key, old_filter in before.nodes[name].filters.items():
            if old_filter.claim == "none" or not old_filter.received:
                continue
            # Of both filters the log-likelihood (rows,) and the whitened innovations `white` (rows, received).
            old = _predict_rows(old_filter, z, inputs, cut)
            new = _predict_rows(after.nodes[name].filters[key], z, inputs, cut)
            received = ~np.all(np.isnan(old.white), axis=1)  # rows in which anything arrived
            # Mean gain of log-likelihood in these rows, with its standard error; None with fewer than LAGS (10) rows.
            gain = None
            if received.sum() >= LAGS:
                gain = test_zero_mean((new.log_likelihood - old.log_likelihood)[received])
            results.append(PredictionBeforeAndAfter(node=name, filter=key, before=old, after=new, gain=gain))
    return results


def transform_held_out(
    network: Network,
    outcome: list[PredictionBeforeAndAfter],
    measurements: dict[str, np.ndarray],
    inputs: np.ndarray,
    cut: int,
) -> list[HeldOutTransforms]:
    """Return the probability integral transforms of each node's rows from `cut` on, P(z < what came | earlier rows).

    They are uniform on (0, 1) if the network is right. They come from the laws of its gains and noise where known, else
    from the Gaussian predictions of its first filter.

    Args:
        network: the network with the numbers learned.
        outcome: predictions of the rows from `cut` on, by node and filter, before and after learning, with the whitened
            innovations of these rows.
        measurements: measurements by node (rows, received).
        inputs: inputs of the plant (rows, inputs).
        cut: number of the first row that was not learned from.
    """
    uniform = []
    for name, z in measurements.items():
        node = network.nodes[name]
        predicted_of_node = [prediction for prediction in outcome if prediction.node == name]
        by_law = _transform_by_laws(network, node, z, inputs) if isinstance(node, Node) else None
        if by_law is not None:
            uniform.append(HeldOutTransforms(name, by_law[cut:], by_law=True))
        elif predicted_of_node:
            white = predicted_of_node[0].after.white  # innovations in deviations, normal if the filter is right
            uniform.append(HeldOutTransforms(name, np.asarray(ndtr(white)), by_law=False))
    return uniform


def _transform_by_laws(network: Network, node: Node, z: np.ndarray, inputs: np.ndarray) -> np.ndarray | None:
    """Return P(z_k <= what came | earlier rows) of each measurement (rows, received), by laws of gain and noise.

    The result is None if these laws of the node vary over time, remember, or have no nodes to sum over.

    Args:
        network: the network, for its plant.
        node: the node, for its sensor and channel.
        z: measurements (rows, received), NaN where nothing arrived.
        inputs: inputs of the plant (rows, inputs).
    """
    models = (network.plant, node.sensor, node.channel)
    if any(isinstance(model, OverTime) for model in models) or first(node.channel).remembers:
        return None
    try:
        return predictive(network.plant, node.sensor, first(node.channel), z, inputs).pit
    except InputError:  # laws without nodes, or too many of them
        return None


def _predict_rows(filter: AbstractFilter, z: np.ndarray, u: np.ndarray, cut: int) -> PredictedRows:
    """Return a filter's predictions of the rows from `cut` on, from measurements z and inputs u of all rows.

    They are each row's log density, its innovation divided by the predicted deviation, which is white noise if the
    filter is right, and a test of these for correlation over at most LAGS rows. The test is None if there are too few
    rows. LAGS is 10; `score_innovations` returns both of all rows.
    """
    log_density, whitened = (np.asarray(values)[cut:] for values in score_innovations(filter, z, u))
    lags = min(LAGS, len(whitened) // 10)
    has_enough = lags > 0 and np.count_nonzero(~np.isnan(whitened)) > LAGS
    test = MemoryTest.of(whitened, lags, claimed=True) if has_enough else None
    return PredictedRows(log_density, whitened, test)


def compare_laws(a: Predictive, b: Predictive) -> Comparison:
    """Test whether two laws predict one recording equally well, by the mean difference of their log-likelihoods.

    Steps where nothing arrived do not count.

    Args:
        a: densities of the recording under the first law, from `predictive`.
        b: densities of the same recording under the second.

    Raises:
        ValueError: different recordings, or fewer than 10 steps with a measurement.
    Source: Vuong (1989); Newey and West (1987) for the standard error.
    """
    for name, law in (("first law", a), ("second law", b)):
        instance(name, law, Predictive, "what `predictive` gives")
    # `pit` is NaN where nothing arrived, which must be at the same places if the recording is the same.
    if a.pit.shape != b.pit.shape or np.any(np.isnan(a.pit) != np.isnan(b.pit)):
        raise fail("second law", "the same recording as the first", "another")
    received = ~np.all(np.isnan(a.pit), axis=1)
    if received.sum() < 10:
        raise fail("recording", "at least 10 steps with a measurement", int(received.sum()))
    return test_zero_mean((a.log_likelihood - b.log_likelihood)[received])


def test_zero_mean(differences: Float[np.ndarray, " steps"]) -> Comparison:
    """Return a test of whether the mean of differences (steps,), which may be correlated over time, is zero."""
    mean, error = estimate_mean_and_error(differences)
    z = mean / error if error > 0 else 0.0
    p_value = float(2 * scipy.stats.norm.sf(abs(z)))
    return Comparison(difference=mean, standard_error=error, z=float(z), p_value=p_value)
