"""Values that repeat for longer than noise allows: a sensor that is stuck, or one that has no noise."""

from typing import NamedTuple

import numpy as np
from scipy.special import erf

from heliograph.model.over_time import first
from heliograph.model.readings.repeated_readings import delivers_as_sent, longest_run_by_chance
from heliograph.numerics.types import Float
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node

SHORTEST = 3  # readings in a run that is worth a word
SELDOM = 1e-4  # expected number of runs as long, from which a longer one is no chance


class NoiseLaw(NamedTuple):
    """Gaussian branches of one received number's noise.

    Args:
        share: probability of each branch (branches,).
        variance: variance of each (branches,).
        total: variance of the whole.
    """

    share: Float[np.ndarray, " branches"]
    variance: Float[np.ndarray, " branches"]
    total: float


NO_LAW = NoiseLaw(np.ones(1), np.zeros(1), 0.0)  # not known: the claimed variance of innovations is used alone


def list_noise_laws(network: Network, node: str) -> list[NoiseLaw]:
    """Return the noise law of each number that a node receives; NO_LAW where it does not arrive as it was measured.

    A noise law (a mixture of Gaussian branches) says how often equal readings follow each other by chance. NO_LAW has
    the variance 0.

    Args:
        network: the network.
        node: name of the node; or Network.FUSED, the centre, for the numbers of all nodes one after the other.
    """
    if node == Network.FUSED:
        return [law for name in network.names for law in list_noise_laws(network, name)]
    receiver = network.nodes[node]
    unknown = [NO_LAW] * receiver.received
    if not isinstance(receiver, Node):
        return unknown
    # Each received number must be an output of the sensor, passed on unchanged; of a sensor that changes over time the
    # first is taken.
    sensor = first(receiver.sensor)
    outputs = tuple(range(receiver.received))
    if len(sensor.outputs) != receiver.received or not delivers_as_sent(first(receiver.channel), outputs):
        return unknown
    # Probability, mean and variance of each Gaussian branch (outputs, branches).
    try:
        log_share, mean, variance = (np.asarray(part) for part in sensor.noise.branches())
    except ValueError:  # noise that depends on inputs
        return unknown
    share = np.exp(log_share)
    # Variance of the mixture: E[x^2] - (E x)^2.
    total = np.sum(share * (variance + mean**2), axis=1) - np.sum(share * mean, axis=1) ** 2
    return [
        NoiseLaw(share=of_one, variance=variances, total=whole)
        for of_one, variances, whole in zip(share, variance, total.tolist(), strict=True)
    ]


class StuckValue(NamedTuple):
    """The longest run of equal values of one output.

    Args:
        value: the value.
        first_row: row, from 0, of its first reading.
        readings: number of readings in the run.
        received: number of readings of the output in the whole recording.
        stuck: after how many equal readings in a row `stuck=` of a node would refuse one, 1 in 10^9 by chance.
    """

    value: float
    first_row: int
    readings: int
    received: int
    stuck: int

    def __str__(self) -> str:
        """Return one line, such as "400 equal values in a row (3.2) from row 1200"; rows count from 1 here."""
        if self.readings == self.received:
            return f"all {self.readings} values are {self.value:g}"
        return f"{self.readings} equal values in a row ({self.value:g}) from row {self.first_row + 1}"


def find_stuck_value(
    values: Float[np.ndarray, " time"], variance: Float[np.ndarray, " time"], law: NoiseLaw = NO_LAW
) -> StuckValue | None:
    """Return the longest run of equal values, if chance makes one as long less than once in 10,000 recordings.

    With p a bound of the probability that a reading equals the one before it, chance makes a run of n equal values
    somewhere in N readings with probability at most N p^(n - 1). The noise gives one bound
    (`_bound_repetition_probability`). But a link may repeat a value by itself, as one that is off gives 0 each time. So
    p is at least two shares among the readings outside of the run: the share of the run's value, and the share of
    readings that equal the one before. Where all values are equal, nothing is outside of the run, and p = 1/2. SHORTEST
    is 3 readings, SELDOM 1e-4 runs expected. `stuck` of the result: length of run from which a node may refuse the
    value.

    Args:
        values: what was received (time,), NaN where nothing arrived.
        variance: claimed variance of the innovations (time,).
        law: of the noise; Gaussian by default.
    """
    rows = np.flatnonzero(~np.isnan(values) & (variance > 0))
    if len(rows) < SHORTEST:
        return None
    received = values[rows]
    # Runs of equal values: where each begins, and how long it is.
    starts = np.flatnonzero(np.concatenate([[True], received[1:] != received[:-1]]))
    lengths = np.diff(np.concatenate([starts, [len(received)]]))
    longest = int(np.argmax(lengths))
    start, length = int(starts[longest]), int(lengths[longest])
    # p, the probability that a reading equals the one before it.
    are_all_equal = length == len(received)
    if are_all_equal:
        p = 0.5
    else:
        by_noise = _bound_repetition_probability(received, float(np.median(variance[rows])), law)
        p = max(by_noise, *_compute_shares_outside_run(received, start, length))
    if p >= 1:
        return None
    # Logarithm of N p^(n - 1), the expected number of runs as long. A p of 0 has no logarithm: 1e-300 stands for it.
    log_expected = np.log(len(received)) + (length - 1) * np.log(max(p, 1e-300))
    if length < SHORTEST or log_expected > np.log(SELDOM):
        return None
    return StuckValue(
        value=float(received[start]),
        first_row=int(rows[start]),
        readings=length,
        received=len(received),
        stuck=int(longest_run_by_chance(np.array(p))),
    )


def _bound_repetition_probability(readings: Float[np.ndarray, " n"], variance: float, law: NoiseLaw) -> float:
    """Return a bound p of the probability that noise makes a reading equal to the previous one.

    The readings' resolution q is the least difference of two readings. The innovation has variance S, of which q^2 / 12
    may be due to rounding. p = erf(q / sqrt(8 (S - q^2 / 12))) is the probability of the interval q around the most
    probable value. If the noise has several branches j with variances r_j, and r in all, p is the mean over them with
    S - r + r_j in place of S.

    Args:
        readings: the readings, not all equal.
        variance: S, the variance of the innovation.
        law: the shares and variances of the noise's branches.
    """
    resolution = float(np.min(np.diff(np.unique(readings))))
    # S - r + r_j - q^2 / 12 for each branch. If it is not positive, rounding alone explains S, and p is 1.
    unrounded = max(variance - law.total, 0.0) + law.variance - resolution**2 / 12
    with np.errstate(divide="ignore", invalid="ignore"):
        probabilities = np.where(unrounded > 0, erf(resolution / np.sqrt(8 * np.abs(unrounded))), 1.0)
        return float(law.share @ probabilities)


def _compute_shares_outside_run(readings: Float[np.ndarray, " n"], start: int, length: int) -> tuple[float, float]:
    """Return two shares of the readings outside a run: of those with its value, and of those equal to the previous one.

    The run has `length` readings and begins at reading `start`.
    """
    outside = np.ones(len(readings), dtype=bool)
    outside[start : start + length] = False
    # Whether both readings of a pair of successive readings outside the run are equal.
    equal = (readings[1:] == readings[:-1])[outside[1:] & outside[:-1]]
    share_with_value = float(np.mean(readings[outside] == readings[start]))
    share_of_repeats = float(np.mean(equal)) if len(equal) else 0.0
    return share_with_value, share_of_repeats
