"""Sums for error statistics, of simulated runs or of stored trajectories."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from operator import itemgetter
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.estimate import Claim, Estimate
from heliograph.numerics.check import fail, instance, show_value
from heliograph.numerics.linalg import squared_distance
from heliograph.numerics.types import Array, PyTree
from heliograph.simulation.centres.uplinks import Uplink
from heliograph.simulation.network import FUSED, Network
from heliograph.simulation.results.error_statistics_by_name import StatisticsByName
from heliograph.simulation.results.record import Record
from heliograph.simulation.results.reducer import AbstractReducer, OfStep, reduce_rows
from heliograph.simulation.results.results_by_name import split_by_name, uplinks_by_name
from heliograph.simulation.results.statistics import BATCHES, ErrorStatistics
from heliograph.simulation.runs.map_over_runs import over_runs


class RunSums(NamedTuple):
    """Sums over runs of all filters' estimates, which lie along one axis `part`; run r goes to batch r mod BATCHES.

    Args:
        runs: their number (batch,).
        pairs: sums of e_i e_j, i <= j (time, part, pair, batch).
        nees: sums of e' B^-1 e, B the claimed covariance (time, part, batch).
        claimed: sums of covariances that differ between runs, the first parts (time, part, pair, batch).
        shared: sums of those that all runs share, the other parts, without batches (time, part, pair).
        failed: in how many runs the mean is not finite (0), and the error has no distance by the covariance, which is
            then not finite or indefinite (1), (time, 2, part).
        failed_runs: in how many runs this happened at some step (2, 1, part).
        uplinks: sums of what the quantizers did.
        order: whose estimates the parts are, by number: stacks first and then fused ones.
        by_run: how many of these, the first ones, have covariances that differ between runs.
    """

    runs: np.ndarray
    pairs: np.ndarray
    nees: np.ndarray
    claimed: np.ndarray
    shared: np.ndarray
    failed: np.ndarray
    failed_runs: np.ndarray
    uplinks: PyTree
    order: tuple[int, ...]
    by_run: int


class Statistics(AbstractReducer[StatisticsByName]):
    """Reduce to error statistics of every filter of every node; memory does not grow with the number of runs."""

    def of_step(self, step: PyTree) -> OfStep:
        """Return the numbers of one step of one run that are summed over runs, and flags of failures.

        They are, for each estimate with error e and the covariance B that the filter states: the products e_i e_j
        (i <= j), the normalised error squared (NEES) e' B^-1 e, B_ij, and whether e or the NEES is no number; and what
        the nodes' quantizers sent. Their means over runs show if B is right. The flags are also returned as `ever`, to
        count the runs in which they are true at some step.

        `step`: the truth, estimates by stack (filters of one structure), and fused ones by name. All lie one
        after another along one axis (`part`). But covariances are a tuple with an array for each stack: if a filter's
        covariance is the same in all runs, it need be held only once, and that may differ between stacks.
        """
        truth = jnp.asarray(step["truth"])
        fused = [step["fused"][name] for name in sorted(step["fused"])]
        estimates = [*step["estimates"], *fused]
        n = len(truth)
        means = [jnp.asarray(estimate.mean).reshape(-1, n) for estimate in estimates]
        claimed = [jnp.asarray(estimate.covariance).reshape(-1, n, n) for estimate in estimates]
        # Errors and their NEES, and where these are invalid.
        errors = [replace(estimate, mean=mean).error(truth) for estimate, mean in zip(estimates, means, strict=True)]
        distances = jax.vmap(squared_distance, in_axes=(0, 0, None))
        nees = [distances(b, e, truth) for b, e in zip(claimed, errors, strict=True)]
        all_errors, all_nees = jnp.concatenate(errors), jnp.concatenate(nees)
        is_finite = jnp.all(jnp.isfinite(all_errors), axis=1)
        failed = jnp.stack([~is_finite, jnp.isnan(all_nees)])
        # Entries i <= j of symmetric matrices.
        rows, columns = np.triu_indices(n)
        sums = {
            "pairs": all_errors[:, rows] * all_errors[:, columns],
            "nees": all_nees,
            "claimed": tuple(b[:, rows, columns] for b in claimed),
            "failed": failed,
            "uplinks": step["uplinks"],
        }
        return OfStep(sums=sums, ever=failed)

    def summed(self, sums: OfStep, common: OfStep, count: np.ndarray) -> RunSums:
        """Return the sums over all runs, with filters whose covariance differs between runs first, the others last.

        Each estimate has one index of the axis `part`, and each entry (i <= j) of a symmetric matrix one of the axis
        `pair`. Filters of one structure (a stack) have consecutive indices. "claimed" is the covariance that a filter
        states; if it is the same in all runs, as with linear filters without losses, one copy is held.

        Args:
            sums: what was summed over runs: "pairs" (time, part, pair, batch), "nees" (time, part, batch), "failed"
                (time, 2, part, batch), `ever` (2, part, batch), "uplinks" (..., batch), and "claimed", an array
                (time, part of the stack, pair, batch) for each stack.
            common: for each array whether all runs share it: then it is the value of one run, without a batch axis.
            count: number of runs in each batch.
        """
        # A value that all runs share counts once for each run of a batch. Claimed covariances are not among these, but
        # are treated below, since they need not be held by batch.
        is_shared = common.sums["claimed"]
        totals, ever = jax.tree.map(
            lambda leaf, is_common: leaf[..., None] * count if is_common else leaf,
            (sums.sums | {"claimed": ()}, sums.ever),
            (common.sums | {"claimed": ()}, common.ever),
        )
        # Order of the stacks: those whose claimed covariance differs between runs come first (False < True).
        claimed = sums.sums["claimed"]
        order = tuple(sorted(range(len(is_shared)), key=is_shared.__getitem__))
        # The same order for the parts of all other sums.
        sizes = [values.shape[1] for values in claimed]
        parts_of_stack = np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1])
        parts = np.concatenate([parts_of_stack[i] for i in order])
        # Claimed covariances by run, and of all runs. Each list begins with an empty array, so that it can be joined
        # where no stack is in it.
        steps, _, pairs, _ = totals["pairs"].shape
        by_run = [np.zeros((steps, 0, pairs, BATCHES)), *(claimed[i] for i in order if not is_shared[i])]
        of_all = [np.zeros((steps, 0, pairs)), *(claimed[i] * count.sum() for i in order if is_shared[i])]
        return RunSums(
            runs=count,
            pairs=totals["pairs"][:, parts],
            nees=totals["nees"][:, parts],
            claimed=np.concatenate(by_run, axis=1),
            shared=np.concatenate(of_all, axis=1),
            failed=np.sum(totals["failed"], axis=-1)[:, :, parts],
            failed_runs=np.sum(ever, axis=-1)[:, None, parts],
            uplinks=jax.tree.map(lambda leaf: np.sum(leaf, axis=-1), totals["uplinks"]),
            order=order,
            by_run=is_shared.count(False),
        )

    def finish(self, carry: RunSums, collected: PyTree, network: Network) -> StatisticsByName:
        """Return the statistics by node and filter, from the sums over all runs.

        Filters of one structure are stacked, at the nodes of a group; fusions between neighbours (meshes) have stacks
        of their own. In the sums all their estimates lie along one axis, which is cut here.

        Args:
            carry: the sums over runs, of products of errors, of NEES and of claimed covariances, with all estimates
                along one axis.
            collected: not used, as no single run is kept.
            network: the network, which tells which estimate is whose.
        """
        # Split the axis of estimates into stacks (filters of one structure) and fused estimates.
        all_stacks = network.stacks + network.mesh_stacks
        count, sums = _split_sums(
            carry, [(len(stack.filters), len(network.groups[stack.group])) for stack in all_stacks]
        )
        sums_of_stacks, sums_of_fused = sums[: len(all_stacks)], sums[len(all_stacks) :]
        named = {"estimates": sums_of_stacks, "fused": dict(zip(sorted(network.fused), sums_of_fused, strict=True))}
        # Each sum by node and filter. The axis of filters is -3 in a sum (..., filter, node, pair) of products e_i e_j,
        # and -2 in a sum (..., filter, node).
        filter_axes = _FilterSums(pairs=-3, nees=-2, claimed=-3, failed=-2, failed_runs=-2)
        sums_by_name = [split_by_name(network, named, itemgetter(i), axis) for i, axis in enumerate(filter_axes)]
        # Statistics with their claims, then those of the quantizers.
        statistics = StatisticsByName({}, network.states)
        for node, claims in network.claims().items():
            statistics[node] = {
                name: _make_statistics(count, _FilterSums(*(sums[node][name] for sums in sums_by_name)), claim)
                for name, claim in claims.items()
            }
        for name, uplink in uplinks_by_name(network, carry.uplinks).items():
            fused = statistics[FUSED][name]
            means = Uplink(uplink.nodes, uplink.saturated / fused.runs, uplink.symbols / fused.runs)
            statistics[FUSED][name] = replace(fused, uplink=means)
        return statistics

    def joined(self, results: Sequence[StatisticsByName], network: Network) -> StatisticsByName:
        """Return the statistics of all nodes, in the network's order, from those of parts of a network."""
        by_node: dict[str, dict[str, ErrorStatistics]] = {}
        for statistics_of_part in results:
            by_node |= statistics_of_part
        return StatisticsByName({name: by_node[name] for name in network.names}, network.states)

    def others(
        self, filtered: StatisticsByName, smoothed: StatisticsByName, claims: Mapping[str, Mapping[str, Claim]]
    ) -> StatisticsByName:
        """Add the statistics of the smoothed estimates to those of the filtered ones, as their field `smoothed`.

        Args:
            filtered: statistics of the filtered estimates, which are changed and returned.
            smoothed: statistics of the smoothed estimates, with the claims of the filters.
            claims: what smoothed covariances claim, by node and filter, in place of these.
        """
        statistics_with_claims = {
            node: {
                name: replace(statistics_of_filter, claim=claims[node][name])
                for name, statistics_of_filter in filters.items()
            }
            for node, filters in smoothed.items()
        }
        filtered.smoothed = StatisticsByName(statistics_with_claims, smoothed.states)
        return filtered


class _FilterSums(NamedTuple):
    """Sums over runs of a stack, a fused estimate or one filter; or a number for each of these sums.

    Shapes: pairs and claimed (batch, time, filter, node, pair), nees (batch, time, filter, node), failed (2, time,
    filter, node), failed_runs (2, 1, filter, node); of one filter, or of what is fused, without filter and node.
    claimed: the mean over the runs of each batch.
    """

    pairs: Any
    nees: Any
    claimed: Any
    failed: Any
    failed_runs: Any


def _make_statistics(count: np.ndarray, sums: _FilterSums, claim: Claim) -> ErrorStatistics:
    """Return the statistics of one filter from its sums over runs.

    `count`: number of runs in each batch.

    `sums`: of this filter alone. `claim`: what its covariance is said to be; with "none" it has none.
    """
    # Row 0 counts failures of the test of means, the only test if no covariance is claimed.
    tests = 0 if claim == "none" else slice(None)
    return ErrorStatistics(
        count=count,
        pairs=sums.pairs,
        claimed_pairs=sums.claimed,
        nees=sums.nees,
        claim=claim,
        failed=np.max(np.atleast_2d(sums.failed[tests]), axis=0),
        failed_runs=round(float(np.max(sums.failed_runs[tests]))),
    )


def _split_sums(carry: RunSums, stacks: list[tuple[int, int]]) -> tuple[np.ndarray, list[_FilterSums]]:
    """Return the number of runs in each batch, and the sums of each stack and then of each fused estimate, as views.

    A stack has filters of one structure. All estimates lie along one axis `part` of the sums, which is cut
    here: filters times nodes for each stack, one for a fused estimate, in the order `carry.order`.

    Args:
        carry: sums over the runs of error products, normalised errors, covariances and failures, axes (time, part, ...,
            batch). `order` has the numbers of stacks (0, 1, ...) and of fused estimates, which follow the stacks; the
            first `by_run` in this order have covariances that differ between runs.
        stacks: numbers of filters and of nodes of each stack.
    """
    # Axes (batch, time, part, ...); failures have their two sorts in place of batches.
    sums = carry.runs, carry.pairs, carry.nees, carry.claimed
    count, pairs, nees, varying = (np.moveaxis(np.asarray(values), -1, 0) for values in sums)
    failed, failed_runs = np.asarray(carry.failed).swapaxes(0, 1), np.asarray(carry.failed_runs)
    # Mean claimed covariances: by batch where they differ between runs, else the same for all batches.
    varying = varying / np.maximum(count, 1.0).reshape(-1, *[1] * (varying.ndim - 1))
    shared = np.broadcast_to(carry.shared / count.sum(), (BATCHES, *carry.shared.shape))
    first_shared = varying.shape[2]  # the first part whose covariances all runs share
    sums_of_stack, start = {}, 0
    for position, stack in enumerate(carry.order):
        axes = stacks[stack] if stack < len(stacks) else ()  # a fused estimate has no axes of filters and nodes
        parts = slice(start, start + int(np.prod(axes)))
        if position < carry.by_run:
            claimed = varying[:, :, parts]
        else:
            claimed = shared[:, :, parts.start - first_shared : parts.stop - first_shared]
        flat = _FilterSums(
            pairs=pairs[:, :, parts],
            nees=nees[:, :, parts],
            claimed=claimed,
            failed=failed[:, :, parts],
            failed_runs=failed_runs[:, :, parts],
        )
        # The axis `part` becomes those of filters and nodes.
        sums_of_stack[stack] = _FilterSums(
            *(values.reshape(*values.shape[:2], *axes, *values.shape[3:]) for values in flat)
        )
        start = parts.stop
    return count, [sums_of_stack[stack] for stack in range(len(sums_of_stack))]


def error_statistics(record: Record, node: str, name: str) -> ErrorStatistics:
    """Compute the statistics of one filter of one node from stored trajectories.

    Args:
        record: a record of Monte Carlo runs.
        node: name of the node.
        name: name of the filter.

    Raises:
        ValueError: a record without truth, or without a run axis.
    """
    instance("record", record, Record, "a Record")
    if record.truth is None or record.truth.ndim != 3:
        raise fail("error statistics", "Monte Carlo trajectories with truth", "a single recording")
    # The filter's estimates.
    known = [(element, label) for element, filters in record.estimates.items() for label in filters]
    if not (isinstance(node, str) and isinstance(name, str) and (node, name) in known):
        raise fail("node and filter", f"one of {known}", show_value((node, name)))
    estimate = record.estimates[node][name]
    # Sums over runs of errors' products, of normalised squares and of stated covariances, in BATCHES batches for
    # standard errors: run r belongs to batch r mod BATCHES. Their form is that of a simulation with this one estimate,
    # a fused one.
    arrays = (np.asarray(values, dtype=float) for values in (record.truth, estimate.mean, estimate.covariance))
    step: OfStep = over_runs(partial(_reduce_run, attitude=estimate.attitude), *arrays)
    sums, ever = jax.tree.map(_sum_batches, (step.sums, step.ever))
    count = np.bincount(np.arange(len(record.truth)) % BATCHES, minlength=BATCHES).astype(float)
    none_common = jax.tree.map(lambda leaf: False, OfStep(sums, ever))
    count, (filter_sums,) = _split_sums(Statistics().summed(OfStep(sums, ever), none_common, count), stacks=[])
    sent = record.uplinks.get(name) if node == FUSED else None
    uplink = None if sent is None else Uplink(sent.nodes, sent.saturated.mean(axis=0), sent.symbols.mean(axis=0))
    return replace(_make_statistics(count, filter_sums, estimate.claim), uplink=uplink)


def _reduce_run(truth: Array, mean: Array, covariance: Array, attitude: tuple[int, ...]) -> OfStep:
    """Return the sums of errors, by step, of one filter's estimates in one run, as a simulation makes them.

    The filter is given the name "" at the centre, since a step of a simulation has estimates by name.
    """
    estimate = Estimate(mean, covariance, claim="none", attitude=attitude)
    steps = {"truth": truth, "estimates": (), "fused": {"": estimate}, "uplinks": {}}
    return reduce_rows(Statistics(), steps)


def _sum_batches(values: np.ndarray) -> np.ndarray:
    """Return the sums of values (run, ...) over the runs of each batch, (..., batch)."""
    return np.stack([values[batch::BATCHES].sum(axis=0, dtype=float) for batch in range(BATCHES)], axis=-1)
