"""Smoothed estimates of a network, from the smoother steps of its filters."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.filters.smoother_step.base import AbstractSmootherStep
from heliograph.fusion.informed import AbstractInformedFusion
from heliograph.fusion.rules import Fusion
from heliograph.model.estimate import Claim, Estimate
from heliograph.model.over_time import first
from heliograph.model.plant import AnyPlant
from heliograph.model.relays import RECEIVER
from heliograph.numerics.angle import Angles, nearest
from heliograph.numerics.check import fail, instance
from heliograph.numerics.module import Module
from heliograph.numerics.types import PyTree
from heliograph.simulation.centres.gathering import Fused
from heliograph.simulation.network import FUSED, Claims, Network
from heliograph.simulation.results.record import Record
from heliograph.simulation.results.reducer import AbstractReducer, OfStep, Result, Trajectories, trajectories_record
from heliograph.simulation.runs.by_run import each_run
from heliograph.simulation.stepping import AllFilters
from heliograph.smoothing.modes import AbstractSmoothing, nis_sums, warn_of


class Smoother(Module):
    """Smoothing of a network's filters: `kinds` of them and `groups` of measurements, by their places.

    `fusions`: of smoothed estimates at the same time.
    """

    smoothing: AbstractSmoothing
    fusions: tuple[Fused, ...]
    kinds: tuple[int, ...] = eqx.field(static=True)
    groups: tuple[int, ...] = eqx.field(static=True)

    def both(self, result: PyTree) -> PyTree:
        """Results of runs (run, time, ...) for a reducer, "filtered" and "smoothed", and sums of the NIS."""
        steps_by_kind = [result["smoother_steps"][k] for k in self.kinds]
        filtered = {name: part for name, part in result.items() if name not in ("smoother_steps", "central_steps")}
        surprised = jax.vmap(jax.vmap(nis_sums, in_axes=1), in_axes=1)
        # Smoothed estimates of nodes and central filters, then their fusions.
        estimates = tuple(self._estimates(steps, 2) for steps in steps_by_kind)
        fused = {name: self._estimates(steps, 0) for name, steps in result["central_steps"].items()}
        for item in self.fusions:
            fused |= each_run(partial(_combined, item), estimates)
        # As a block of the steps that are smoothed.
        length = jax.tree.leaves((estimates, fused))[0].shape[1]
        smoothed = {
            "measurements": tuple(result["measurements"][g][:, -length:] for g in self.groups),
            "estimates": estimates,
            "fused": fused,
            "uplinks": {},
            "reports": {},
        }
        if "truth" in result:
            truth = self.smoothing.about(result["truth"])
            smoothed |= {"truth": truth, **self._near(truth, smoothed, [steps.angles for steps in steps_by_kind])}
        # Sums of the NIS, for the test of consistency.
        nis = tuple(each_run(surprised, steps) for steps in steps_by_kind)
        centrally = {name: each_run(nis_sums, steps) for name, steps in result["central_steps"].items()}
        return {"filtered": filtered, "smoothed": smoothed, "nis": {"estimates": nis, "fused": centrally}}

    def _near(self, truth: jax.Array, known: Mapping[str, PyTree], angles: Sequence[Angles]) -> dict[str, PyTree]:
        """Estimates with their angles within half a turn of the truth, so that x - xhat is the error."""

        def near(estimate: Estimate, which: Angles) -> Estimate:
            mean = jnp.asarray(estimate.mean)
            others = truth.reshape(*truth.shape[:2], *[1] * (mean.ndim - 3), truth.shape[-1])
            return Estimate(nearest(mean, others, which), estimate.covariance, estimate.claim)

        every = next((which for which in angles if which), ())
        estimates = tuple(near(item, which) for item, which in zip(known["estimates"], angles, strict=True))
        return {"estimates": estimates, "fused": {name: near(item, every) for name, item in known["fused"].items()}}

    def _estimates(self, steps: AbstractSmootherStep, axes: int) -> Estimate:
        """Smoothed estimates of runs (run, time, ...), with so many axes after time; common covariances once."""

        def over(function: Callable[[PyTree], PyTree]) -> Callable[[PyTree], PyTree]:
            for _ in range(axes):
                function = jax.vmap(function, in_axes=1, out_axes=1)
            return function

        if len(steps.covariance) == len(steps.mean):
            result: Estimate = each_run(over(self.smoothing.sweep), steps)
            return result
        covariances = each_run(over(self.smoothing.covariances), steps)
        return Estimate(each_run(over(self.smoothing.means), steps), covariances, steps.claim)


def _combined(item: Fused, estimates: Sequence[Estimate]) -> dict[str, Estimate]:
    """Fuse estimates (time, filter, node, ...) at each time."""
    result: dict[str, Estimate] = jax.vmap(lambda parts: item.step((), parts, jnp.asarray(0))[1])(estimates)
    return result


class Part(NamedTuple):
    """Smoothed part of a network: places of its kinds and groups among the network's, and the claims."""

    network: Network
    smoothing: AbstractSmoothing
    kinds: tuple[int, ...]
    groups: tuple[int, ...]
    claims: Claims

    def smoother(self, filters: AllFilters) -> Smoother:
        """Build the smoother for these filters of the whole network."""
        return Smoother(self.smoothing, filters.fusions, self.kinds, self.groups)


def smoothed_part(network: Network, smoothing: AbstractSmoothing, horizon: int) -> Part:
    """Select the part of a network that is smoothed: all its estimates; where relays run schedules, the receiver's.

    Raises:
        ValueError: a filter or a fusion that cannot be smoothed, a horizon too short for the smoothing.
    """
    instance("smooth", smoothing, AbstractSmoothing, "one such as hg.smoothing.FixedInterval()")
    smoothing.check(horizon)
    if network.meshes:
        between = f"fusions between neighbours {list(network.meshes)}"
        raise fail("smoothing", "filters, and fusions at a centre", between)
    # Relays send filtered estimates: the receiver alone is smoothed.
    part = network
    if network.relays is not None:
        part = Network(network.plant, {RECEIVER: network.nodes[RECEIVER]}, relays=network.relays)
    # Claims of smoothed estimates and of their fusions.
    claims: Claims = {
        name: {f: _smoothed_claim(item) for f, item in node.filters.items()} for name, node in part.nodes.items()
    }
    if part.fused:
        claims[FUSED] = {name: _fused_claim(part, name, item, claims) for name, item in part.fused.items()}
    groups = tuple(g for g, names in enumerate(network.groups) if set(names) & set(part.names))
    kinds = tuple(k for k, kind in enumerate(network.kinds) if kind.group in groups)
    return Part(part, smoothing, kinds, groups, claims)


def _smoothed_claim(item: AbstractFilter) -> Claim:
    u, z = np.zeros(len(item.inputs)), np.zeros(item.received)
    with jax.enable_x64(True):
        state = jax.tree.map(jnp.asarray, item.init())
        _, step = eqx.filter_eval_shape(lambda single, state: single.step_with_smoother(state, z, u, 0), item, state)
    claim: Claim = step.claim
    return claim


def _fused_claim(network: Network, name: str, item: Fusion | AbstractFilter, claims: Claims) -> Claim:
    if isinstance(item, AbstractFilter):
        return _smoothed_claim(item)
    if isinstance(item.rule, AbstractInformedFusion):
        got = f"{type(item.rule).__name__}, which knows errors as they are before later data"
        raise fail(f"smoothing of {FUSED}/{name}", "a rule that needs no joint covariance", got)
    if item.quantizer is not None:
        raise fail(f"smoothing of {FUSED}/{name}", "estimates that arrive as they are", "a quantizer")
    return item.claim([claims[node][item.filter] for node in network.nodes_with(item.filter)])


def _warn_of_inconsistency(network: Network, nis: PyTree) -> None:
    """Warn of filters that are not consistent, from sums of the NIS over blocks and runs."""
    for (group, names), sums in zip(network.kinds, nis["estimates"], strict=True):
        for f, name in enumerate(names):
            for i, node in enumerate(network.groups[group]):
                warn_of(f"{node}/{name}", np.asarray(sums[f, i]))
    for name, sums in nis["fused"].items():
        warn_of(f"{FUSED}/{name}", np.asarray(sums))


def one_run(function: Callable[[PyTree], PyTree], values: PyTree) -> PyTree:
    """Apply a function of runs (run, ...) to one without an axis of runs."""
    return jax.tree.map(lambda leaf: leaf[0], function(jax.tree.map(lambda leaf: leaf[None], values)))


def found_record(network: Network, part: Part | None, result: PyTree, time: np.ndarray) -> Record:
    """Record of a recording, with its smoothed part."""
    if part is None:
        return trajectories_record(network, {"truth": None, **result}, time)
    _warn_of_inconsistency(part.network, result["nis"])
    filtered = trajectories_record(network, {"truth": None, **result["filtered"]}, time)
    length = result["smoothed"]["measurements"][0].shape[0]
    smoothed = trajectories_record(part.network, {"truth": None, **result["smoothed"]}, time[-length:])
    return Trajectories().others(filtered, smoothed, part.claims)


def with_truth(record: Record, plant: AnyPlant, truth: np.ndarray, smoothing: AbstractSmoothing | None) -> Record:
    """Return the record of a recording with the true states, angles of estimates within half a turn of them."""

    def near(item: Estimate, x: np.ndarray) -> Estimate:
        mean = np.asarray(item.mean)
        known = np.where(np.isnan(x), mean, x)
        return Estimate(first(plant).near(mean, known), item.covariance, item.claim)

    later = record.smoothed
    if later is not None and smoothing is not None:
        later = with_truth(
            later, plant, np.broadcast_to(smoothing.about(truth), (len(later.time), truth.shape[1])), None
        )
    estimates = {
        node: {name: near(item, truth) for name, item in filters.items()} for node, filters in record.estimates.items()
    }
    return replace(record, truth=truth, estimates=estimates, smoothed=later)


class WithSmoothed(AbstractReducer[Result]):
    """Reduction of filtered estimates, of smoothed ones, and sums of the NIS.

    A block is {"filtered", "smoothed", "nis"}; the first two are such as the reducer expects.
    """

    reducer: AbstractReducer[Result]

    def initial(self, shapes: PyTree) -> PyTree:
        """Return both carries, and zero sums of the NIS."""
        nis = jax.tree.map(lambda leaf: jnp.zeros(leaf.shape[1:]), shapes["nis"])
        return self.reducer.initial(shapes["filtered"]), self.reducer.initial(shapes["smoothed"]), nis

    def reduce(self, carry: PyTree, batch: PyTree, runs: jax.Array, valid: jax.Array) -> tuple[PyTree, PyTree]:
        """Reduce both, and add the NIS of valid runs."""
        filtered, smoothed, nis = carry
        filtered, recorded = self.reducer.reduce(filtered, batch["filtered"], runs, valid)
        smoothed, kept_later = self.reducer.reduce(smoothed, batch["smoothed"], runs, valid)

        def added(total: jax.Array, part: jax.Array) -> jax.Array:
            values = jnp.broadcast_to(part, (len(valid), *part.shape[1:]))
            return total + jnp.sum(jnp.where(valid.reshape(-1, *[1] * (values.ndim - 1)), values, 0.0), axis=0)

        nis = jax.tree.map(added, nis, batch["nis"])
        return (filtered, smoothed, nis), (recorded, kept_later)

    def summed(self, sums: OfStep, common: OfStep, count: np.ndarray) -> PyTree:
        """Return both carries, from sums that are pairs; and the NIS."""
        filtered, smoothed = (
            self.reducer.summed(OfStep(sums.sums[i], sums.ever[i]), OfStep(common.sums[i], common.ever[i]), count)
            for i in (0, 1)
        )
        nis = jax.tree.map(
            lambda leaf, same: leaf * count.sum() if same else leaf.sum(axis=-1), sums.sums[2], common.sums[2]
        )
        return filtered, smoothed, nis

    def finish(self, carry: PyTree, collected: PyTree, network: Network) -> Result:
        """Make the result of filtered estimates alone; `finished` makes both."""
        return self.reducer.finish(carry[0], collected[0], network)

    def finished(self, carry: PyTree, collected: PyTree, network: Network, part: Part) -> Result:
        """Make the result of the network with that of its smoothed part; warn of filters that are not consistent."""
        _warn_of_inconsistency(part.network, carry[2])
        smoothed = self.reducer.finish(carry[1], collected[1], part.network)
        return self.reducer.others(self.finish(carry, collected, network), smoothed, part.claims)
