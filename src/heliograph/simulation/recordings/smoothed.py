"""Smoothed estimates of a network, from the smoother steps of its filters."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.fusion.joint_covariance_fusion import AbstractInformedFusion
from heliograph.fusion.network_fusion import Fusion
from heliograph.model.estimate import Claim, Estimate
from heliograph.model.over_time import first
from heliograph.model.plant import AnyPlant
from heliograph.model.relays import RECEIVER
from heliograph.numerics.angles.angle import Angles, wrap_near
from heliograph.numerics.check import fail, instance
from heliograph.numerics.module import Module
from heliograph.numerics.types import PyTree
from heliograph.simulation.centres.fusions import StackedFusions
from heliograph.simulation.network import FUSED, Claims, Network
from heliograph.simulation.network_filters import AllFilters
from heliograph.simulation.results.record import Record
from heliograph.simulation.results.reducer import (
    AbstractReducer,
    OfStep,
    Result,
    Trajectories,
    reduce_rows,
    trajectories_record,
)
from heliograph.smoothing.fixed_interval_lag_point import AbstractSmoothing, nis_sums, warn_if_inconsistent


class NetworkSmoother(Module):
    """Smooths the filters of a network's run, and fuses the smoothed estimates.

    Args:
        smoothing: which estimates are made, such as those of a fixed interval.
        fusions: of smoothed estimates of the same time.
        stacks: numbers of the stacks of filters that are smoothed.
        groups: numbers of the groups of nodes that have them.
    """

    smoothing: AbstractSmoothing
    fusions: tuple[StackedFusions, ...]
    stacks: tuple[int, ...] = eqx.field(static=True)
    groups: tuple[int, ...] = eqx.field(static=True)

    def smooth_run(self, outputs: PyTree) -> PyTree:
        """Return a run's results "filtered" and "smoothed", each as a reducer reads a step, and sums of the "nis".

        NIS: e' S^-1 e of an innovation e of covariance S, which is about its number of components if a filter is
        consistent. A reducer turns steps into results, such as statistics. A stack has filters of one structure,
        a group nodes.

        Args:
            outputs: all that the filters' steps put out (time, ...): measurements and true states, and the terms of
                the backward pass, by stack ("smoother_steps") and of filters at the centre by name ("central_steps").
        """
        # Terms of the backward pass, and apart from them the filters' own outputs.
        steps_by_stack = [outputs["smoother_steps"][k] for k in self.stacks]
        filtered = {name: values for name, values in outputs.items() if name not in ("smoother_steps", "central_steps")}
        # Smoothed estimates of nodes and central filters, then their fusions. Steps of one stack are
        # (time, filter, node, ...): each filter of each node is swept back over time by itself.
        sweep = jax.vmap(jax.vmap(self.smoothing.sweep, in_axes=1, out_axes=1), in_axes=1, out_axes=1)
        estimates = tuple(sweep(steps) for steps in steps_by_stack)
        fused = {name: self.smoothing.sweep(steps) for name, steps in outputs["central_steps"].items()}
        for fusion in self.fusions:
            fused |= _fuse_at_each_time(fusion, estimates)
        # Measurements of the same steps (a smoothing may leave out the first steps of a run); senders have no part.
        length = len(jax.tree.leaves((estimates, fused))[0])
        smoothed = {
            "measurements": tuple(outputs["measurements"][g][-length:] for g in self.groups),
            "estimates": estimates,
            "fused": fused,
            "uplinks": {},
            "reports": {},
        }
        # True states of these steps, and smoothed angles turned by full turns to be next to the true ones.
        if "truth" in outputs:
            truth = self.smoothing.select_reference(outputs["truth"])
            smoothed |= {
                "truth": truth,
                **_turn_angles_to_truth(truth, smoothed, [steps.angles for steps in steps_by_stack]),
            }
        # Sums of the NIS, for the test of consistency.
        sum_nis = jax.vmap(jax.vmap(nis_sums, in_axes=1), in_axes=1)
        nis = tuple(sum_nis(steps) for steps in steps_by_stack)
        centrally = {name: nis_sums(steps) for name, steps in outputs["central_steps"].items()}
        return {"filtered": filtered, "smoothed": smoothed, "nis": {"estimates": nis, "fused": centrally}}


def _turn_angles_to_truth(
    truth: jax.Array, smoothed: Mapping[str, PyTree], angles_of_stacks: Sequence[Angles]
) -> dict[str, PyTree]:
    """Return the estimates with their angles within half a turn of the truth, so that x - xhat is the error.

    Args:
        truth: states x (time, n).
        smoothed: "estimates" by stack and "fused" by name, (time, ..., n).
        angles_of_stacks: which states are angles for the filters of each stack.
    """

    def wrap(estimate: Estimate, angles: Angles) -> Estimate:
        """Return an estimate (time, ..., n) with its angles within half a turn of those of the truth (time, n)."""
        mean = jnp.asarray(estimate.mean)
        # Axes of length 1 in the places of the mean's axes between time and state, such as filters and nodes.
        truth_at_each = truth.reshape(len(truth), *[1] * (mean.ndim - 2), -1)
        return replace(estimate, mean=wrap_near(mean, truth_at_each, angles))

    # The plant's angles are those of any stack that has some.
    of_plant = next((angles for angles in angles_of_stacks if angles), ())
    estimates = tuple(wrap(e, angles) for e, angles in zip(smoothed["estimates"], angles_of_stacks, strict=True))
    return {"estimates": estimates, "fused": {name: wrap(e, of_plant) for name, e in smoothed["fused"].items()}}


def _fuse_at_each_time(fusion: StackedFusions, estimates: Sequence[Estimate]) -> dict[str, Estimate]:
    """Return the fused estimates (time, ...) by name, from nodes' estimates (time, filter, node, ...) by stack.

    A stack has filters of one structure. The rule of fusion has no state: smoothed estimates of one time are fused as
    filtered ones are, without quantizers.
    """

    def fuse(estimates: Sequence[Estimate]) -> dict[str, Estimate]:
        """Return the fused estimates of one time, by name, from nodes' estimates (filter, node, ...) by stack."""
        no_state, step_number = (), jnp.asarray(0)
        _, fused, _ = fusion.step(no_state, estimates, step_number)
        return fused

    fused: dict[str, Estimate] = jax.vmap(fuse)(estimates)
    return fused


def reduce_run(reducer: AbstractReducer[Result], smoother: NetworkSmoother | None, outputs: PyTree) -> OfStep:
    """Return what a reducer makes of a run's `outputs` (time, ...): `sums`, `ever` and `collected`.

    `sums` are numbers of each step that are then summed over runs. `ever` are flags that are True at some step, summed
    as a count of runs. `collected` is stored for each run. With a smoother each is a pair, of filtered and of smoothed
    estimates, and `sums` has a third entry: the normalised innovations squared (NIS), by which the filters are tested.
    """
    if smoother is None:
        return reduce_rows(reducer, outputs)
    results = smoother.smooth_run(outputs)
    filtered, smoothed = reduce_rows(reducer, results["filtered"]), reduce_rows(reducer, results["smoothed"])
    return OfStep(
        sums=(filtered.sums, smoothed.sums, results["nis"]),
        ever=(filtered.ever, smoothed.ever),
        collected=(filtered.collected, smoothed.collected),
    )


class SmoothingPlan(NamedTuple):
    """Part of a network that is smoothed.

    Args:
        network: the part, as a network.
        smoothing: which estimates are made.
        stacks: numbers of its stacks of filters in the whole network.
        groups: numbers of its groups of nodes in the whole network.
        claims: of smoothed estimates and their fusions, by node and filter.
    """

    network: Network
    smoothing: AbstractSmoothing
    stacks: tuple[int, ...]
    groups: tuple[int, ...]
    claims: Claims

    def smoother(self, filters: AllFilters) -> NetworkSmoother:
        """Build the smoother for these filters of the whole network."""
        return NetworkSmoother(self.smoothing, filters.fusions, self.stacks, self.groups)


def select_smoothed_part(network: Network, smoothing: AbstractSmoothing, horizon: int) -> SmoothingPlan:
    """Return the part of a network that is smoothed: all its estimates; where relays run schedules, the receiver's.

    A smoothed estimate uses data from after its own time too. In a network with relays, relays send filtered estimates
    on, and only the receiver at the end is smoothed.

    Args:
        network: the network.
        smoothing: which estimates are made: of a fixed interval, lag or point.
        horizon: number of steps.

    Returns:
        The smoothed part as a network, the smoothing, the numbers of the part's stacks and groups in the whole network
        (a group: nodes of one structure; a stack: filters of one structure in a group), and its claims: what the
        smoothed covariances are said to be.

    Raises:
        ValueError: no filter, a filter or a fusion that cannot be smoothed, a horizon too short for the smoothing.
    """
    instance("smooth", smoothing, AbstractSmoothing, "one such as hg.smoothing.FixedInterval()")
    smoothing.check(horizon)
    if network.meshes:
        between = f"fusions between neighbours {list(network.meshes)}"
        raise fail("smoothing", "filters, and fusions at a centre", between)
    # Relays send filtered estimates: the receiver alone is smoothed.
    smoothed = network
    if network.relays is not None:
        smoothed = Network(network.plant, {RECEIVER: network.nodes[RECEIVER]}, relays=network.relays)
    has_filters = any(node.filters for node in smoothed.nodes.values())
    if not has_filters and not smoothed.fused:
        raise fail("smoothing", "a filter at a node or the centre", "a network without filters")
    # Claims of smoothed estimates, by node and filter, and of their fusions at the centre.
    claims: Claims = {
        name: {f: _find_claim_of_smoother(filter) for f, filter in node.filters.items()}
        for name, node in smoothed.nodes.items()
    }
    if smoothed.fused:
        claims[FUSED] = {
            name: _find_claim_of_fusion(smoothed, name, fusion, claims) for name, fusion in smoothed.fused.items()
        }
    # Numbers of the part's groups of nodes and stacks of filters in the whole network.
    groups = tuple(g for g, names in enumerate(network.groups) if set(names) & set(smoothed.names))
    stacks = tuple(k for k, stack in enumerate(network.stacks) if stack.group in groups)
    return SmoothingPlan(smoothed, smoothing, stacks, groups, claims)


def _find_claim_of_smoother(filter: AbstractFilter) -> Claim:
    """Return the claim of a filter's smoothed estimates (what their covariance promises), read from a smoother step.

    Only the shape of the step is computed, so that measurement and input may be zeros.
    """
    u, z = np.zeros(len(filter.inputs)), np.zeros(filter.received)
    with jax.enable_x64(True):
        state = jax.tree.map(np.asarray, filter.init())
        _, smoother_step = eqx.filter_eval_shape(
            lambda filter, state: filter.step_with_smoother(state, z, u, k=0), filter, state
        )
    claim: Claim = smoother_step.claim
    return claim


def _find_claim_of_fusion(network: Network, name: str, fusion: Fusion | AbstractFilter, claims: Claims) -> Claim:
    """Return what a fusion of smoothed estimates, or a smoothed central filter, can claim.

    Args:
        network: the part of the network that is smoothed.
        name: name of the fusion.
        fusion: the fusion, or a central filter.
        claims: claims of the nodes' smoothed estimates, by node and filter.

    Raises:
        ValueError: a fusion that has no smoothed form.
    """
    if isinstance(fusion, AbstractFilter):
        return _find_claim_of_smoother(fusion)
    if isinstance(fusion.rule, AbstractInformedFusion):
        got = f"{type(fusion.rule).__name__}, which knows errors as they are before later data"
        raise fail(f"smoothing of {FUSED}/{name}", "a rule that needs no joint covariance", got)
    if fusion.quantizer is not None:
        raise fail(f"smoothing of {FUSED}/{name}", "estimates that arrive as they are", "a quantizer")
    return fusion.claim([claims[node][fusion.filter] for node in network.nodes_with(fusion.filter)])


def _warn_of_inconsistency(network: Network, nis: PyTree) -> None:
    """Warn of filters that are not consistent, from sums of their NIS over all runs, as `smooth_run` returns them.

    The NIS, the normalised innovation squared, is on average the number of components if a filter's claim is right.
    """
    for (group, names), sums in zip(network.stacks, nis["estimates"], strict=True):
        for filter_index, name in enumerate(names):
            for node_index, node in enumerate(network.groups[group]):
                warn_if_inconsistent(f"{node}/{name}", np.asarray(sums[filter_index, node_index]))
    for name, sums in nis["fused"].items():
        warn_if_inconsistent(f"{FUSED}/{name}", np.asarray(sums))


def make_smoothed_record(network: Network, smoothing: SmoothingPlan, outputs: PyTree, time: np.ndarray) -> Record:
    """Return the record of a recording with its smoothed part; warn of filters that are not consistent.

    Args:
        network: the whole network.
        smoothing: its smoothed part.
        outputs: what `NetworkSmoother.smooth_run` returned.
        time: times of the rows.
    """
    _warn_of_inconsistency(smoothing.network, outputs["nis"])
    filtered = trajectories_record(network, {"truth": None, **outputs["filtered"]}, time)
    # The smoothed part may have only the last rows.
    length = outputs["smoothed"]["measurements"][0].shape[0]
    smoothed = trajectories_record(smoothing.network, {"truth": None, **outputs["smoothed"]}, time[-length:])
    return Trajectories().others(filtered, smoothed, smoothing.claims)


def add_truth(record: Record, plant: AnyPlant, truth: np.ndarray, smoothing: AbstractSmoothing | None) -> Record:
    """Return the record of a recording with its true states (time, n), NaN where unknown, also in its smoothed part.

    Angles of estimates are moved by whole turns to within half a turn of the true ones, so that x - xhat is the error.
    """

    def wrap(estimate: Estimate, x: np.ndarray) -> Estimate:
        """Return an estimate with its angles within half a turn of those of the true state x, where x is known."""
        mean = np.asarray(estimate.mean)
        truth_or_mean = np.where(np.isnan(x), mean, x)
        return replace(estimate, mean=first(plant).near(mean, truth_or_mean))

    smoothed = record.smoothed
    if smoothed is not None and smoothing is not None:
        # The true states of the times of which smoothed estimates are made.
        reference = np.broadcast_to(smoothing.select_reference(truth), (len(smoothed.time), truth.shape[1]))
        smoothed = add_truth(smoothed, plant, reference, smoothing=None)
    estimates = {
        node: {name: wrap(estimate, truth) for name, estimate in by_filter.items()}
        for node, by_filter in record.estimates.items()
    }
    return replace(record, truth=truth, estimates=estimates, smoothed=smoothed)


class ReducedRuns(NamedTuple):
    """What a reducer made of all runs.

    Args:
        sums: over the runs of each batch, (..., batch); of what all runs share, its value.
        common: of each of these, whether all runs share it.
        runs: how many there are in each batch (batch,).
        collected: what is kept of each run (run, ...).
    """

    sums: OfStep
    common: OfStep
    runs: np.ndarray
    collected: PyTree


def finish_result(
    reducer: AbstractReducer[Result], recorded: ReducedRuns, network: Network, smoothing: SmoothingPlan | None
) -> Result:
    """Return the result of a network's runs, with that of its smoothed part; warn of filters that are not consistent.

    Args:
        reducer: makes a result, such as error statistics, from sums over the runs.
        recorded: what it summed and collected over all runs, as `reduce_run` says. With smoothing each of it is a pair,
            of filtered and of smoothed estimates; the sums have a third entry, the normalised innovations squared
            (NIS).
        network: the network.
        smoothing: its smoothed part; None where nothing was smoothed.
    """
    sums, common, runs_by_batch, collected = recorded
    if smoothing is None:
        return reducer.finish(reducer.summed(sums, common, runs_by_batch), collected, network)
    filtered_sums, smoothed_sums, nis_by_batch = sums.sums  # (..., batch), or a value (...) that all runs share
    filtered_is_common, smoothed_is_common, nis_is_common = common.sums  # whether all runs share it
    # The NIS summed over all runs: a value that all runs share counts once for each.
    runs = runs_by_batch.sum()
    nis = jax.tree.map(
        lambda leaf, is_common: leaf * runs if is_common else leaf.sum(axis=-1), nis_by_batch, nis_is_common
    )
    _warn_of_inconsistency(smoothing.network, nis)

    def finish(part: Network, sums: OfStep, common: OfStep, collected: PyTree) -> Result:
        """Return the result of a network's filtered or smoothed estimates."""
        return reducer.finish(reducer.summed(sums, common, runs_by_batch), collected, part)

    filtered_ever, smoothed_ever = sums.ever
    filtered_ever_is_common, smoothed_ever_is_common = common.ever
    filtered = finish(
        network,
        OfStep(filtered_sums, filtered_ever),
        OfStep(filtered_is_common, filtered_ever_is_common),
        collected[0],
    )
    smoothed = finish(
        smoothing.network,
        OfStep(smoothed_sums, smoothed_ever),
        OfStep(smoothed_is_common, smoothed_ever_is_common),
        collected[1],
    )
    return reducer.others(filtered, smoothed, smoothing.claims)
