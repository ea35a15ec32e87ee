"""Filters of one kind run side by side: stacked along axes of filters and nodes, vmapped, under the scan over time."""

from collections.abc import Callable, Collection, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any, NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import PyTree

from heliograph.filters.base import AbstractFilter
from heliograph.filters.plan import Plan
from heliograph.filters.retained import AbstractRetained
from heliograph.fusion.all_reports import AllReports
from heliograph.fusion.informed import AbstractInformedFusion
from heliograph.fusion.quantizer import widen
from heliograph.fusion.rules import AbstractFusion, Fusion
from heliograph.model.estimate import Claim, Estimate
from heliograph.model.over_time import at, first, stack, structure
from heliograph.numerics.angle import Angles, nearest, wrapped
from heliograph.numerics.check import fail
from heliograph.numerics.compiler import large_program
from heliograph.numerics.float64 import to_numpy
from heliograph.numerics.types import Array, Float
from heliograph.simulation.centre import (
    AbstractHears,
    Apart,
    Centre,
    CentreState,
    Together,
    along_estimates,
    described,
    listening,
)
from heliograph.simulation.hearing import CentreFilter
from heliograph.simulation.linearised import Followed, LinearisedCentre
from heliograph.simulation.network import FUSED, Network
from heliograph.simulation.node import Listener, Node
from heliograph.simulation.uplinks import Drawn, Flying, Uplinks, uplinks_of
from heliograph.smoothing.sweep import planned_with_past


class Told(NamedTuple):
    """What a filter tells of a step: its estimate, and what it retains of the step if that is asked for."""

    estimate: Estimate
    retained: AbstractRetained | None


def _step(
    item: AbstractFilter, state: PyTree, z: jax.Array, u: jax.Array, k: jax.Array, retains: bool
) -> tuple[PyTree, Told]:
    if not retains:
        after, estimate = item.step(state, z, u, k)
        return after, Told(estimate, None)
    after, retained = item.step_retained(state, z, u, k)
    return after, Told(item.after_step(after, k), retained)


class Alike(eqx.Module):
    """Filters that differ in numbers alone, stacked along one axis, node after node for each of them.

    `group`: of nodes that they belong to; `count` of filters at each of `nodes` nodes. `retains`: each step tells what
    a sweep back over it needs.
    """

    filters: AbstractFilter
    group: int = eqx.field(static=True)
    count: int = eqx.field(static=True)
    nodes: int = eqx.field(static=True)
    retains: bool = eqx.field(static=True, default=False)

    def init(self) -> PyTree:
        """States before the first step, (filter and node, ...)."""
        return _each(_initial, self.count * self.nodes)(self.filters)

    def step(self, states: PyTree, z: jax.Array, u: jax.Array, k: jax.Array) -> tuple[PyTree, Told]:
        """One step of each from the nodes' measurements (node, received); what is told of it, (filter, node, ...)."""

        def one(item: AbstractFilter, state: PyTree, z: jax.Array) -> tuple[PyTree, Told]:
            return _step(item, state, z, u, k, self.retains)

        both = eqx.filter_vmap(one, in_axes=(eqx.if_array(0), 0, 0))
        after, told = both(self.filters, states, jnp.tile(z, (self.count, 1)))
        return after, jax.tree.map(lambda leaf: leaf.reshape(self.count, len(z), *leaf.shape[1:]), told)

    def matrices(
        self, read: Callable[..., Any], states: PyTree, f: int, z: jax.Array, u: jax.Array, k: jax.Array
    ) -> Any:
        """What `read` gives of this step of filter f at each node, from the states before it; (node, ...)."""
        mine = slice(f * self.nodes, (f + 1) * self.nodes)
        filters, states = jax.tree.map(lambda leaf: leaf[mine] if eqx.is_array(leaf) else leaf, (self.filters, states))
        each = eqx.filter_vmap(lambda item, state, z: read(item, state, z, u, k), in_axes=(eqx.if_array(0), 0, 0))
        return each(filters, states, z)


class Fused(eqx.Module):
    """Fusions that differ in numbers alone, stacked: rules, and the quantizers on the estimates' way (fusion, node).

    `sources` of each fusion: kind and filter whose nodes' estimates it takes, one group after another; `order` of each
    (fusion, node) brings them into the order of the nodes.
    """

    rules: AbstractFusion
    quantizers: PyTree
    order: np.ndarray
    names: tuple[str, ...] = eqx.field(static=True)
    sources: tuple[tuple[tuple[int, int], ...], ...] = eqx.field(static=True)
    claims: tuple[Claim, ...] = eqx.field(static=True)
    angles: Angles = eqx.field(static=True)

    def init(self, n: int) -> PyTree:
        """States of the quantizers."""
        if self.quantizers is None:
            return ()
        fusions, nodes = self.order.shape
        return _each(_each(lambda item: at(item, 0).init(n), nodes), fusions)(self.quantizers)

    def step(
        self, states: PyTree, estimates: Sequence[Estimate], k: jax.Array
    ) -> tuple[PyTree, dict[str, Estimate], dict[str, PyTree]]:
        """Fuse what the filters told, (filter, node, ...) of each kind: estimates and uplinks by the fusions' names."""
        means = self._gathered([e.mean for e in estimates])
        covariances = self._gathered([e.covariance for e in estimates])
        uplinks: dict[str, PyTree] = {}
        if self.quantizers is not None:
            send = eqx.filter_vmap(lambda q, s, mean: at(q, k).step(s, mean), in_axes=(eqx.if_array(0), 0, 0))
            states, sent = eqx.filter_vmap(send, in_axes=(eqx.if_array(0), 0, 0))(self.quantizers, states, means)
            means, covariances = sent.value, jax.vmap(jax.vmap(widen))(covariances, sent.error)
            for i, name in enumerate(self.names):
                uplinks[name] = {"saturated": sent.saturated[i], "symbols": sent.symbols[i]}
        means = nearest(means, means[:, :1], self.angles)
        combine = eqx.filter_vmap(lambda rule, *parts: rule.combine(*parts), in_axes=(eqx.if_array(0), 0, 0))
        mean, covariance = combine(self.rules, means, covariances)
        mean = wrapped(mean, self.angles)
        each = enumerate(zip(self.names, self.claims, strict=True))
        return states, {name: Estimate(mean[i], covariance[i], claim) for i, (name, claim) in each}, uplinks

    def _gathered(self, parts: Sequence[jax.Array | np.ndarray]) -> jax.Array:
        """(fusion, node, ...)."""
        joined = [jnp.concatenate([parts[k][f] for k, f in source]) for source in self.sources]
        if all(np.array_equal(order, np.arange(len(order))) for order in self.order):
            return jnp.stack(joined)
        return jnp.stack([part[order] for part, order in zip(joined, self.order, strict=True)])


class Reporting(eqx.Module):
    """A fusion that hears reports: what happens to them on their way, and the filter at the centre.

    `sources` and `order` as in `Centre`.
    """

    uplinks: Uplinks
    centre: CentreFilter
    order: np.ndarray
    sources: tuple[tuple[int, int], ...] = eqx.field(static=True)
    nodes: tuple[str, ...] = eqx.field(static=True)

    def init(self) -> tuple[Flying, PyTree]:
        """Nothing is on its way, nothing heard."""
        return self.uplinks.init(), _initial(self.centre)

    def step(
        self, state: tuple[Flying, PyTree], estimates: Sequence[Estimate], drawn: Drawn, u: jax.Array, k: jax.Array
    ) -> tuple[tuple[Flying, PyTree], Estimate, dict[str, jax.Array], tuple[jax.Array, Array]]:
        """Send the nodes' means, and hear what arrives: state, estimate, traffic, what becomes of what is sent when."""
        flying, known = state
        means = jnp.concatenate([estimates[i].mean[f] for i, f in self.sources])[self.order]
        flying, sent, traffic = self.uplinks.send(flying, means, drawn, k)
        flying, reports = self.uplinks.arrive(flying, sent, drawn.delay)
        known, estimate = self.centre.step(known, jnp.ravel(reports)[self.centre.rows], u, k)
        return (flying, known), estimate, traffic, (sent, drawn.delay)


class AllFilters(eqx.Module):
    """Every filter of a network: those of the nodes by kind, fusion rules, centres that know more, central filters.

    `order` brings the groups' measurements, joined, into the order of the nodes. `retains`: central filters tell what a
    sweep back needs, and those of the kinds that do.
    """

    alike: tuple[Alike, ...]
    fusions: tuple[Fused, ...]
    centres: tuple[Centre | LinearisedCentre, ...]
    reporting: dict[str, Reporting]
    central: dict[str, AbstractFilter]
    order: np.ndarray | None
    complete: tuple[bool, ...] = eqx.field(static=True)  # of each group: nothing is ever missing
    n: int = eqx.field(static=True)
    retains: bool = eqx.field(static=True)

    def __init__(self, network: Network, retaining: Collection[int] | None = None):
        """`retaining`: which kinds are to be smoothed, and the central filters with them; None if nothing is."""
        self.retains = retaining is not None
        self.alike = tuple(
            Alike(
                stack([network.nodes[name].filters[f] for f in names for name in network.groups[g]]),
                g,
                len(names),
                len(network.groups[g]),
                retaining is not None and kind in retaining,
            )
            for kind, (g, names) in enumerate(network.kinds)
        )
        self.central = {name: item for name, item in network.fused.items() if isinstance(item, AbstractFilter)}
        self.fusions, self.centres = _fusions(network), _centres(network)
        self.reporting = _reporting(network)
        grouped = [name for names in network.groups for name in names]
        lengths = [network.nodes[name].received for name in grouped]
        entries = dict(zip(grouped, np.split(np.arange(sum(lengths)), np.cumsum(lengths)[:-1]), strict=True))
        self.order = _unless_sorted(np.concatenate([entries[name] for name in network.names]))
        self.complete = tuple(network.nodes[names[0]].complete for names in network.groups)
        self.n = len(network.states)

    def init(self) -> PyTree:
        """States before the first step: of nodes' filters, central filters, quantizers, centres, reports."""
        central = {name: _initial(item) for name, item in self.central.items()}
        own = tuple(item.init() for item in self.alike)
        sent = tuple(item.init(self.n) for item in self.fusions)
        reporting = {name: item.init() for name, item in self.reporting.items()}
        return own, central, sent, tuple(self._started(item, own) for item in self.centres), reporting

    def _started(self, centre: Centre | LinearisedCentre, own: Sequence[PyTree]) -> CentreState | dict[str, Followed]:
        means = [own[kind].mean.reshape(self.alike[kind].count, -1, self.n)[f] for kind, f in centre.sources]
        return centre.init(means)

    @property
    def informed(self) -> tuple[Centre, ...]:
        """The centres of filters whose gains depend on no data."""
        return tuple(centre for centre in self.centres if isinstance(centre, Centre))

    def matrices(self, centre: Centre, own: PyTree, u: jax.Array, k: jax.Array) -> list[Plan]:
        """Of a centre's sources at step k: nothing but covariances counts, so what is heard may be zero."""
        return [self.alike[i].matrices(centre.read, own[i], f, self._quiet(i), u, k) for i, f in centre.sources]

    def followed(self, own: PyTree, u: jax.Array, k: jax.Array) -> PyTree:
        """The nodes' states after step k, where what is heard is zero."""
        pairs = zip(self.alike, own, strict=True)
        return tuple(item.step(state, self._quiet(i), u, k)[0] for i, (item, state) in enumerate(pairs))

    def _quiet(self, kind: int) -> jax.Array:
        return jnp.zeros((self.alike[kind].nodes, self.alike[kind].filters.received))

    def step(
        self,
        states: PyTree,
        z: Sequence[jax.Array],
        u: jax.Array,
        k: jax.Array,
        drawn: Mapping[str, Drawn] | None = None,
    ) -> tuple[PyTree, dict[str, PyTree]]:
        """One step of all filters from the measurements of each group, and from what happens to reports, by fusion.

        Gives "estimates" by kind, (filter, node, ...), "fused" by name, "uplinks" of what has quantizers, and
        "reports" with their delays by fusion, as the nodes send them; and what is retained where that is asked for,
        "retained" by kind and "retained_centrally" by name.
        """
        own, central, sent, known, reporting = states
        results = [item.step(state, z[item.group], u, k) for item, state in zip(self.alike, own, strict=True)]
        estimates = tuple(one.estimate for _, one in results)
        joined = jnp.concatenate([jnp.ravel(part) for part in z])
        joined = joined if self.order is None else joined[self.order]
        heard = {name: _step(item, central[name], joined, u, k, self.retains) for name, item in self.central.items()}
        fused = {name: one.estimate for name, (_, one) in heard.items()}
        uplinks: dict[str, PyTree] = {}
        after = []
        for item, state in zip(self.fusions, sent, strict=True):
            following, found, traffic = item.step(state, estimates, k)
            after.append(following)
            fused |= found
            uplinks |= traffic
        learned = []
        for centre, state in zip(self.centres, known, strict=True):
            parts = [
                self.alike[i].matrices(centre.read, own[i], f, z[self.alike[i].group], u, k) for i, f in centre.sources
            ]
            state, found = centre.step(state, parts, [estimates[i].mean[f] for i, f in centre.sources], u, k)
            learned.append(state)
            fused |= found
        told, reports = {}, {}
        for name, link in self.reporting.items():
            happens = link.uplinks.undrawn() if drawn is None or name not in drawn else drawn[name]
            told[name], fused[name], traffic, reports[name] = link.step(reporting[name], estimates, happens, u, k)
            uplinks |= {name: traffic} if traffic else {}
        own, central = tuple(state for state, _ in results), {name: state for name, (state, _) in heard.items()}
        following = own, central, tuple(after), tuple(learned), told
        result: dict[str, PyTree] = {"estimates": estimates, "fused": fused, "uplinks": uplinks, "reports": reports}
        if self.retains:
            result["retained"] = tuple(one.retained for _, one in results)
            result["retained_centrally"] = {name: one.retained for name, (_, one) in heard.items()}
        return following, result


def plan(filters: AllFilters, u: Float[Array, "horizon inputs"]) -> AllFilters:
    """The filters with what does not depend on data computed before, where all data arrive."""
    with jax.enable_x64(True):
        return cast(AllFilters, to_numpy(_plan(filters, jnp.asarray(u))))


@large_program
def _plan(filters: AllFilters, u: jax.Array) -> AllFilters:
    def one(item: AbstractFilter, retains: bool) -> AbstractFilter:
        return planned_with_past(item, u) if retains else item.planned(u)

    alike = tuple(
        replace(item, filters=_each(partial(one, retains=item.retains), item.count * item.nodes)(item.filters))
        if filters.complete[item.group]
        else item
        for item in filters.alike
    )
    central = {
        name: one(item, filters.retains) if all(filters.complete) else item for name, item in filters.central.items()
    }
    result: AllFilters = eqx.tree_at(lambda f: (f.alike, f.central), filters, (alike, central))
    return result


def plans(filters: AllFilters) -> bool:
    """Whether some filter has anything to compute before."""
    return any(
        type(item).planned is not AbstractFilter.planned
        for item in (*(part.filters for part in filters.alike), *filters.central.values())
    )


def _fusions(network: Network) -> tuple[Fused, ...]:
    """The network's fusions, those of one structure together."""
    alike: dict[object, list[str]] = {}
    for name, item in network.fused.items():
        if isinstance(item, Fusion) and not isinstance(item.rule, AbstractInformedFusion):
            nodes = network.nodes_with(item.filter)
            alike.setdefault(structure((item.rule, item.uplinks(nodes), (None,) * len(nodes))), []).append(name)
    places, claims = network.places(), network.claims().get(FUSED, {})
    return tuple(_fused(network, names, places, [claims[name] for name in names]) for names in alike.values())


def _fused(
    network: Network, names: Sequence[str], places: Mapping[tuple[str, str], tuple[int, int, int]], claims: list[Claim]
) -> Fused:
    """Where the estimates of fusions stand."""
    items = [item for item in (network.fused[name] for name in names) if isinstance(item, Fusion)]
    nodes = [network.nodes_with(item.filter) for item in items]
    sources, order = [], []
    for item, mine in zip(items, nodes, strict=True):
        source = tuple({places[node, item.filter][:2]: None for node in mine})
        found = {node: i for i, node in enumerate(n for k, _ in source for n in network.groups[network.kinds[k].group])}
        sources.append(source)
        order.append([found[node] for node in mine])
    quantizers = stack([item.uplinks(mine) for item, mine in zip(items, nodes, strict=True)])
    rules = stack([item.rule for item in items])
    angles = first(network.plant).angles
    return Fused(rules, quantizers, np.array(order), tuple(names), tuple(sources), tuple(claims), angles)


def _centres(network: Network) -> tuple[Centre | LinearisedCentre, ...]:
    """One for the informed fusions of each filter."""
    rules: dict[str, dict[str, AbstractInformedFusion]] = {}
    for name, item in network.fused.items():
        if isinstance(item, Fusion) and isinstance(item.rule, AbstractInformedFusion) and not item.by_report:
            rules.setdefault(item.filter, {})[name] = item.rule
    return tuple(_centre(network, name, mine) for name, mine in rules.items())


def _reporting(network: Network) -> dict[str, Reporting]:
    """The fusions that hear reports."""
    found = {}
    for name, item in network.fused.items():
        if isinstance(item, Fusion) and item.by_report:
            centre = centre_filter(network, name)
            places, mine = network.places(), network.nodes_with(item.filter)
            sources, order = _gathering(network, places, mine, item.filter)
            uplinks = uplinks_of(item, mine, len(network.states))
            found[name] = Reporting(uplinks, centre, order, sources, tuple(mine))
    return found


def centre_filter(network: Network, name: str) -> CentreFilter:
    """The fusion `name` of the network, by `AllReports`, as a filter that hears the nodes' reports.

    It hears, joined: of each node in the network's order what arrives of the report of this step, then of that of the
    step before if links may be a step late, and so on; NaN for what did not arrive. What a quantizer adds is known by
    its bound. Claim: as the fusion's.

    Raises:
        ValueError: no fusion of this name, or one by another rule.
    Source: the best linear receiver behind relays that filter and forward; the relays are the nodes' filters.
    """
    fusion = network.fused.get(name)
    if not isinstance(fusion, Fusion) or not fusion.rule.hears_reports:
        hearing = [n for n, f in network.fused.items() if isinstance(f, Fusion) and f.rule.hears_reports]
        raise fail("fusion", f"one of {hearing}, which hear reports", repr(name))
    names = network.nodes_with(fusion.filter)
    alone = Network(
        network.plant,
        {one: _with_only(network.nodes[one], fusion.filter) for one in network.names},
        {"all": Fusion(fusion.filter, AllReports())},
        network.relays,
        network.common,
    )
    uplinks = uplinks_of(fusion, names, len(network.states))
    return CentreFilter(
        filters=AllFilters(alone),
        links=uplinks.links,
        rows=uplinks.rows,
        ages=uplinks.delay.shape[1],
        widest=max(uplinks.received),
        quantized=uplinks.quantizers is not None,
        claim=network.claims()[FUSED][name],
        states=network.states,
        inputs=network.inputs,
        received=len(uplinks.rows),
    )


def _with_only(node: Node | Listener, name: str) -> Node | Listener:
    """A node with one of its filters."""
    filters = {one: item for one, item in node.filters.items() if one == name}
    if isinstance(node, Node):
        return Node(node.sensor, node.channel, filters)
    return replace(node, filters=filters)


def _centre(network: Network, name: str, rules: dict[str, AbstractInformedFusion]) -> Centre | LinearisedCentre:
    """What the centre knows of the nodes that have the filter `name`."""
    places, claims = network.places(), network.claims()[FUSED]
    mine = network.nodes_with(name)
    sources, order = _gathering(network, places, mine, name)
    groups = [network.groups[network.kinds[kind].group] for kind, _ in sources]
    size = max(network.nodes[node].received for node in mine)
    claim = claims[next(iter(rules))]
    if along_estimates(network.parts_of(name)):
        return LinearisedCentre(network.plant, rules, order, sources, size, claim)
    return Centre(
        plant=network.plant,
        listening=_hears(network, mine, groups, order, size),
        rules=rules,
        order=order,
        sources=sources,
        size=size,
        claim=claim,
    )


def _gathering(
    network: Network, places: Mapping[tuple[str, str], tuple[int, int, int]], nodes: Sequence[str], name: str
) -> tuple[tuple[tuple[int, int], ...], np.ndarray]:
    """Kinds and filters that hold the nodes' estimates, and what brings these into the order of the nodes."""
    sources = tuple({places[node, name][:2]: None for node in nodes})
    groups = [network.groups[network.kinds[kind].group] for kind, _ in sources]
    found = {node: i for i, node in enumerate(node for names in groups for node in names)}
    return sources, np.array([found[node] for node in nodes])


def _hears(
    network: Network, mine: Sequence[str], groups: Sequence[Sequence[str]], order: np.ndarray, size: int
) -> AbstractHears:
    """What a centre knows of how these nodes hear."""
    if network.common is not None:
        rows = network.rows()
        padded = [np.pad(rows[name], (0, size - len(rows[name])), constant_values=-1) for name in mine]
        return Together(network.common.sensor, described(network.common.channel), np.array(padded))
    parts = [[node for node in map(network.nodes.__getitem__, names) if isinstance(node, Node)] for names in groups]
    each = tuple(listening([n.sensor for n in nodes], [n.channel for n in nodes]) for nodes in parts)
    return Apart(each, order, size)


def _initial(item: AbstractFilter) -> PyTree:
    return jax.tree.map(jnp.asarray, item.init())


def _each(function: Callable[..., PyTree], size: int) -> Callable[..., PyTree]:
    """A function of one of what is stacked, for all of them; some hold no array that would tell how many."""
    over: Callable[..., PyTree] = eqx.filter_vmap(function, in_axes=eqx.if_array(0), axis_size=size)
    return over


def _unless_sorted(order: np.ndarray) -> np.ndarray | None:
    return None if np.array_equal(order, np.arange(len(order))) else order
