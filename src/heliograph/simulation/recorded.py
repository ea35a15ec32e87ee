"""Every filter of a network over recorded measurements."""

from collections.abc import Mapping

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree
from numpy.typing import ArrayLike

from heliograph.codegen.engine import chosen
from heliograph.numerics.check import check_times, fail, instance, table
from heliograph.numerics.compiler import quickly_compiled
from heliograph.numerics.float64 import to_numpy
from heliograph.numerics.forked import check_process
from heliograph.simulation.given import inputs_of, measurement_of
from heliograph.simulation.network import Network
from heliograph.simulation.record import Record
from heliograph.simulation.smoothed import Smoother, found_record, one_run, smoothed_part
from heliograph.simulation.stepping import AllFilters
from heliograph.simulation.uplinks import Drawn, SentReports
from heliograph.smoothing.modes import AbstractSmoothing


def run(
    network: Network,
    measurements: Mapping[str, ArrayLike],
    inputs: ArrayLike | None = None,
    time: ArrayLike | None = None,
    smooth: AbstractSmoothing | None = None,
    reports: Mapping[str, Mapping[str, SentReports | ArrayLike]] | None = None,
) -> Record:
    """Run every filter of the network over recorded measurements.

    measurements: for each node an array (steps, received), NaN where a component did not arrive; what relays heard may
    be left out, and with it their own filters. inputs: (steps,
    inputs), the input that led to each row. time: (steps,), kept in the record; 0, 1, ... unless given. smooth: as of
    `monte_carlo`.
    reports: of each fusion by `AllReports` and each of its nodes what became of the report that was sent at each step,
    (steps, received), NaN where it never arrived; `SentReports` where delays differ. They may be left out where
    nothing happens to them by chance.

    Raises:
        ValueError: a node without measurements or the reverse, shapes that do not fit, times that go backwards, a
            filter or fusion that cannot be smoothed.
    """
    check_process()
    instance("network", network, Network, "a Network")
    network = network.restricted_to(table("measurements", measurements, "arrays of nodes"))
    steps = len(np.asarray(next(iter(measurements.values()))))
    if steps == 0:
        raise fail("measurements", "at least one row", "none")
    z = {name: measurement_of(name, measurements[name], steps, node.received) for name, node in network.nodes.items()}
    network.check_horizon(steps)
    u = inputs_of(network, inputs, steps)
    clock = np.arange(steps, dtype=np.float64) if time is None else check_times("time", time, steps)
    grouped = tuple(np.stack([z[name] for name in names], axis=1) for names in network.groups)
    part = None if smooth is None else smoothed_part(network, smooth, steps)
    filters = AllFilters(network, part and part.kinds)
    with jax.enable_x64(True):
        given = {} if reports is None else table("reports", reports, "reports by fusion")
        arrivals = {
            name: item.uplinks.recorded(name, item.nodes, given.get(name), steps)
            for name, item in filters.reporting.items()
        }
        arguments = filters, part and part.smoother(filters), grouped, u, arrivals
        choice = chosen(_run_filters, arguments, [False] * len(arguments))
        if choice.code is None:
            found = to_numpy(_by_xla(*arguments))
        else:
            found = jax.tree.map(lambda leaf: leaf[0], choice.results())
    return found_record(network, part, found, clock)


def _run_filters(
    filters: AllFilters, later: Smoother | None, z: tuple[np.ndarray, ...], u: np.ndarray, arrivals: dict[str, Drawn]
) -> PyTree:
    def body(states: PyTree, row: tuple[PyTree, ...]) -> tuple[PyTree, PyTree]:
        k, u_k, z_k, drawn = row
        return filters.step(states, z_k, u_k, k, drawn)

    rows = jnp.arange(len(u)), u, z, arrivals
    found = {"measurements": z, **jax.lax.scan(body, filters.init(), rows)[1]}
    return found if later is None else one_run(later.both, found)


_by_xla = quickly_compiled(_run_filters)
