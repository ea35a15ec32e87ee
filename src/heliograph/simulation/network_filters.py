"""One step of a whole network's filters, under the scan over time."""

from collections.abc import Collection, Mapping, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.filters.base import AbstractFilter
from heliograph.filters.linear.precomputed_filter import LinearStep
from heliograph.filters.smoother_step import gaussian_of
from heliograph.fusion.network_fusion import Fusion
from heliograph.model.estimate import Estimate
from heliograph.numerics.check import fail, instance, text
from heliograph.numerics.module import Module
from heliograph.numerics.types import PyTree
from heliograph.simulation.centres.centre_filter import CentreFilter
from heliograph.simulation.centres.fused_innovation import FusedInnovation, following_prior, make_fused_innovations
from heliograph.simulation.centres.fusion_centre import CentreState, FusionCentre
from heliograph.simulation.centres.fusions import (
    ReportFusion,
    StackedFusions,
    build_centre_filter,
    build_report_fusions,
    list_centres,
    list_stacked_fusions,
)
from heliograph.simulation.centres.linearised_centre import LinearisedCentre, LinearisedFusionState
from heliograph.simulation.mesh.building import build_meshes
from heliograph.simulation.mesh.mesh import Mesh
from heliograph.simulation.network import Network
from heliograph.simulation.network_index import find_measurement_order
from heliograph.simulation.runs.stacked_filters import (
    StackedFilters,
    StepOutput,
    filter_step,
    initial_state,
    stack_filters,
)


class AllFilters(Module):
    """Every filter of a network: those of the nodes by stack, fusion rules, informed centres, central filters.

    A group holds the nodes that differ in numbers alone; a stack holds, of one group, the filters that differ so.

    Fields:
        stacks: the nodes' filters, those of one structure stacked.
        fusions: of the nodes' estimates by rules that know nothing of the nodes.
        centres: of the informed fusions, which know how the nodes' errors are correlated; one for each filter fused so.
        reporting: fusions by reports over uplinks, by name.
        meshes: fusions between neighbours, by name.
        tests: of fused estimates by what arrives after them, by name.
        central: filters of all nodes' measurements at once, by name.
        order: brings the groups' measurements, joined, into the order of the nodes; None where they are in it.
        complete: of each group, whether nothing of its measurements is ever missing.
        n: number of the plant's states.
        smooths: central filters return smoother steps, as do those of the stacks that do.
        judges: filters judge their data.
    """

    stacks: tuple[StackedFilters, ...]
    fusions: tuple[StackedFusions, ...]
    centres: tuple[FusionCentre | LinearisedCentre, ...]
    reporting: dict[str, ReportFusion]
    meshes: dict[str, Mesh]
    tests: dict[str, FusedInnovation]
    central: dict[str, AbstractFilter]
    order: np.ndarray | None
    complete: tuple[bool, ...] = eqx.field(static=True)
    n: int = eqx.field(static=True)
    smooths: bool = eqx.field(static=True)
    judges: bool = eqx.field(static=True)

    def __init__(
        self,
        network: Network,
        smoothed_stacks: Collection[int] | None = None,
        judges: bool = False,
        tests: bool = False,
    ):
        """Stack the filters of a network that differ in numbers alone, and build its fusions.

        Args:
            network: the network.
            smoothed_stacks: numbers of the stacks of filters to be smoothed, with all central filters; None if nothing
                is.
            judges: whether filters test if their measurements are plausible, and leave out others on request.
            tests: whether fused estimates are tested: if what arrives at the next step is as they predict.
        """
        self.smooths, self.judges = smoothed_stacks is not None, judges
        self.stacks = stack_filters(network, smoothed_stacks or (), judges)
        # At the centre: filters of all measurements; fusions by rules that need nothing but the estimates; fusions that
        # need the joint covariance of the nodes' errors.
        self.central = {name: fusion for name, fusion in network.fused.items() if isinstance(fusion, AbstractFilter)}
        self.fusions, self.centres = list_stacked_fusions(network), list_centres(network)
        # Fusions of reports over uplinks: each centre steps the nodes' filters itself, without data, for the moments of
        # their errors, and makes these filters by this class. Then fusions between neighbours.
        self.reporting = build_report_fusions(network, AllFilters)
        self.meshes = build_meshes(network)
        self.tests = make_fused_innovations(network, self.stacks) if tests else {}
        self.order = find_measurement_order(network.groups, network.rows)
        self.complete = tuple(all(network.nodes[name].counts_all for name in names) for names in network.groups)
        self.n = len(network.states)

    def init(self) -> PyTree:
        """Return the states before the first step, as a tuple of six entries.

        They are the states of: the nodes' filters, by stack; filters of all measurements, by name; quantizers of the
        nodes' estimates, by stack of fusions; centres that propagate the joint covariance of the nodes' errors; fusions
        of reports and between neighbours, by name; and fused estimates that are tested.
        """
        central = {name: initial_state(filter) for name, filter in self.central.items()}
        states = tuple(stacked.init() for stacked in self.stacks)
        quantizers = tuple(fusion.init(self.n) for fusion in self.fusions)
        exchanges: dict[str, PyTree] = {name: fusion.init() for name, fusion in self.reporting.items()}
        exchanges |= {name: mesh.init() for name, mesh in self.meshes.items()}
        tested = {name: test.start for name, test in self.tests.items()}
        centres = tuple(self._init_centre(centre, states) for centre in self.centres)
        return states, central, quantizers, centres, exchanges, tested

    def _init_centre(
        self, centre: FusionCentre | LinearisedCentre, states: Sequence[PyTree]
    ) -> CentreState | dict[str, LinearisedFusionState]:
        """Return a centre's state before the first step, from the initial means of the filters that it fuses.

        `states`: of the nodes' filters by stack. `centre.sources`: (stack, number within the stack) of what it fuses.
        """
        means = []
        for stack, number in centre.sources:
            # The rows of a stack are (filter and node), filter after filter.
            means_by_filter = gaussian_of(states[stack]).mean.reshape(self.stacks[stack].count, -1, self.n)
            means.append(means_by_filter[number])
        return centre.init(means)

    @property
    def are_linear_and_unfused(self) -> bool:
        """Whether all filters are linear with gains that depend on no data, and none of their estimates is fused."""
        are_fused = bool(self.fusions or self.centres or self.reporting or self.meshes)
        filters = [*(stacked.filters for stacked in self.stacks), *self.central.values()]
        return not are_fused and all(filter.is_linear for filter in filters)

    @property
    def linear_centres(self) -> tuple[FusionCentre, ...]:
        """Informed centres of filters whose gains do not depend on data."""
        return tuple(centre for centre in self.centres if isinstance(centre, FusionCentre))

    def list_step_matrices(self, centre: FusionCentre, states: PyTree, u: jax.Array, k: jax.Array) -> list[LinearStep]:
        """Return the matrices of step k of the filters that a centre fuses, one entry for each of its sources.

        `states`: states of the nodes' filters by stack, before the step. The matrices depend on covariances alone, so
        the measurements are set to zero.
        """
        matrices = []
        for stack, number in centre.sources:  # number of the filter within the stack
            stacked, zeros = self.stacks[stack], self._make_zeros(stack)
            matrices.append(stacked.compute_by_node(centre.compute_matrices, states[stack], number, zeros, u, k))
        return matrices

    def step_without_data(self, states: PyTree, u: jax.Array, k: jax.Array) -> PyTree:
        """Return the filters' states, by stack, after step k with measurements of zero, for their gains."""
        numbered = enumerate(zip(self.stacks, states, strict=True))
        return tuple(stacked.step(state, self._make_zeros(stack), u, k)[0] for stack, (stacked, state) in numbered)

    def _make_zeros(self, stack: int) -> jax.Array:
        """Return measurements (node, received) of zero for the nodes of a stack."""
        return jnp.zeros((self.stacks[stack].nodes, self.stacks[stack].filters.received))

    def step(
        self,
        states: PyTree,
        z: Sequence[jax.Array],
        u: jax.Array,
        k: jax.Array,
        drawn: Mapping[str, PyTree] | None = None,
        skip: tuple[Sequence[jax.Array], Mapping[str, jax.Array]] | None = None,
    ) -> tuple[PyTree, dict[str, PyTree]]:
        """Step all filters and fusions of the network over step k.

        Args:
            states: of all filters and fusions before the step, as `init` returns them.
            z: measurements (node, received) by group of nodes, NaN where one is missing.
            u: inputs of the plant over the step.
            k: number of the step.
            drawn: what the uplinks and the links between neighbours do, by fusion; without, nothing is lost.
            skip: reasons not to use data, codes of `Reason`: (filter, node) by stack, and by name of central filters.

        Returns:
            The states after the step, and its outputs: "estimates" by stack, (filter, node, ...), then those between
            neighbours; "fused" by name; "uplinks" of fusions with quantizers, and "reports" with their delays by
            fusion, as the nodes send them; where filters smooth, their "smoother_steps" by stack and "central_steps" by
            name; where they judge, "judged" and "weighed" by stack, "judged_centrally" and "weighed_centrally" by name,
            and "tested", the squared innovations of fused estimates by name.
        """
        filter_states, central, quantizer_states, centre_states, exchange_states, tested = states
        reasons: Sequence[jax.Array | None] = [None] * len(filter_states)
        central_reasons: Mapping[str, jax.Array] = {}
        if skip is not None:
            reasons, central_reasons = skip
        # The nodes' filters, and central ones on all measurements in the order of the nodes.
        stepped = [
            stacked.step(state, z[stacked.group], u, k, reason)
            for stacked, state, reason in zip(self.stacks, filter_states, reasons, strict=True)
        ]
        stepped_centrally = self._step_central_filters(central, z, u, k, central_reasons)
        # Fusions of the nodes' estimates.
        estimates = tuple(output.estimate for _, output in stepped)
        following, of_fusions = self._step_fusions(
            (filter_states, quantizer_states, centre_states, exchange_states), z, estimates, u, k, drawn or {}
        )
        fused_centrally = {name: output.estimate for name, (_, output) in stepped_centrally.items()}
        fused = fused_centrally | of_fusions.fused
        outputs: dict[str, PyTree] = {
            "estimates": (*estimates, *of_fusions.between_neighbours),
            "fused": fused,
            "uplinks": of_fusions.uplinks,
            "reports": of_fusions.reports,
        }
        # What arrived now tests the fused estimates of the last step; those of this step are tested at the next.
        distances = {
            name: test.step(tested[name], self.stacks, filter_states, z, u, k, reasons)
            for name, test in self.tests.items()
        }
        tested_next = {name: following_prior(fused[name]) for name in self.tests}
        if self.judges:
            outputs["tested"] = distances
        # What else the filters' steps put out, under one name of the nodes' filters and another of central ones.
        for field, of_nodes, centrally in self._list_details():
            outputs[of_nodes] = tuple(getattr(output, field) for _, output in stepped)
            outputs[centrally] = {name: getattr(output, field) for name, (_, output) in stepped_centrally.items()}
        central_after = {name: state for name, (state, _) in stepped_centrally.items()}
        return (tuple(state for state, _ in stepped), central_after, *following, tested_next), outputs

    def _step_central_filters(
        self,
        states: Mapping[str, PyTree],
        z: Sequence[jax.Array],
        u: jax.Array,
        k: jax.Array,
        skip: Mapping[str, jax.Array],
    ) -> dict[str, tuple[PyTree, StepOutput]]:
        """Return the next state and the output of each central filter, by name, on the measurements of all nodes.

        `states`: before the step, by name. `z`: measurements (node, received) by group of nodes. `u`, `k`: inputs of
        the plant over the step, and its number. `skip`: codes of reasons not to use the measurements, by name.
        """
        z_in_order = jnp.concatenate([jnp.ravel(values) for values in z])  # group after group
        z_in_order = z_in_order if self.order is None else z_in_order[self.order]  # node after node
        return {
            name: filter_step(filter, states[name], z_in_order, u, k, self.smooths, self.judges, skip.get(name))
            for name, filter in self.central.items()
        }

    def _list_details(self) -> list[tuple[str, str, str]]:
        """Return which results of a step there are beside estimates: for smoothing, and judgements of measurements.

        An entry is (field of `StepOutput`, name of the output for the nodes' filters, name for central filters).
        """
        for_smoothing = [("steps", "smoother_steps", "central_steps")]
        judgements = [("judgement", "judged", "judged_centrally"), ("weighed", "weighed", "weighed_centrally")]
        return (for_smoothing if self.smooths else []) + (judgements if self.judges else [])

    def _step_fusions(
        self,
        states: tuple[PyTree, ...],
        z: Sequence[jax.Array],
        estimates: tuple[Estimate, ...],
        u: jax.Array,
        k: jax.Array,
        drawn: Mapping[str, PyTree],
    ) -> tuple[tuple[PyTree, ...], "FusionOutputs"]:
        """Step all fusions with the estimates of the nodes' filters of this step.

        Args:
            states: before the step, of the nodes' filters, quantizers, informed centres and exchanges of messages.
            z: measurements (node, received) by group of nodes.
            estimates: of the nodes' filters by stack, (filter, node, ...).
            u: inputs of the plant over the step.
            k: number of the step.
            drawn: what the uplinks and the links between neighbours do, by fusion; without, nothing is lost.

        Returns:
            The states after the step of quantizers, centres and exchanges, and what the fusions put out.
        """
        filter_states, quantizer_states, centre_states, exchange_states = states
        fused, uplinks, reports, exchanges_after = (dict[str, PyTree]() for _ in range(4))
        # Rules that know nothing of the nodes, on estimates through the nodes' quantizers.
        quantizers_after, centres_after = list[PyTree](), list[PyTree]()
        for fusion, state in zip(self.fusions, quantizer_states, strict=True):
            following, outcome, traffic = fusion.step(state, estimates, k)
            quantizers_after.append(following)
            fused |= outcome
            uplinks |= traffic
        # Informed centres, which propagate the joint moments of the errors.
        for centre, state in zip(self.centres, centre_states, strict=True):
            following, outcome = self._step_centre(centre, state, filter_states, z, estimates, u, k)
            centres_after.append(following)
            fused |= outcome
        # Centres with reports over uplinks.
        for name, by_report in self.reporting.items():
            draws = drawn[name] if name in drawn else by_report.uplinks.lossless()
            exchanges_after[name], fused[name], traffic, reports[name] = by_report.step(
                exchange_states[name], estimates, draws, u, k
            )
            uplinks |= {name: traffic} if traffic else {}
        # Fusions between neighbours, which have an estimate at each node.
        between_neighbours = list[Estimate]()
        for name, mesh in sorted(self.meshes.items()):
            # What is drawn: flags of what arrives, or a pair of these and of weights that were computed before.
            arrivals = drawn[name] if name in drawn else mesh.edges.lossless()
            flags, weights = arrivals if isinstance(arrivals, tuple) else (arrivals, ())
            exchanges_after[name], node_estimates = mesh.step(
                exchange_states[name], z, jnp.asarray(flags), u, k, precomputed=weights
            )
            between_neighbours.extend(node_estimates)
            reports[name] = flags, jnp.zeros(())  # no delays beside the flags, which hold them where there are any
        outputs = FusionOutputs(tuple(between_neighbours), fused, uplinks, reports)
        return (tuple(quantizers_after), tuple(centres_after), exchanges_after), outputs

    def _step_centre(
        self,
        centre: FusionCentre | LinearisedCentre,
        state: PyTree,
        states: PyTree,
        z: Sequence[jax.Array],
        estimates: Sequence[Estimate],
        u: jax.Array,
        k: jax.Array,
    ) -> tuple[PyTree, dict[str, Estimate]]:
        """Step a centre: return its next state, and the nodes' estimates fused by the joint covariance of their errors.

        Args:
            centre: knows the joint covariance; `sources`: (stack, number in it) of its filters.
            state: state of the centre before the step.
            states: states of the nodes' filters by stack before the step, from which their steps' matrices follow.
            z: measurements (node, received) by group of nodes.
            estimates: estimates of the nodes' filters by stack after the step, (filter, node, ...).
            u, k: inputs of the plant over the step, and its number.
        """
        matrices = []
        for stack, number in centre.sources:
            stacked = self.stacks[stack]
            matrices.append(
                stacked.compute_by_node(centre.compute_matrices, states[stack], number, z[stacked.group], u, k)
            )
        means = [jnp.asarray(estimates[stack].mean)[number] for stack, number in centre.sources]
        return centre.step(state, matrices, means, u, k)


class FusionOutputs(NamedTuple):
    """What the fusions of a network put out at a step; each is empty where there is none of its kind.

    Args:
        between_neighbours: estimates (1, node, ...) by group of nodes, of each such fusion in the order of their names.
        fused: estimates of all others, by name.
        uplinks: what the nodes' quantizers sent, by name.
        reports: which reports arrived and their delays, by name.
    """

    between_neighbours: tuple[Estimate, ...]
    fused: dict[str, PyTree]
    uplinks: dict[str, PyTree]
    reports: dict[str, PyTree]


@compile_on_call
def initial_states(filters: AllFilters) -> PyTree:
    """Return the states before the first step, computed by one program instead of one for each operation."""
    return jax.tree.map(jnp.asarray, filters.init())


def centre_filter(network: Network, name: str) -> CentreFilter:
    """Return the filter of the centre that fuses all nodes' reports, for the fusion `name` by `AllReports`.

    Each node's filter sends its estimate as a report. The measurement joins the reports of this step, node after node
    in the network's order; if links may be late, those of the step before follow, and so on. Numbers that did not
    arrive are NaN. A quantizer enters by the bound on its error. The claim of its covariance is the fusion's.

    Args:
        network: the network.
        name: name of its fusion.

    Raises:
        ValueError: no fusion of this name, or one by another rule; nodes that lose measurements, since their reports
            do not say which measurements arrived.

    Source: the best linear receiver behind relays that filter and forward; the relays are the nodes' filters.
    """
    instance("network", network, Network, "a Network")
    text("fusion", name)
    fusion = network.fused.get(name)
    if not isinstance(fusion, Fusion) or not fusion.rule.uses_reports:
        by_reports = [
            label for label, other in network.fused.items() if isinstance(other, Fusion) and other.rule.uses_reports
        ]
        raise fail("fusion", f"one of {by_reports}, which receive reports", repr(name))
    return build_centre_filter(network, name, fusion, AllFilters)
