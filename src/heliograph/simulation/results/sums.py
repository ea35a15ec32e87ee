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
from heliograph.simulation.results.by_name import split_by_name, uplinks_by_name
from heliograph.simulation.results.record import Record
from heliograph.simulation.results.reducer import AbstractReducer, OfStep, reduce_rows
from heliograph.simulation.results.statistics import BATCHES, ErrorStatistics
from heliograph.simulation.results.statistics_by_name import StatisticsByName
from heliograph.simulation.runs.over_runs import over_runs


class Sums(NamedTuple):
    """Sums over runs: of pairs e_i e_j (time, part, pair, batch), of e' B^-1 e, of claimed covariances, of symbols.

    Run r goes to batch r mod BATCHES. A covariance that all runs share is summed once, without batches.

    failed (time, 2, part): runs whose mean is not finite, and whose error has no distance by the covariance, which is
    then not finite or indefinite; failed_runs (2, 1, part): in how many runs this happened at some step.

    `order`: whose estimates the parts are, kinds first and then fused ones; the first `by_run` have covariances that
    differ between runs.
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
        """Return the products of errors, e' B^-1 e, claimed covariances, and flags of invalid estimates."""
        truth = jnp.asarray(step["truth"])
        parts = [*step["estimates"], *(step["fused"][name] for name in sorted(step["fused"]))]
        n = len(truth)
        means = [jnp.asarray(estimate.mean).reshape(-1, n) for estimate in parts]
        claimed = [jnp.asarray(estimate.covariance).reshape(-1, n, n) for estimate in parts]
        # Errors and their NEES, and where these are invalid.
        errors = [replace(estimate, mean=mean).error(truth) for estimate, mean in zip(parts, means, strict=True)]
        distances = jax.vmap(squared_distance, in_axes=(0, 0, None))
        nees = [distances(b, e, truth) for b, e in zip(claimed, errors, strict=True)]
        joined, distance = jnp.concatenate(errors), jnp.concatenate(nees)
        finite = jnp.all(jnp.isfinite(joined), axis=1)
        bad = jnp.stack([~finite, jnp.isnan(distance)])
        # Pairs i <= j of symmetric matrices.
        rows, columns = np.triu_indices(n)
        sums = {
            "pairs": joined[:, rows] * joined[:, columns],
            "nees": distance,
            "claimed": tuple(b[:, rows, columns] for b in claimed),
            "failed": bad,
            "uplinks": step["uplinks"],
        }
        return OfStep(sums, bad)

    def summed(self, sums: OfStep, common: OfStep, count: np.ndarray) -> Sums:
        """Return the carry after all runs: filters with a covariance of their own in each run first, the others last.

        Args:
            sums: what was summed over runs, by batch, (time, filter, ..., batch); without a last axis where `common`.
            common: for each of these whether all runs share it, so that it is the value of one run.
            count: number of runs in each batch.
        """
        # Values that all runs share count once per run.
        shared = common.sums["claimed"]
        totals, ever = jax.tree.map(
            lambda leaf, same: leaf[..., None] * count if same else leaf,
            (sums.sums | {"claimed": ()}, sums.ever),
            (common.sums | {"claimed": ()}, common.ever),
        )
        # Order of the filters' parts: those whose claimed covariance differs between runs come first.
        claimed = sums.sums["claimed"]
        order = tuple(sorted(range(len(shared)), key=shared.__getitem__))
        sizes = [values.shape[1] for values in claimed]
        places = np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1])
        in_order = np.concatenate([places[i] for i in order])
        # Claimed covariances of both kinds, each begun by none, for there may be none of a kind.
        steps, _, pairs, _ = totals["pairs"].shape
        by_batch: Any = count
        by_run: list[Any] = [np.zeros((steps, 0, pairs, BATCHES)), *(claimed[i] for i in order if not shared[i])]
        of_all: list[Any] = [np.zeros((steps, 0, pairs)), *(claimed[i] * count.sum() for i in order if shared[i])]
        claimed_by_run: Any = np.concatenate(by_run, axis=1)
        claimed_by_all: Any = np.concatenate(of_all, axis=1)
        return Sums(
            runs=by_batch,
            pairs=totals["pairs"][:, in_order],
            nees=totals["nees"][:, in_order],
            claimed=claimed_by_run,
            shared=claimed_by_all,
            failed=np.sum(totals["failed"], axis=-1)[:, :, in_order],
            failed_runs=np.sum(ever, axis=-1)[:, None, in_order],
            uplinks=jax.tree.map(lambda leaf: np.sum(leaf, axis=-1), totals["uplinks"]),
            order=order,
            by_run=shared.count(False),
        )

    def finish(self, carry: Sums, collected: PyTree, network: Network) -> StatisticsByName:
        """Make the statistics by node and filter."""
        # Sums by kind and fusion, then by name.
        every = network.kinds + network.mesh_kinds
        count, parts = _split(carry, [(len(f), len(network.groups[g])) for g, f in every])
        kinds = len(every)
        named = {"estimates": parts[:kinds], "fused": dict(zip(sorted(network.fused), parts[kinds:], strict=True))}
        axes = enumerate((-3, -2, -3, -2, -2))
        items = [split_by_name(network, named, itemgetter(i), axis) for i, axis in axes]
        # Statistics with their claims, then those of the quantizers.
        statistics = StatisticsByName({}, network.states)
        for node, claims in network.claims().items():
            statistics[node] = {
                name: _make_statistics(count, [v[node][name] for v in items], claim) for name, claim in claims.items()
            }
        for name, uplink in uplinks_by_name(network, carry.uplinks).items():
            fused = statistics[FUSED][name]
            means = Uplink(uplink.nodes, uplink.saturated / fused.runs, uplink.symbols / fused.runs)
            statistics[FUSED][name] = replace(fused, uplink=means)
        return statistics

    def joined(self, results: Sequence[StatisticsByName], network: Network) -> StatisticsByName:
        """Join the nodes of all parts, in the network's order."""
        collected = {name: filters for statistics in results for name, filters in statistics.items()}
        return StatisticsByName({name: collected[name] for name in network.names}, network.states)

    def others(
        self, filtered: StatisticsByName, smoothed: StatisticsByName, claims: Mapping[str, Mapping[str, Claim]]
    ) -> StatisticsByName:
        """Return the statistics with `smoothed`."""
        results = {
            node: {name: replace(score, claim=claims[node][name]) for name, score in filters.items()}
            for node, filters in smoothed.items()
        }
        filtered.smoothed = StatisticsByName(results, smoothed.states)
        return filtered


def _make_statistics(count: np.ndarray, sums: Sequence[np.ndarray], claim: Claim) -> ErrorStatistics:
    """Return the statistics of one filter from its sums over runs."""
    pairs, nees, claimed, failed, failed_runs = sums
    which = 0 if claim == "none" else slice(None)  # no distance where no covariance is claimed
    by_step, runs = np.max(np.atleast_2d(failed[which]), axis=0), float(np.max(failed_runs[which]))
    return ErrorStatistics(count, pairs, claimed, nees, claim, failed=by_step, failed_runs=round(runs))


def _split(carry: Sums, kinds: list[tuple[int, int]]) -> tuple[np.ndarray, list[tuple[np.ndarray, ...]]]:
    """Split the sums into runs by batch, and for each kind and fused estimate its sums, mean claims and failures.

    The sums are those of pairs of errors and of NEES; claims are covariances that differ by run, or are shared.
    Axes (batch, time, filter, node, pair) for the kinds, without filter and node for what is fused; views.
    """
    # The axis of batches first.
    sums = carry.runs, carry.pairs, carry.nees, carry.claimed
    count, pairs, nees, varying = (
        np.moveaxis(np.asarray(values), -1, 0) for values in sums
    )  # views: they are last in memory
    # Mean claimed covariances.
    varying = varying / np.maximum(count, 1.0).reshape(-1, *[1] * (varying.ndim - 1))
    failed, failed_runs = np.asarray(carry.failed).swapaxes(0, 1), np.asarray(carry.failed_runs)
    shared = np.broadcast_to(carry.shared / count.sum(), (BATCHES, *carry.shared.shape))
    split, start = {}, 0
    # Rows of each part, in the order of the sums.
    for position, i in enumerate(carry.order):
        axes = kinds[i] if i < len(kinds) else ()
        rows = slice(start, start + int(np.prod(axes)))
        offset = varying.shape[2] if position >= carry.by_run else 0
        claimed = (shared if offset or position >= carry.by_run else varying)[
            :, :, rows.start - offset : rows.stop - offset
        ]
        split[i] = tuple(
            a.reshape(*a.shape[:2], *axes, *a.shape[3:])
            for a in (pairs[:, :, rows], nees[:, :, rows], claimed, failed[:, :, rows], failed_runs[:, :, rows])
        )
        start = rows.stop
    return count, [split[i] for i in range(len(split))]


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
    known = [(element, of) for element, filters in record.estimates.items() for of in filters]
    if not (isinstance(node, str) and isinstance(name, str) and (node, name) in known):
        raise fail("node and filter", f"one of {known}", show_value((node, name)))
    estimate = record.estimates[node][name]
    # The sums of a simulation, in which this is the only estimate; runs are dealt to batches.
    arrays = (np.asarray(values, dtype=float) for values in (record.truth, estimate.mean, estimate.covariance))
    step: OfStep = over_runs(partial(_reduce_run, attitude=estimate.attitude), *arrays)
    sums, ever = jax.tree.map(_sum_batches, (step.sums, step.ever))
    count = np.bincount(np.arange(len(record.truth)) % BATCHES, minlength=BATCHES).astype(float)
    common = jax.tree.map(lambda leaf: False, OfStep(sums, ever))
    count, (parts,) = _split(Statistics().summed(OfStep(sums, ever), common, count), [])
    sent = record.uplinks.get(name) if node == FUSED else None
    uplink = None if sent is None else Uplink(sent.nodes, sent.saturated.mean(axis=0), sent.symbols.mean(axis=0))
    return replace(_make_statistics(count, parts, estimate.claim), uplink=uplink)


def _reduce_run(truth: Array, mean: Array, covariance: Array, attitude: tuple[int, ...]) -> OfStep:
    """Reduce one run of a record."""
    estimate = Estimate(mean, covariance, "none", attitude=attitude)
    steps = {"truth": truth, "estimates": (), "fused": {"": estimate}, "uplinks": {}}
    return reduce_rows(Statistics(), steps)


def _sum_batches(values: np.ndarray) -> np.ndarray:
    """Sum values (run, ...) over the runs of each batch, (..., batch)."""
    return np.stack([values[batch::BATCHES].sum(axis=0, dtype=float) for batch in range(BATCHES)], axis=-1)
