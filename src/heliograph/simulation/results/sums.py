"""Sums for error statistics, run by run in bounded memory, or from stored trajectories."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from operator import itemgetter
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.model.estimate import Claim, Estimate
from heliograph.numerics.check import fail, instance, shown
from heliograph.numerics.float64 import compiled
from heliograph.numerics.linalg import squared_distance
from heliograph.numerics.module import Module
from heliograph.numerics.types import Array, PyTree
from heliograph.simulation.centres.uplinks import Uplink
from heliograph.simulation.network import FUSED, Network
from heliograph.simulation.results.by_name import by_name, uplinks_by_name
from heliograph.simulation.results.record import Record
from heliograph.simulation.results.reducer import AbstractReducer, OfStep
from heliograph.simulation.results.statistics import BATCHES, ErrorStatistics
from heliograph.simulation.results.statistics_by_name import StatisticsByName
from heliograph.simulation.runs.lanes import BLOCK

CACHE = 2**20  # bytes of errors that are worked through at once


class Sums(Module):
    """Sums over runs: of pairs e_i e_j (time, part, pair, batch), of e' B^-1 e, of claimed covariances, of symbols.

    Run r goes to batch r mod BATCHES. A covariance that all runs share is summed once, without batches.

    failed (time, 2, part): runs whose mean is not finite, and whose error has no distance by the covariance, which is
    then not finite or indefinite; failed_runs (2, 1, part): in how many runs this happened at some step.

    `order`: whose estimates the parts are, kinds first and then fused ones; the first `local` have covariances that
    differ between runs.
    """

    count: jax.Array
    pairs: jax.Array
    nees: jax.Array
    claimed: jax.Array
    shared: jax.Array
    failed: jax.Array
    failed_runs: jax.Array
    uplinks: PyTree
    order: tuple[int, ...] = eqx.field(static=True)
    local: int = eqx.field(static=True)


class Statistics(AbstractReducer[StatisticsByName]):
    """Reduce to error statistics of every filter of every node; memory does not grow with the number of runs."""

    def initial(self, shapes: PyTree) -> Sums:
        """Return sums of zero."""
        _, steps, n = shapes["truth"].shape
        parts, order, local = _parts(shapes)
        # Parts with covariances by run first, then those with a common one.
        sizes = [int(np.prod(parts[i].mean.shape[2:-1])) for i in order]
        total, mine, pairs = sum(sizes), sum(sizes[:local]), n * (n + 1) // 2
        return Sums(
            count=jnp.zeros(BATCHES),
            pairs=jnp.zeros((steps, total, pairs, BATCHES)),
            nees=jnp.zeros((steps, total, BATCHES)),
            claimed=jnp.zeros((steps, mine, pairs, BATCHES)),
            shared=jnp.zeros((steps, total - mine, pairs)),
            failed=jnp.zeros((steps, 2, total)),
            failed_runs=jnp.zeros((2, 1, total)),
            uplinks=jax.tree.map(lambda leaf: jnp.zeros(leaf.shape[1:]), shapes["uplinks"]),
            order=order,
            local=local,
        )

    def reduce(self, carry: Sums, batch: PyTree, runs: jax.Array, valid: jax.Array) -> tuple[Sums, PyTree]:
        """Add the valid runs, dealt to batches: a few steps at a time, so that they stay in the cache."""
        # The axis of runs last.
        parts, order, _ = _parts(batch)
        rows = jax.tree.map(lambda leaf: jnp.moveaxis(leaf, 0, -1), (batch["truth"], [parts[i] for i in order]))
        steps, n = rows[0].shape[:2]
        # Steps in pieces that fit the cache.
        width = _steps_at_once(steps, n * carry.pairs.shape[1] * len(runs) * carry.pairs.itemsize)
        dealt = jax.tree.map(lambda leaf: leaf.reshape(steps // width, width, *leaf.shape[1:]), rows)

        def some(state: tuple[Sums, jax.Array], row: PyTree) -> tuple[tuple[Sums, jax.Array], None]:
            following, bad = _added(state[0], row[0], row[1], runs[0] % BATCHES, valid)
            return (following, state[1] | jnp.any(bad, axis=0)), None

        # Sums over the pieces, and where some step had no estimate.
        begin = carry, jnp.zeros((2, carry.pairs.shape[1], len(runs)), dtype=bool)
        firsts = jnp.arange(0, steps, width)
        if width == steps:
            (sums, ever), _ = some(begin, jax.tree.map(lambda leaf: leaf[0], (firsts, dealt)))
        else:
            (sums, ever), _ = jax.lax.scan(some, begin, (firsts, dealt))
        # Numbers of runs, and the quantizers' sums.
        counted = valid.astype(float)
        sent = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(valid), *x.shape[1:])), batch["uplinks"])
        return replace(
            sums,
            count=carry.count + _by_batch(counted, runs[0] % BATCHES),
            failed_runs=carry.failed_runs + jnp.sum(ever, axis=-1)[:, None],
            uplinks=jax.tree.map(lambda s, x: s + jnp.tensordot(counted, x, axes=1), carry.uplinks, sent),
        ), ()

    def of_step(self, step: PyTree) -> OfStep:
        """Products of errors, e' B^-1 e, claimed covariances, and flags of invalid estimates."""
        truth = jnp.asarray(step["truth"])
        parts = [*step["estimates"], *(step["fused"][name] for name in sorted(step["fused"]))]
        n = len(truth)
        # The axis of parts last.
        means = [jnp.asarray(part.mean).reshape(-1, n).T for part in parts]
        claimed = [jnp.moveaxis(jnp.asarray(part.covariance).reshape(-1, n, n), 0, -1) for part in parts]
        # Errors and their NEES, and where these are invalid.
        errors = [truth[:, None] - mean for mean in means]
        nees = [squared_distance(b, e, truth[:, None]) for b, e in zip(claimed, errors, strict=True)]
        joined, distance = jnp.concatenate(errors, axis=1), jnp.concatenate(nees)
        finite = jnp.all(jnp.isfinite(joined), axis=0)
        bad = jnp.stack([~finite, jnp.isnan(distance)])
        # Pairs i <= j of symmetric matrices.
        rows, columns = np.triu_indices(n)
        sums = {
            "pairs": jnp.stack([joined[i] * joined[j] for i, j in zip(rows, columns, strict=True)], axis=-1),
            "nees": distance,
            "claimed": tuple(
                jnp.stack([b[i, j] for i, j in zip(rows, columns, strict=True)], axis=-1) for b in claimed
            ),
            "failed": bad,
            "uplinks": step["uplinks"],
        }
        return OfStep(sums, bad)

    def summed(self, sums: OfStep, common: OfStep, count: np.ndarray) -> Sums:
        """Return the carry after all runs, with the covariances that all runs share last."""
        # Values that all runs share count once per run.
        shared = common.sums["claimed"]
        result, ever = jax.tree.map(
            lambda leaf, same: leaf[..., None] * count if same else leaf,
            (sums.sums | {"claimed": ()}, sums.ever),
            (common.sums | {"claimed": ()}, common.ever),
        )
        # Order of the parts: covariances by run first.
        claimed = sums.sums["claimed"]
        order = tuple(sorted(range(len(shared)), key=shared.__getitem__))
        sizes = [part.shape[1] for part in claimed]
        places = np.split(np.arange(sum(sizes)), np.cumsum(sizes)[:-1])
        into = np.concatenate([places[i] for i in order])
        # Claimed covariances of both kinds.
        steps, _, pairs, _ = result["pairs"].shape
        items: Any = count
        mine: list[Any] = [np.zeros((steps, 0, pairs, BATCHES)), *(claimed[i] for i in order if not shared[i])]
        others: list[Any] = [np.zeros((steps, 0, pairs)), *(claimed[i] * count.sum() for i in order if shared[i])]
        local: Any = np.concatenate(mine, axis=1)
        common_to_all: Any = np.concatenate(others, axis=1)
        return Sums(
            count=items,
            pairs=result["pairs"][:, into],
            nees=result["nees"][:, into],
            claimed=local,
            shared=common_to_all,
            failed=np.sum(result["failed"], axis=-1)[:, :, into],
            failed_runs=np.sum(ever, axis=-1)[:, None, into],
            uplinks=jax.tree.map(lambda leaf: np.sum(leaf, axis=-1), result["uplinks"]),
            order=order,
            local=shared.count(False),
        )

    def finish(self, carry: Sums, collected: PyTree, network: Network) -> StatisticsByName:
        """Make the statistics by node and filter."""
        # Sums by kind and fusion, then by name.
        every = network.kinds + network.mesh_kinds
        count, parts = _split(carry, [(len(f), len(network.groups[g])) for g, f in every])
        kinds = len(every)
        named = {"estimates": parts[:kinds], "fused": dict(zip(sorted(network.fused), parts[kinds:], strict=True))}
        axes = enumerate((-3, -2, -3, -2, -2))
        items = [by_name(network, named, itemgetter(i), axis) for i, axis in axes]
        # Statistics with their claims, then those of the quantizers.
        result = StatisticsByName({}, network.states)
        for node, claims in network.claims().items():
            result[node] = {
                name: _statistics(count, [part[node][name] for part in items], claim) for name, claim in claims.items()
            }
        for name, uplink in uplinks_by_name(network, carry.uplinks).items():
            fused = result[FUSED][name]
            means = Uplink(uplink.nodes, uplink.saturated / fused.runs, uplink.symbols / fused.runs)
            result[FUSED][name] = replace(fused, uplink=means)
        return result

    def joined(self, results: Sequence[StatisticsByName], network: Network) -> StatisticsByName:
        """Join the nodes of all parts, in the network's order."""
        collected = {name: filters for result in results for name, filters in result.items()}
        return StatisticsByName({name: collected[name] for name in network.names}, network.states)

    def others(
        self, result: StatisticsByName, smoothed: StatisticsByName, claims: Mapping[str, Mapping[str, Claim]]
    ) -> StatisticsByName:
        """Return the statistics with `smoothed`."""
        results = {
            node: {name: replace(score, claim=claims[node][name]) for name, score in filters.items()}
            for node, filters in smoothed.items()
        }
        result.smoothed = StatisticsByName(results, smoothed.states)
        return result


def _statistics(count: np.ndarray, sums: Sequence[np.ndarray], claim: Claim) -> ErrorStatistics:
    pairs, nees, claimed, failed, failed_runs = sums
    which = 0 if claim == "none" else slice(None)  # no distance where no covariance is claimed
    by_step, runs = np.max(np.atleast_2d(failed[which]), axis=0), float(np.max(failed_runs[which]))
    return ErrorStatistics(count, pairs, claimed, nees, claim, failed=by_step, failed_runs=round(runs))


def _parts(batch: PyTree) -> tuple[list[Estimate], tuple[int, ...], int]:
    """Estimates of a block; their order, those with a covariance for each run first; and the number of these."""
    parts = [*batch["estimates"], *(batch["fused"][name] for name in sorted(batch["fused"]))]
    shared = [part.covariance.shape[0] < batch["truth"].shape[0] for part in parts]
    return parts, tuple(sorted(range(len(parts)), key=shared.__getitem__)), shared.count(False)


def _added(
    sums: Sums, first: jax.Array, rows: tuple[jax.Array, list[Estimate]], start: jax.Array, valid: jax.Array
) -> tuple[Sums, jax.Array]:
    """Add some steps from `first` on, of runs from batch `start` on; also return where there is no estimate."""
    truth, parts = rows
    # Errors (n, time, part, run), zero for padding.
    errors = jnp.concatenate([_error(truth, part) for part in parts], axis=2)  # (n, time, part, run)
    errors = jnp.where(valid, errors, 0.0)  # the others may hold anything
    # Claimed covariances: by run, and common to all.
    unit = jnp.eye(len(errors)).reshape(len(errors), len(errors), 1, 1, 1)
    mine = [jnp.where(valid, _claimed(part), unit) for part in parts[: sums.local]]
    bounds = [jnp.concatenate(b, axis=3) for b in (mine, [_claimed(part) for part in parts[sums.local :]]) if b]
    split = [errors[:, :, : bounds[0].shape[3]], errors[:, :, bounds[0].shape[3] :]][: len(bounds)]
    size = truth.transpose(1, 0, 2)[:, :, None]
    # e' B^-1 e, and where it is invalid.
    nees = jnp.concatenate([_squared_distance(b, e, size) for b, e in zip(bounds, split, strict=True)], axis=1)
    bad = jnp.stack([~jnp.all(jnp.isfinite(errors), axis=0), jnp.isnan(nees)], axis=1) & valid  # (time, 2, part, run)
    # Sums by batch.
    claimed, shared = sums.claimed, sums.shared
    if sums.local:
        claimed = _added_from(claimed, _by_batch(jnp.where(valid, _pairs(bounds[0]), 0.0), start), first)
    if sums.local < len(parts):
        shared = _added_from(shared, _pairs(bounds[-1])[..., 0] * jnp.sum(valid.astype(float)), first)
    dealt = _by_batch(errors, start)
    return replace(
        sums,
        pairs=_added_from(sums.pairs, _pairs(dealt[:, None] * dealt[None]), first),
        nees=_added_from(sums.nees, _by_batch(nees, start), first),
        claimed=claimed,
        shared=shared,
        failed=_added_from(sums.failed, jnp.sum(bad, axis=-1).astype(float), first),
    ), bad


def _steps_at_once(steps: int, size: int) -> int:
    """Largest divisor of `steps` whose steps, each of this many bytes, fit the cache."""
    return max(width for width in range(1, steps + 1) if steps % width == 0 and (width == 1 or width * size <= CACHE))


def _error(truth: jax.Array, part: Estimate) -> jax.Array:
    """x - xhat as (n, time, part, run), from arrays with runs last."""
    mean = jnp.asarray(part.mean)
    mean = mean.reshape(len(mean), -1, *mean.shape[-2:])
    return jnp.moveaxis(truth[:, None] - mean, 2, 0)


def _claimed(part: Estimate) -> jax.Array:
    """Claimed covariance as (n, n, time, part, run)."""
    value = jnp.asarray(part.covariance)
    return value.reshape(len(value), -1, *value.shape[-3:]).transpose(2, 3, 0, 1, 4)


_squared_distance = jax.jit(squared_distance)


def _pairs(values: jax.Array) -> jax.Array:
    """Entries i <= j of symmetric (n, n, time, part, run) as (time, part, pair, run)."""
    return jnp.stack([values[i, j] for i, j in zip(*np.triu_indices(len(values)), strict=True)], axis=2)


def _by_batch(values: jax.Array, start: jax.Array | int) -> jax.Array:
    """Values (..., run) of consecutive runs from batch `start` on as (..., batch), zero where there is none."""
    runs, zero = values.shape[-1], (0,) * (values.ndim - 1)
    row = jnp.zeros((*values.shape[:-1], BATCHES + runs - 1), values.dtype)
    row = jax.lax.dynamic_update_slice(row, values, (*zero, start))
    begin, beyond = row[..., :BATCHES], row[..., BATCHES:]
    return jax.lax.dynamic_update_slice(begin, begin[..., : runs - 1] + beyond, (*zero, 0))


def _added_from(sums: jax.Array, values: jax.Array, first: jax.Array | int) -> jax.Array:
    """Add values (time, ...) of consecutive steps from `first` on."""
    place = (first, *[0] * (sums.ndim - 1))
    there = jax.lax.dynamic_slice(sums, place, values.shape)
    return jax.lax.dynamic_update_slice(sums, there + values, place)


def _split(carry: Sums, kinds: list[tuple[int, int]]) -> tuple[np.ndarray, list[tuple[np.ndarray, ...]]]:
    """Runs by batch; of each kind and fused estimate sums of pairs and NEES, mean claimed covariances, and failures.

    Axes (batch, time, filter, node, pair) for the kinds, without filter and node for what is fused; views.
    """
    # The axis of batches first.
    sums = carry.count, carry.pairs, carry.nees, carry.claimed
    count, pairs, nees, local = (
        np.moveaxis(np.asarray(part), -1, 0) for part in sums
    )  # views: they are last in memory
    # Mean claimed covariances.
    local = local / np.maximum(count, 1.0).reshape(-1, *[1] * (local.ndim - 1))
    failed, failed_runs = np.asarray(carry.failed).swapaxes(0, 1), np.asarray(carry.failed_runs)
    shared = np.broadcast_to(carry.shared / count.sum(), (BATCHES, *carry.shared.shape))
    result, place = {}, 0
    # Rows of each part, in the order of the sums.
    for position, i in enumerate(carry.order):
        axes = kinds[i] if i < len(kinds) else ()
        rows = slice(place, place + int(np.prod(axes)))
        offset = local.shape[2] if position >= carry.local else 0
        claimed = (shared if offset or position >= carry.local else local)[
            :, :, rows.start - offset : rows.stop - offset
        ]
        result[i] = tuple(
            a.reshape(*a.shape[:2], *axes, *a.shape[3:])
            for a in (pairs[:, :, rows], nees[:, :, rows], claimed, failed[:, :, rows], failed_runs[:, :, rows])
        )
        place = rows.stop
    return count, [result[i] for i in range(len(result))]


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
        raise fail("node and filter", f"one of {known}", shown((node, name)))
    estimate = record.estimates[node][name]
    # The sums of a simulation, in which this is the only estimate.
    sums = _of_record(record.truth, np.asarray(estimate.mean), np.asarray(estimate.covariance))
    count, (parts,) = _split(sums, [])
    sent = record.uplinks.get(name) if node == FUSED else None
    uplink = None if sent is None else Uplink(sent.nodes, sent.saturated.mean(axis=0), sent.symbols.mean(axis=0))
    return replace(_statistics(count, parts, estimate.claim), uplink=uplink)


@compiled
def _of_record(truth: Array, mean: Array, covariance: Array) -> Sums:
    """Sum over the runs of a record, block by block."""
    runs = len(truth)
    blocks = jnp.arange(-(-runs // BLOCK) * BLOCK).reshape(-1, BLOCK)

    def batch(numbers: jax.Array) -> PyTree:
        rows = [jnp.asarray(a)[jnp.minimum(numbers, runs - 1)] for a in (truth, mean, covariance)]
        return {"truth": rows[0], "estimates": (), "fused": {"": Estimate(rows[1], rows[2], "none")}, "uplinks": {}}

    def body(sums: Sums, numbers: jax.Array) -> tuple[Sums, PyTree]:
        return Statistics().reduce(sums, batch(numbers), numbers, numbers < runs)

    return jax.lax.scan(body, Statistics().initial(batch(blocks[0])), blocks)[0]
