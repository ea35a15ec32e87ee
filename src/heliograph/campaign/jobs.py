"""Jobs of a campaign, as any process does them: describe a setting, or compute a chunk of its runs and their errors."""

import traceback
from dataclasses import dataclass
from functools import lru_cache, partial
from operator import itemgetter
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.campaign.definition import Campaign, Chunk, collect_versions, parse_campaign
from heliograph.campaign.zarr_store import (
    AxisLabels,
    NetworkDescription,
    check_labels_within,
    describe_network,
    read_labels,
    restore_labels,
    write_chunk,
)
from heliograph.model.estimate import Estimate
from heliograph.model.over_time import have_same_structure
from heliograph.numerics.check import fail
from heliograph.numerics.linalg import squared_distance
from heliograph.numerics.types import PyTree
from heliograph.simulation.network import Network
from heliograph.simulation.results.reducer import AbstractReducer, OfStep
from heliograph.simulation.simulate import monte_carlo

COMPILED = 16  # structures of networks whose compiled programs are kept


@dataclass(frozen=True)
class Job:
    """A task for one setting: compute a chunk of runs, or, without a chunk, describe labels and claims."""

    setting: int
    chunk: int | None = None


@dataclass(frozen=True)
class Reply:
    """Result of a job: the description, for a job without a chunk, or an error in one line with its traceback.

    `late`: the job was given up, since it took longer than the campaign allows.
    """

    value: NetworkDescription | None = None
    error: str = ""
    traceback: str = ""
    late: bool = False


def perform_job(campaign: str, store: str, setting: int, chunk: int | None) -> Reply:
    """Return the reply to one job of a campaign given as JSON; an error becomes a reply too.

    Args:
        campaign: the campaign as JSON.
        store: path of the store.
        setting: number of the setting.
        chunk: number of the chunk that is computed and written; None to describe the setting's network.
    """
    try:
        plan = parse_campaign(campaign)
        _check_versions(plan)
        network = _build_network(campaign, setting)
        if chunk is None:
            return Reply(describe_network(network))
        compute_chunk(plan, network, plan.chunks(setting)[chunk], Path(store))
        return Reply()
    except Exception as error:
        message = " ".join(str(error).split())
        return Reply(error=f"{type(error).__name__}: {message}", traceback=traceback.format_exc())


def compute_chunk(campaign: Campaign, network: Network, chunk: Chunk, store: Path) -> None:
    """Simulate a chunk of runs of a network, and write their errors into the store.

    Every chunk is simulated at full width, so that the last one of a setting needs no compilation of its own.
    """
    if not store.is_dir():
        raise fail("results folder", f"a folder {store} that this machine sees", "nothing of that name")
    labels = read_labels(store)  # names along the axes of the store
    check_labels_within(restore_labels(describe_network(network)["labels"]), labels, chunk.setting)
    # As many runs as a full chunk has; only the chunk's own are written.
    recorded = monte_carlo(
        network,
        horizon=campaign.horizon,
        runs=campaign.chunk,
        key=campaign.key(chunk.setting),
        keep=ErrorReducer(world=campaign.keep == "trajectories"),
        inputs=make_network_inputs(campaign, network),
        chunk=campaign.chunk,
        first_run=chunk.start,
    )
    arrays = _arrange_results(recorded, labels)
    write_chunk(store, chunk, {name: values[: chunk.stop - chunk.start] for name, values in arrays.items()})


def make_network_inputs(campaign: Campaign, network: Network) -> np.ndarray | None:
    """Return the network's inputs over the campaign's steps, (horizon, inputs), or None if it has no inputs.

    In the campaign an input is a number for all steps, or a list with a number for each step.
    """
    if sorted(campaign.inputs) != sorted(network.inputs):
        raise fail("inputs", f"values of {list(network.inputs)}", list(campaign.inputs))
    if not network.inputs:
        return None
    columns = [np.broadcast_to(np.asarray(campaign.inputs[name], float), campaign.horizon) for name in network.inputs]
    return np.stack(columns, axis=1)


def _check_versions(campaign: Campaign) -> None:
    """Raise ValueError if this worker's packages or settings are not those with which the campaign began.

    Its results would then not be the same to the bit.
    """
    here = collect_versions()
    if here != campaign.versions:
        raise fail("versions on this worker", str(campaign.versions), here)


@lru_cache(maxsize=4)
def _build_network(campaign: str, setting: int) -> Network:
    """Return the network of a setting, built once and kept for the setting's chunks."""
    plan = parse_campaign(campaign)
    network = plan.function()(**plan.settings[setting])
    network.check_horizon(plan.horizon)
    make_network_inputs(plan, network)  # raises where the campaign has other inputs
    _drop_old_programs(network)
    return network


_seen: list[Network] = []  # one network of each structure since compiled programs were last dropped


def _drop_old_programs(network: Network) -> None:
    """Drop all compiled programs if networks of COMPILED (16) other structures came before this one, to bound memory.

    Networks of one structure share their programs. `_seen` holds a network of each structure since the last drop.
    """
    if any(have_same_structure(network, other) for other in _seen):
        return
    if len(_seen) == COMPILED:
        jax.clear_caches()  # type: ignore[no-untyped-call]
        _seen.clear()
    _seen.append(network)


def _arrange_results(recorded: PyTree, labels: AxisLabels) -> dict[str, np.ndarray]:
    """Return the results of `ErrorReducer` by variable of the store, as arrays (run, time, node, filter, ...).

    Where a node has no such filter there is NaN.

    Args:
        recorded: "estimates" by node and filter, with "error", "variance" and "nees_per_dimension" (run, time, ...);
            if whole trajectories are kept, also "truth" and the "measurements" by node.
        labels: names along the axes of the store.
    """
    estimates = recorded["estimates"]
    # Shapes are those of any filter, (run, time, ...): all have the same states.
    example = next(values for filters in estimates.values() for values in filters.values())
    runs, horizon = example["nees_per_dimension"].shape
    axes = (runs, horizon, len(labels.nodes), len(labels.filters))
    arrays = {
        variable: np.full((*axes, *example[variable].shape[2:]), np.nan)
        for variable in ("error", "variance", "nees_per_dimension")
    }
    # Each filter goes to its place along the axes (node, filter).
    for node, filters in estimates.items():
        for name, values in filters.items():
            i, j = labels.nodes.index(node), labels.filters.index(name)
            for variable, array in arrays.items():
                array[:, :, i, j] = values[variable]
    # Of whole trajectories also truth and measurements, each filled up to the longest of any node.
    if "truth" in recorded:
        arrays["truth"] = recorded["truth"]
        arrays["measurement"] = np.full((runs, horizon, len(labels.nodes), labels.received), np.nan)
        for node, z in recorded["measurements"].items():
            arrays["measurement"][:, :, labels.nodes.index(node), : z.shape[-1]] = z
    return arrays


class ErrorReducer(AbstractReducer[dict[str, PyTree]]):
    """Reducer to each run's errors, claimed variances and NEES per dimension; with `world` also truth and measurements.

    The result is a dictionary: "estimates" by node and filter, each with error and variance (run, time, n) and
    nees_per_dimension = e' P^-1 e / n (run, time); "truth" (run, time, n); "measurements" by node.
    """

    world: bool = eqx.field(static=True, default=False)

    def of_step(self, step: PyTree) -> OfStep:
        """Return the errors of each estimate in one step, and with `self.world` also the truth and the measurements.

        `step` holds the true state ("truth"), the measurements, and trees of the nodes' estimates and of fused ones.
        """

        def is_estimate(leaf: object) -> bool:
            """Return whether a leaf is an estimate, which is measured as a whole."""
            return isinstance(leaf, Estimate)

        measure = partial(_measure_errors, step["truth"])
        collected = {kind: jax.tree.map(measure, step[kind], is_leaf=is_estimate) for kind in ("estimates", "fused")}
        if self.world:
            collected |= {name: step[name] for name in ("truth", "measurements")}
        return OfStep(collected=collected)

    def finish(self, carry: PyTree, collected: PyTree, network: Network) -> dict[str, PyTree]:
        """Return the collected errors by node and filter, and with `self.world` also truth and measurements.

        Args:
            carry: what is carried from step to step; nothing here.
            collected: what `of_step` returned, of all steps. Errors have the axes (..., filter, node, state), so that
                filters are axis -3; NEES has no axis of states.
            network: the network, which has the names.
        """
        results = {
            field: self.split_by_name(network, collected, itemgetter(field), axis)
            for field, axis in (("error", -3), ("variance", -3), ("nees_per_dimension", -2))
        }
        estimates = {
            node: {name: {field: values[node][name] for field, values in results.items()} for name in names}
            for node, names in network.claims().items()
        }
        if not self.world:
            return {"estimates": estimates}
        measurements = self.split_measurements(network, collected["measurements"])
        return {"estimates": estimates, "truth": collected["truth"], "measurements": measurements}


def _measure_errors(truth: jax.Array, estimate: Estimate) -> dict[str, jax.Array]:
    """Return an estimate's error (..., n), its claimed variances (..., n) and its NEES per state (...).

    The NEES per state is e' P^-1 e / n with the error e and the claimed covariance P.
    """
    error, covariance = estimate.error(truth), jnp.asarray(estimate.covariance)
    variance = jnp.broadcast_to(jnp.diagonal(covariance, axis1=-2, axis2=-1), error.shape)
    nees = jnp.vectorize(squared_distance, signature="(n,n),(n)->()")(covariance, error)
    return {"error": error, "variance": variance, "nees_per_dimension": nees / len(truth)}
