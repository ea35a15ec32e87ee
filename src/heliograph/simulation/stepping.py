"""One step of a whole network's filters, under the scan over time."""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.filters.base import AbstractFilter, make_sizes
from heliograph.filters.linear.plan import LinearStep
from heliograph.filters.smoother_step import gaussian_of
from heliograph.fusion.all_reports import AllReports
from heliograph.fusion.network_fusion import Fusion
from heliograph.model.estimate import Estimate
from heliograph.model.over_time import stack
from heliograph.model.sensor import without_output_names
from heliograph.numerics.check import fail, instance, text
from heliograph.numerics.module import Module
from heliograph.numerics.types import PyTree
from heliograph.simulation.centres.centre import (
    CentreFilter,
    CentreState,
    FusionCentre,
    claim_of_reports,
)
from heliograph.simulation.centres.fused_innovation import FusedInnovation, following_prior, make_fused_innovations
from heliograph.simulation.centres.fusions import (
    ReportFusion,
    StackedFusions,
    centres_of,
    find_source_filters,
    list_stacked_fusions,
)
from heliograph.simulation.centres.linearised import FollowedFusion, LinearisedCentre
from heliograph.simulation.centres.mesh import Mesh
from heliograph.simulation.centres.mesh_building import build_meshes
from heliograph.simulation.centres.uplinks import uplinks_of
from heliograph.simulation.network import FUSED, Network
from heliograph.simulation.node import Node, ReceivingNode
from heliograph.simulation.runs.side_by_side import StackedFilters, filter_step, initial_state


class AllFilters(Module):
    """Every filter of a network: those of the nodes by kind, fusion rules, informed centres, central filters.

    `order` brings the groups' measurements, joined, into the order of the nodes. `smooths`: central filters return
    smoother steps, as do those of the kinds that do.
    """

    alike: tuple[StackedFilters, ...]
    fusions: tuple[StackedFusions, ...]
    centres: tuple[FusionCentre | LinearisedCentre, ...]
    reporting: dict[str, ReportFusion]
    meshes: dict[str, Mesh]
    tests: dict[str, FusedInnovation]
    central: dict[str, AbstractFilter]
    order: np.ndarray | None
    complete: tuple[bool, ...] = eqx.field(static=True)  # of each group: nothing is ever missing
    n: int = eqx.field(static=True)
    smooths: bool = eqx.field(static=True)
    judges: bool = eqx.field(static=True)

    def __init__(
        self,
        network: Network,
        smoothed_groups: Collection[int] | None = None,
        judges: bool = False,
        tests: bool = False,
    ):
        """Stack the filters of a network by structure.

        `smoothed_groups`: which kinds are to be smoothed, and the central filters with them; None if nothing is.
        `judges`: filters judge their data, and skip implausible data on request. `tests`: fused estimates are tested by
        what arrives at the next step.
        """
        self.smooths, self.judges = smoothed_groups is not None, judges
        alike = []
        for number, kind in enumerate(network.kinds):
            nodes = network.groups[kind.group]
            filters = [without_output_names(network.nodes[node].filters[f]) for f in kind.filters for node in nodes]
            alike.append(
                StackedFilters(
                    filters=stack(filters),
                    group=kind.group,
                    count=len(kind.filters),
                    nodes=len(nodes),
                    smooths=smoothed_groups is not None and number in smoothed_groups,
                    judges=judges,
                )
            )
        self.alike = tuple(alike)
        # Central filters, fusions, informed centres, centres with reports.
        self.central = {name: fusion for name, fusion in network.fused.items() if isinstance(fusion, AbstractFilter)}
        self.fusions, self.centres = list_stacked_fusions(network), centres_of(network)
        self.reporting, self.meshes = _make_report_fusions(network), build_meshes(network)
        self.tests = make_fused_innovations(network, self.alike) if tests else {}
        # Permutation of the groups' measurements into the order of the nodes.
        grouped = [name for names in network.groups for name in names]
        lengths = [network.nodes[name].received for name in grouped]
        entries = dict(zip(grouped, np.split(np.arange(sum(lengths)), np.cumsum(lengths)[:-1]), strict=True))
        self.order = _unless_sorted(np.concatenate([entries[name] for name in network.names]))
        self.complete = tuple(network.nodes[names[0]].complete for names in network.groups)
        self.n = len(network.states)

    def init(self) -> PyTree:
        """Return states before the first step: of filters, central ones, quantizers, centres, reports, tests."""
        central = {name: initial_state(filter) for name, filter in self.central.items()}
        states = tuple(stacked.init() for stacked in self.alike)
        sent = tuple(fusion.init(self.n) for fusion in self.fusions)
        reporting: dict[str, PyTree] = {name: link.init() for name, link in self.reporting.items()}
        reporting |= {name: mesh.init() for name, mesh in self.meshes.items()}
        tested = {name: test.start for name, test in self.tests.items()}
        return (
            states,
            central,
            sent,
            tuple(self._init_centre(centre, states) for centre in self.centres),
            reporting,
            tested,
        )

    def _init_centre(
        self, centre: FusionCentre | LinearisedCentre, states: Sequence[PyTree]
    ) -> CentreState | dict[str, FollowedFusion]:
        """Return the state in which a centre begins, from the first means of the filters whose estimates it fuses.

        Those of one kind are stacked, (filter, node, n), of which a source takes filter number f.
        """
        sources = [(gaussian_of(states[kind]), self.alike[kind].count, f) for kind, f in centre.sources]
        return centre.init([x.mean.reshape(count, -1, self.n)[f] for x, count, f in sources])

    @property
    def are_linear(self) -> bool:
        """Whether no filter's gain depends on data, and nothing is fused."""
        filters = [*(stacked.filters for stacked in self.alike), *self.central.values()]
        fuses = self.fusions or self.centres or self.reporting or self.meshes
        return not fuses and all(filter.is_linear for filter in filters)

    @property
    def informed(self) -> tuple[FusionCentre, ...]:
        """Centres of filters whose gains do not depend on data."""
        return tuple(centre for centre in self.centres if isinstance(centre, FusionCentre))

    def matrices(self, centre: FusionCentre, states: PyTree, u: jax.Array, k: jax.Array) -> list[LinearStep]:
        """Return the matrices of a centre's sources at step k; they depend on covariances alone, so z may be zero."""
        sources = [(self.alike[kind], states[kind], f, self._make_zeros(kind)) for kind, f in centre.sources]
        return [alike.matrices(centre.read, state, f, zeros, u, k) for alike, state, f, zeros in sources]

    def followed(self, states: PyTree, u: jax.Array, k: jax.Array) -> PyTree:
        """Return the states of the nodes' filters after step k, for measurements of zero."""
        kinds = enumerate(zip(self.alike, states, strict=True))
        return tuple(alike.step(state, self._make_zeros(kind), u, k)[0] for kind, (alike, state) in kinds)

    def _make_zeros(self, kind: int) -> jax.Array:
        """Return measurements (node, received) of zero for the nodes of a kind."""
        return jnp.zeros((self.alike[kind].nodes, self.alike[kind].filters.received))

    def step(
        self,
        states: PyTree,
        z: Sequence[jax.Array],
        u: jax.Array,
        k: jax.Array,
        drawn: Mapping[str, PyTree] | None = None,
        skip: tuple[Sequence[jax.Array], Mapping[str, jax.Array]] | None = None,
    ) -> tuple[PyTree, dict[str, PyTree]]:
        """Step all filters with the measurements z of each group (node, received), and inputs u, over step k.

        Args:
            states: of all filters and fusions, as `init` returns them.
            z: measurements by group of nodes.
            u: inputs of the plant over the step.
            k: number of the step.
            drawn: what was drawn of the uplinks and links between neighbours, by fusion; without, nothing is lost.
            skip: reasons not to use data, of each kind and by name of central filters, in the form of judgements.

        Returns:
            The states after the step, and its outputs: "estimates" by kind, (filter, node, ...), then those between
            neighbours; "fused" by name; "uplinks" of fusions with quantizers, and "reports" with their delays by
            fusion, as the nodes send them; where filters smooth, their "smoother_steps" by kind and "central_steps" by
            name; where they judge, "judged" and "weighed" by kind, "judged_centrally" and "weighed_centrally" by name,
            and "tested", the squared innovations of fused estimates by name.
        """
        filter_states, central, quantizer_states, centre_states, reporting, tested = states
        # The nodes' filters, and central ones on all measurements in the order of the nodes.
        reasons = [None] * len(filter_states) if skip is None else skip[0]
        central_reasons = {} if skip is None else skip[1]
        stepped = [
            stacked.step(state, z[stacked.group], u, k, reason)
            for stacked, state, reason in zip(self.alike, filter_states, reasons, strict=True)
        ]
        joined = jnp.concatenate([jnp.ravel(values) for values in z])
        joined = joined if self.order is None else joined[self.order]
        stepped_centrally = {
            name: filter_step(filter, central[name], joined, u, k, self.smooths, self.judges, central_reasons.get(name))
            for name, filter in self.central.items()
        }
        # Fusions of the nodes' estimates.
        estimates = tuple(output.estimate for _, output in stepped)
        following, of_fusions = self._step_fusions(
            (filter_states, quantizer_states, centre_states, reporting), z, estimates, u, k, drawn or {}
        )
        fused = {name: output.estimate for name, (_, output) in stepped_centrally.items()} | of_fusions.fused
        outputs: dict[str, PyTree] = {
            "estimates": (*estimates, *of_fusions.between_neighbours),
            "fused": fused,
            "uplinks": of_fusions.uplinks,
            "reports": of_fusions.reports,
        }
        # Tests of fused estimates, by what arrived after the last of them.
        distances = {
            name: test.step(tested[name], self.alike, filter_states, z, u, k, reasons)
            for name, test in self.tests.items()
        }
        tested = {name: following_prior(fused[name]) for name in self.tests}
        if self.judges:
            outputs["tested"] = distances
        for field, of_nodes, centrally in self._list_details():
            outputs[of_nodes] = tuple(getattr(output, field) for _, output in stepped)
            outputs[centrally] = {name: getattr(output, field) for name, (_, output) in stepped_centrally.items()}
        central = {name: state for name, (state, _) in stepped_centrally.items()}
        return (tuple(state for state, _ in stepped), central, *following, tested), outputs

    def _list_details(self) -> list[tuple[str, str, str]]:
        """Return further fields of each filter's step, with their names among the outputs of nodes and central ones."""
        judged = [("judgement", "judged", "judged_centrally"), ("weighed", "weighed", "weighed_centrally")]
        steps = [("steps", "smoother_steps", "central_steps")]
        return (steps if self.smooths else []) + (judged if self.judges else [])

    def _step_fusions(
        self,
        states: tuple[PyTree, ...],
        z: Sequence[jax.Array],
        estimates: tuple[Estimate, ...],
        u: jax.Array,
        k: jax.Array,
        drawn: Mapping[str, PyTree],
    ) -> tuple[tuple[PyTree, ...], "FusionOutputs"]:
        """Step all fusions with the nodes' `estimates` of this step.

        `states`, before the step: of the nodes' filters, quantizers, centres and reports. Returns those of the last
        three after the step, and what the fusions put out: nothing where there are none.
        """
        filter_states, quantizer_states, centre_states, reporting = states
        fused, uplinks, reports, links_after = (dict[str, PyTree]() for _ in range(4))
        # Rules, through their quantizers.
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
        for name, link in self.reporting.items():
            arrivals = drawn[name] if name in drawn else link.uplinks.undrawn()
            links_after[name], fused[name], traffic, reports[name] = link.step(
                reporting[name], estimates, arrivals, u, k
            )
            uplinks |= {name: traffic} if traffic else {}
        # Fusions between neighbours, which have an estimate at each node.
        between_neighbours = list[Estimate]()
        for name, mesh in sorted(self.meshes.items()):
            arrivals = drawn[name] if name in drawn else mesh.edges.lossless()  # within a process nothing is lost
            flags, ahead = arrivals if isinstance(arrivals, tuple) else (arrivals, ())
            links_after[name], of_mesh = mesh.step(reporting[name], z, jnp.asarray(flags), u, k, ahead)
            between_neighbours.extend(of_mesh)
            reports[name] = flags, jnp.zeros(())
        outputs = FusionOutputs(tuple(between_neighbours), fused, uplinks, reports)
        return (tuple(quantizers_after), tuple(centres_after), links_after), outputs

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
        """Step a centre with the estimates of its sources' filters, and with the matrices of their steps.

        `states`: of the filters before the step, from which the matrices follow.
        """
        matrices = []
        for kind, f in centre.sources:
            alike = self.alike[kind]
            matrices.append(alike.matrices(centre.read, states[kind], f, z[alike.group], u, k))
        means = [jnp.asarray(estimates[kind].mean)[f] for kind, f in centre.sources]
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


def _make_report_fusions(network: Network) -> dict[str, ReportFusion]:
    """Return the fusions by reports, each with its uplinks and its centre."""
    results = {}
    for name, fusion in network.fused.items():
        if isinstance(fusion, Fusion) and fusion.by_report:
            centre = centre_filter(network, name)
            nodes = network.nodes_with(fusion.filter)
            sources, order = find_source_filters(network, network.places, nodes, fusion.filter)
            uplinks = uplinks_of(fusion, nodes, len(network.states))
            results[name] = ReportFusion(uplinks, centre, order, sources, tuple(nodes))
    return results


def centre_filter(network: Network, name: str) -> CentreFilter:
    """Return the filter of the fusion centre for the fusion `name` of `network`, by `AllReports`, on nodes' reports.

    The measurement is, joined: of each node in the network's order what arrives of the report of this step, then of
    that of the step before if links may be a step late, and so on; NaN for what did not arrive. A quantizer enters by
    the bound on its error. Claim: as the fusion's.

    Args:
        network: the network.
        name: of its fusion.

    Raises:
        ValueError: no fusion of this name, or one by another rule; nodes that lose measurements, since their reports
            do not say which arrived.

    Source: the best linear receiver behind relays that filter and forward; the relays are the nodes' filters.
    """
    instance("network", network, Network, "a Network")
    text("fusion", name)
    fusion = network.fused.get(name)
    if not isinstance(fusion, Fusion) or not fusion.rule.uses_reports:
        by_reports = [n for n, f in network.fused.items() if isinstance(f, Fusion) and f.rule.uses_reports]
        raise fail("fusion", f"one of {by_reports}, which receive reports", repr(name))
    # The nodes with that filter alone, for the moments of its errors.
    names = network.nodes_with(fusion.filter)
    complete = {node: network.nodes[node].complete for node in names}
    claim = claim_of_reports(type(fusion.rule).__name__, network.claims()[FUSED][name], fusion, complete)
    alone = Network(
        network.plant,
        {node: _keep_one_filter(network.nodes[node], fusion.filter) for node in network.names},
        {"all": Fusion(fusion.filter, AllReports())},
        network.relays,
        network.common,
    )
    uplinks = uplinks_of(fusion, names, len(network.states))
    return CentreFilter(
        filters=AllFilters(alone),
        links=uplinks.links,
        rows=tuple(uplinks.rows.tolist()),
        ages=uplinks.delay.shape[1],
        widest=max(uplinks.received),
        quantized=uplinks.quantizers is not None,
        **make_sizes(claim, network, len(uplinks.rows)),
    )


def _keep_one_filter(node: Node | ReceivingNode, name: str) -> Node | ReceivingNode:
    """Return a node with one of its filters, or with none if it has none of this name."""
    filters = {label: filter for label, filter in node.filters.items() if label == name}
    if isinstance(node, Node):
        return Node(node.sensor, node.channel, filters)
    return replace(node, filters=filters)


def _unless_sorted(order: np.ndarray) -> np.ndarray | None:
    """Return an order, None for 0, 1, 2, ...: no gather is compiled then."""
    return None if np.array_equal(order, np.arange(len(order))) else order
