"""One simulated run of a network: a truth, what its nodes receive, and what every filter makes of it."""

import jax

from heliograph.numerics.types import ArrayLike, Float
from heliograph.simulation.network import Network
from heliograph.simulation.results.record import Record
from heliograph.simulation.simulate import monte_carlo
from heliograph.smoothing.modes import AbstractSmoothing


def simulate(
    network: Network,
    horizon: int,
    key: int | jax.Array,
    inputs: Float[ArrayLike, "horizon inputs"] | None = None,
    smooth: AbstractSmoothing | None = None,
) -> Record:
    """Simulate one run of the network and every filter on it: the first run of `monte_carlo` with the same key.

    Args:
        network: the network.
        horizon: number of steps.
        key: a seed or a JAX key.
        inputs: (horizon, inputs); by default a plant without inputs is assumed.
        smooth: smoothing as in `monte_carlo`; None by default.

    Returns:
        The record, without an axis of runs: `truth` (time, n), `measurements` by node, `estimates` by node and filter.

    Raises:
        ValueError: what `monte_carlo` refuses.
    """
    return monte_carlo(network, horizon, 1, key, inputs=inputs, smooth=smooth).of_run(0)
