"""Designs of relay networks: gains, exact error covariances, power, and the filters as schedules."""

from collections.abc import Mapping

import jax
import numpy as np

from heliograph.linear.system import Gains, Schedule
from heliograph.model.assumed.assumed_model import AssumedModel, with_assumed
from heliograph.model.estimate import lower_claim_by_noise
from heliograph.model.relays import RECEIVER, RelayNetwork, RelaySteps
from heliograph.numerics.check import array, fail, instance, table
from heliograph.numerics.float64 import compile_in_float64
from heliograph.numerics.module import Module, readable
from heliograph.numerics.types import Array, ArrayLike, Float
from heliograph.relays.error_moments import (
    PropagatedMoments,
    initial_error_moments,
    propagate_error_moments,
    step_moments,
)

GainsByFilter = Mapping[str, ArrayLike]  # by name, each (steps, n, received)


@readable
class RelayDesign(Module):
    """Gains of every filter for each step, computed before any data, with exact error covariances and power.

    For a periodic design `steps` is the period and entry 0 equals the last.

    Args:
        gains: filter gains by name (steps, n, received), zero where the filter receives nothing.
        covariance: E (x - s)(x - s)' by filter at k = 0 .. steps, exact (steps + 1, n, n).
        power: mean square E |C s|^2 of what each relay sends, zero where nobody listens (steps,).
        moments: covariance of (x, e_1 .. e_F), the receiver's error last (steps + 1, d, d).
    """

    gains: dict[str, Float[np.ndarray, "steps n _"]]
    covariance: dict[str, Float[np.ndarray, "steps+1 n n"]]
    power: dict[str, Float[np.ndarray, "steps"]]
    moments: Float[np.ndarray, "steps+1 d d"]

    def trace(self, name: str) -> Float[np.ndarray, "time"]:
        """Return the trace of one filter's error covariance at k = 0 .. steps."""
        return np.asarray(np.trace(self.covariance[name], axis1=1, axis2=2))

    def total_power(self) -> Float[np.ndarray, "steps"]:
        """Return the power that the relays send together at each step."""
        return np.asarray(np.sum([np.zeros(len(self.moments) - 1), *self.power.values()], axis=0))


def given_design(network: RelayNetwork, gains: GainsByFilter) -> RelayDesign:
    """Compute error covariances and power of a `network` under any gains, {filter: (steps, n, received)}.

    Args:
        network: relays that filter.
        gains: K by filter, (steps, n, received): by n states and the numbers that the filter receives.

    Raises:
        ValueError: a filter without gains or the reverse, gains of the wrong shape, a horizon that is not covered.
    """
    instance("relay network", network, RelayNetwork, "a RelayNetwork")
    gains = table("gains", gains, "arrays (steps, n, received)")
    joined = join_gains(network, gains)
    steps = network.steps(len(joined))
    return make_design(network, _propagate(steps, initial_error_covariance(network), joined))


_propagate = compile_in_float64(propagate_error_moments)


def initial_error_covariance(network: RelayNetwork) -> Float[np.ndarray, "d d"]:
    """Return the covariance of (x_0, e_1 .. e_F), where each of the F filters starts at E x_0: e_f = x_0 - E x_0."""
    return initial_error_moments(network.initial()[1], len(network.filters))


def join_gains(network: RelayNetwork, gains: GainsByFilter) -> Float[np.ndarray, "steps Fn R"]:
    """Return the gains by filter as one block matrix for each step.

    Rows are by filter and state. Columns are the R received numbers, by filter. All else is 0.
    """
    if set(table("gains", gains, "arrays")) != set(network.filters):
        raise fail("gains", f"those of {list(network.filters)}", list(gains))
    n, first = len(network.states), network.filters[0]
    length = len(array(f"gains of {first!r}", gains[first], (None, None, None)))
    joined = np.zeros((length, len(network.filters) * n, sum(network.received)))
    start = 0  # column of the filter's first received number
    for f, (name, size) in enumerate(zip(network.filters, network.received, strict=True)):
        rows, columns = slice(f * n, (f + 1) * n), slice(start, start + size)
        joined[:, rows, columns] = array(f"gains of {name!r}", gains[name], (length, n, size))
        start += size
    return joined


def split_gains(
    network: RelayNetwork, joined: Float[np.ndarray, "steps Fn R"]
) -> dict[str, Float[np.ndarray, "steps n _"]]:
    """Return the gains (steps, n, received) of each filter from block matrices: the inverse of `join_gains`.

    Rows of a block matrix are by filter and state, columns are the R received numbers, by filter.
    """
    n, ends = len(network.states), np.cumsum(network.received)
    return {
        name: np.asarray(joined)[:, f * n : (f + 1) * n, end - size : end]
        for f, (name, size, end) in enumerate(zip(network.filters, network.received, ends, strict=True))
    }


def make_design(network: RelayNetwork, propagated: PropagatedMoments) -> RelayDesign:
    """Return the design of a network from its gains, moments and powers over time, taken apart by filter.

    Raises:
        ValueError: moments that are not finite.
    """
    moments, n = np.asarray(propagated.moments), len(network.states)
    if not np.all(np.isfinite(moments)):
        step = int(np.argmax(~np.isfinite(moments).all(axis=(1, 2))))
        raise fail("design", "finite second moments", f"some that are not after step {step} (is a link noiseless?)")
    # The moments are of (x, e_1 .. e_F), e_f the error of filter f. Power is by sender: the sensor, then the relays.
    blocks = {name: slice((1 + f) * n, (2 + f) * n) for f, name in enumerate(network.filters)}
    return RelayDesign(
        gains=split_gains(network, np.asarray(propagated.gains)),
        covariance={name: moments[:, rows, rows] for name, rows in blocks.items()},
        power={name: np.asarray(propagated.power)[:, 1 + r] for r, name in enumerate(network.relays)},
        moments=moments,
    )


def relay_schedules(network: RelayNetwork, design: RelayDesign) -> dict[str, Schedule]:
    """Return every filter of a design as a schedule of gains, by name, to save, to simulate or to run.

    A filter's estimate s moves by s+ = A s + a + K (z - B s - b) with its gain K. z is what it receives, and B s + b
    the mean of z if s were the estimate of every relay. Claim: "exact" for complete data from the network it was
    designed for, "upper" where noise is known by bounds.

    Args:
        network: relays that filter what they receive.
        design: of this network, from its start on: of a periodic one take `given_design` with its gains repeated.

    Raises:
        ValueError: a design of another network, a periodic one.
    """
    instance("relay network", network, RelayNetwork, "a RelayNetwork")
    instance("design", design, RelayDesign, "a RelayDesign")
    if set(design.gains) != set(network.filters):
        raise fail("design", f"filters {list(network.filters)}", list(design.gains))
    _check_start(network, design)
    steps = network.steps(len(design.moments) - 1)
    # Covariances of (x, e_1 .. e_F, innovations) at each step, with the errors before their correction. The first d
    # entries are (x, e_1 .. e_F), and the innovations stand filter after filter.
    predicted = np.asarray(_predict_covariances(steps, design.moments[:-1]))
    d = design.moments.shape[-1]
    n, ends = len(network.states), np.cumsum(network.received)
    start_mean, _start_covariance = network.initial()
    schedules = {}
    for f, (name, size) in enumerate(zip(network.filters, network.received, strict=True)):
        received = slice(ends[f] - size, ends[f])  # the filter's own, of all received numbers
        error = slice((1 + f) * n, (2 + f) * n)  # its error e_f, after x and the filters before it
        gains = _make_gains(
            steps,
            design.gains[name],
            received,
            covariance=design.covariance[name][1:],
            predicted=predicted[:, error, error],
            innovation=predicted[:, d:, d:][:, received, received],
        )
        schedules[name] = Schedule(gains, start_mean, lower_claim_by_noise("exact", network))
    relayed = {name: schedules[name].gains.gain for name in network.relays}
    assumed = AssumedModel(network.plant, relays=network, gains=relayed)
    return {name: with_assumed(schedule, assumed) for name, schedule in schedules.items()}


def _make_gains(
    steps: RelaySteps,
    gain: Float[np.ndarray, "steps n received"],
    received: slice,
    covariance: Float[np.ndarray, "steps n n"],
    predicted: Float[np.ndarray, "steps n n"],
    innovation: Float[np.ndarray, "steps received received"],
) -> Gains:
    """Return s+ = (A - K B) s + K z + a - K b of one filter as gains over time; its estimate is its state s.

    Args:
        steps: the network's, with A, a and B, b: all filters' received numbers are predicted from s as B s + b.
        gain: K of the filter at each step.
        received: which of the numbers that all filters receive are this filter's z.
        covariance: covariance of its error after each step.
        predicted: covariance of its error before each correction.
        innovation: covariance of its innovation z - (B s + b).
    """
    rows, constants = steps.predict_maps()
    b_matrix, b = rows[:, received], constants[:, received]  # B and b of this filter's z
    used_gain = gain * np.asarray(steps.receives_in_slot)[:, None, received]  # zero on what nobody transmits
    transition = steps.transition - used_gain @ b_matrix
    offset = steps.drift - np.einsum("kir,kr->ki", used_gain, b)
    return Gains(
        transition=transition,
        gain=used_gain,
        offset=offset,
        output=transition,
        direct=used_gain,
        output_offset=offset,
        expected=b_matrix,
        expected_offset=b,
        covariance=covariance,
        predicted=predicted,
        innovation=innovation,
    )


def _check_start(network: RelayNetwork, design: RelayDesign) -> None:
    """Raise ValueError if the design's moments at k = 0 are not those of the network's start.

    A filter that runs from the start cannot use the gains of another start. A periodic design fails this check: it has
    one step for each slot, and ends with the moments with which it begins; the message then says so.
    """
    # The start is compared to rounding. A periodic design was found by iteration, so its ends agree less closely.
    expected, start = initial_error_covariance(network), design.moments[0]
    if start.shape != expected.shape or not np.allclose(start, expected, rtol=1e-9, atol=0.0):
        ends_as_it_begins = np.allclose(start, design.moments[-1], rtol=1e-6)
        is_periodic = len(design.moments) == len(network.slots) + 1 and ends_as_it_begins
        got = "a periodic one (use given_design with its gains repeated)" if is_periodic else "one from another start"
        raise fail("design", "one from the network's start on", got)


@compile_in_float64
def _predict_covariances(steps: RelaySteps, moments: Float[Array, "time d d"]) -> Float[Array, "time z z"]:
    """Return at each step the covariance of (x, e_1 .. e_F before corrections, the R innovations), of size z = d + R.

    x is the state and e_f the error of filter f. `moments` are the covariances (d, d) of (x, e_1 .. e_F) before each of
    the network's `steps`.
    """
    return jax.vmap(lambda step, covariance: step_moments(step, covariance)[0])(steps, moments)


def make_receiver_cost(weights: Float[np.ndarray, "steps"], filters: int, n: int) -> Float[np.ndarray, "steps d d"]:
    """Return the matrices C_k of the cost, <C_k, moments_k> = weight_k tr P_k, P_k the receiver's error covariance.

    <A, B> is the sum of A_ij B_ij. The moments are of (x, e_1 .. e_F) with F = `filters`, each of n entries; the
    receiver's error is last. `weights` are weight_k of each step.
    """
    d = (1 + filters) * n
    matrices = np.zeros((len(weights), d, d))
    matrices[:, d - n :, d - n :] = np.asarray(weights)[:, None, None] * np.eye(n)
    return matrices


def local_error_design(network: RelayNetwork, horizon: int) -> RelayDesign:
    """Design gains with which each filter minimises the trace of its own next error covariance, in one forward pass.

    K_f = E[e_f i_f'] E[i_f i_f']^-1, with the error e_f of filter f and its innovation i_f. It is optimal for one step
    only: a relay's gain also decides what the receiver can know later (see `receiver_error_design`).

    Args:
        network: relays that filter.
        horizon: number of steps.

    Raises:
        ValueError: a horizon beyond what varies over time; a singular innovation moment.
    Source: filter-and-forward successive relays (IEEE/CAA JAS 11(5), 2024), Theorems 1 and 2, for any network.
    """
    instance("relay network", network, RelayNetwork, "a RelayNetwork")
    return make_design(network, _propagate(network.steps(horizon), initial_error_covariance(network)))


def relay_gains(network: RelayNetwork, gains: GainsByFilter) -> Float[np.ndarray, "steps Fn R"]:
    """Return the relays' gains as one block matrix for each step, with zeros for the receiver's gain.

    Rows are by filter and state, columns are the R received numbers, by filter; the receiver's come last.

    Raises:
        ValueError: a network without relays, a relay without gains, gains of another shape.
    """
    gains = table("relay gains", gains, "arrays")
    missing = [name for name in network.relays if name not in gains]
    if missing or not network.relays:
        raise fail("relay gains", f"those of {list(network.relays)}", f"none for {missing}" if missing else "no relays")
    relays = {name: gains[name] for name in network.relays}
    n, first = len(network.states), network.relays[0]
    length = len(array(f"gains of {first!r}", relays[first], (None, None, None)))
    return join_gains(network, relays | {RECEIVER: np.zeros((length, n, network.received[-1]))})
