"""Reducers of simulated runs: sums and collected results, step by step."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from operator import attrgetter
from typing import Any, Generic, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from typing_extensions import TypeVar

from heliograph.model.estimate import Claim, Estimate
from heliograph.model.over_time import first
from heliograph.numerics.check import fail
from heliograph.numerics.module import Module, readable, unwritten
from heliograph.numerics.types import PyTree
from heliograph.simulation.network import Network
from heliograph.simulation.results.record import Record
from heliograph.simulation.results.results_by_name import (
    collect_mode_probabilities,
    collect_weighted_innovations,
    reports_by_name,
    split_by_name,
    split_measurements,
    transmissions_by_name,
    uplinks_by_name,
)

Result = TypeVar("Result", default=Record)  # of the reducer; a record where there is none


@readable
class OfStep(NamedTuple):
    """Results of one step of one run, as a reducer makes them.

    Those of all steps are stacked, but `ever`, which is one for the whole run.

    Args:
        sums: numbers that are summed over runs.
        ever: flags that count in how many runs they were true at some step.
        collected: anything, collected for each run.
    """

    sums: PyTree = ()
    ever: PyTree = ()
    collected: PyTree = ()


@readable
class AbstractReducer(Module, Generic[Result]):
    """Reduction of simulated runs: numbers of each step that are summed over runs, and others that are collected.

    A step is {"truth": (n,), "measurements": (node, received) of each group of nodes, "estimates": of each stack an
    `Estimate` with mean (filter, node, n), "fused": estimates by name, "uplinks"}, as `Network` has groups and stacks.
    """

    def of_step(self, step: PyTree) -> OfStep:
        """Return what remains of one step of one run."""
        raise unwritten(self, "of_step")

    def summed(self, sums: OfStep, common: OfStep, count: np.ndarray) -> PyTree:
        """Return what `finish` needs of the sums over runs; nothing by default.

        Args:
            sums: `sums` and `ever` of `of_step`, summed over the runs of each batch, (time, ..., batch). A number that
                is the same in all runs is not summed: it is that of one run, (time, ...).
            common: for each array of `sums`, whether it is the same in all runs.
            count: number of runs in each batch (batch,).
        """
        return ()

    def finish(self, carry: PyTree, collected: PyTree, network: Network) -> Result:
        """Return the result, from what `summed` returned and what was collected of all runs, (run, time, ...)."""
        raise unwritten(self, "finish")

    def joined(self, results: Sequence[Result], network: Network) -> Result:
        """Join the results of parts of a network, each of some of its nodes with the same plant and runs."""
        raise unwritten(self, "joined")

    def split_by_name(
        self, network: Network, collected: PyTree, read: Callable[[PyTree], Any], axis: int
    ) -> dict[str, dict[str, np.ndarray]]:
        """Return arrays collected from estimates, split by node and filter as `finish` needs them.

        Args:
            network: the network.
            collected: the parts "estimates" and "fused" in the form of a step's outputs.
            read: returns the array of an entry.
            axis: the axis of filters in that array; the axis of nodes follows it.
        """
        return split_by_name(network, collected, read, axis)

    def split_measurements(self, network: Network, groups: Sequence[np.ndarray]) -> dict[str, np.ndarray]:
        """Split measurements of the groups of nodes (..., node, received) by node, for `finish`.

        Args:
            network: the network.
            groups: measurements of each group, as `of_step` had them in a step.
        """
        return split_measurements(network, groups)

    def others(self, filtered: Result, smoothed: Result, claims: Mapping[str, Mapping[str, Claim]]) -> Result:
        """Return the result of the filtered estimates with that of the smoothed ones in its field `smoothed`.

        A reducer that can hold both defines it.

        Args:
            filtered: result of the filtered estimates.
            smoothed: result of the smoothed estimates.
            claims: what the covariances of the smoothed estimates claim, by node and filter.

        Raises:
            ValueError: always here: the reducer has no results for smoothed estimates.
        """
        raise fail("keep", "Statistics() or Trajectories(), to keep smoothed estimates", type(self).__name__)


def reduce_rows(reducer: AbstractReducer[Result], rows: PyTree) -> OfStep:
    """Return what a reducer makes of a run's steps (time, ...), stacked over time; flags `ever` are one for the run."""
    _, items = jax.lax.scan(lambda carry, row: (carry, reducer.of_step(row)), (), rows)
    return items._replace(ever=jax.tree.map(lambda leaf: jnp.any(leaf, axis=0), items.ever))


class Trajectories(AbstractReducer[Record]):
    """Collect all trajectories; memory grows with the number of runs."""

    def of_step(self, step: PyTree) -> OfStep:
        """Collect the whole step."""
        return OfStep(collected=step)

    def finish(self, carry: PyTree, collected: PyTree, network: Network) -> Record:
        """Return the record of what was collected; its time is the step, starting at 1."""
        time = np.arange(1, collected["truth"].shape[1] + 1, dtype=np.float64)
        return trajectories_record(network, collected, time)

    def joined(self, results: Sequence[Record], network: Network) -> Record:
        """Return one record of all nodes, in the network's order, from records of parts of the network.

        The parts have the same plant and runs, so that times and true states are those of the first part.
        """
        measurements = {name: z for record in results for name, z in record.measurements.items()}
        estimates = {name: filters for record in results for name, filters in record.estimates.items()}
        return replace(
            results[0],
            measurements={name: measurements[name] for name in network.names},
            estimates={name: estimates[name] for name in network.names},
        )

    def others(self, filtered: Record, smoothed: Record, claims: Mapping[str, Mapping[str, Claim]]) -> Record:
        """Return the record of filtered estimates, with the record of smoothed estimates as its field `smoothed`.

        `claims`: claims of the smoothed estimates, by node and filter. If only the last steps are smoothed, the
        smoothed record has the times of these.
        """
        estimates = {
            node: {name: replace(estimate, claim=claims[node][name]) for name, estimate in filters.items()}
            for node, filters in smoothed.estimates.items()
        }
        time = filtered.time[-len(smoothed.time) :]
        return replace(filtered, smoothed=replace(smoothed, time=time, estimates=estimates))


def trajectories_record(network: Network, batch: PyTree, time: np.ndarray) -> Record:
    """Return the record of trajectories, with nodes in the network's order.

    A scan returns arrays grouped by stack of filters and node. A user reads them by name: this function sorts them into
    a `Record`, one entry for each node and filter.

    Args:
        network: the simulated network, which has the order and the names of nodes and filters.
        batch: output of the scan over steps, with leading axes (run, time) or (time): "truth" (..., n), "measurements",
            "estimates" with mean (..., filter, node, n) for each stack of filters, "uplinks" and "reports" (what
            arrived at the centre), and more where the network has it.
        time: times of the steps (time,).
    """
    measurements = split_measurements(network, batch["measurements"])
    # The axis of filters is the third from last of means (..., filter, node, n), the fourth of covariances.
    mean = split_by_name(network, batch, attrgetter("mean"), axis=-3)
    covariance = split_by_name(network, batch, attrgetter("covariance"), axis=-4)
    # Probabilities of the modes of links or plant, of filters that estimate them; and rotations among the states.
    modes, attitude = collect_mode_probabilities(network, batch), first(network.plant).manifold.rotations
    # One estimate for each node and filter. The claim says what its covariance is: exact, an upper bound or nominal.
    estimates = {
        node: {
            name: Estimate(mean[node][name], covariance[node][name], claim, modes.get((node, name)), attitude=attitude)
            for name, claim in claims.items()
        }
        for node, claims in network.claims().items()
    }
    # What the centre received from each node.
    uplinks, reports = uplinks_by_name(network, batch["uplinks"]), reports_by_name(network, batch["reports"])
    return Record(
        time=time,
        states=network.states,
        truth=batch["truth"],
        measurements=measurements,
        estimates=estimates,
        uplinks=uplinks,
        reports=reports,
        transmissions=transmissions_by_name(network, batch.get("transmissions", {})),
        weighed=collect_weighted_innovations(network, batch),
    )
