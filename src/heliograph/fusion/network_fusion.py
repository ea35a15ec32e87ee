"""Fusion as a part of a network: whose estimates are fused by which rule, and over which links they travel."""

from collections.abc import Mapping, Sequence

import equinox as eqx

from heliograph.fusion.mesh.graph import Neighbours, neighbours_of
from heliograph.fusion.quantizer import AbstractQuantizer, Quantizer
from heliograph.fusion.report_link import ReportLink, ReportLinks, check_reports
from heliograph.fusion.rules import AbstractFusion
from heliograph.model.channel import Channel
from heliograph.model.estimate import Claim
from heliograph.model.over_time import first, stack, stack_over_time
from heliograph.numerics.check import check_count, fail, instance, scalar, spread_over_names
from heliograph.numerics.module import Module, readable
from heliograph.numerics.types import ArrayLike, Float


@readable
class Fusion(Module):
    """Fusion in a network: of one filter's estimates at every node that has it, by a rule, through uplinks.

    Without neighbours the estimates go to a fusion centre. With them there is no centre: at each step every node sends
    its estimate of the step before and its measurement to its neighbours, fuses the estimates that arrived by the rule,
    predicts once, and corrects with all measurements that arrived; so does a node without a sensor. Models are those of
    the network, gains those of `linear_filter`; the nodes know which messages arrived. Results stand under each node,
    by the fusion's name.

    Args:
        filter: name of the filter whose estimates are fused.
        rule: the fusion rule.
        quantizer: of each node's mean on its way to the fusion centre or to its neighbours; one for all nodes, or one
            for each by its name, all of one kind; None by default. The covariance is widened by the quantizer's error.
            Between neighbours a mean beyond its amplitude does not arrive, and the claim is "nominal". Covariances are
            assumed to arrive as they are: most are computed before any data.
        uplink: the link of the quantized mean, for rules that use reports (`AllReports`); one for all nodes, or one for
            each node by its name; None by default.
        neighbours: names of those whom each node receives, such as {"a": ["b", "c"], "b": []}, or a networkx graph of
            names; `hg.fusion.neighbours_within` makes them from positions. None, a fusion centre, by default.
        link: channel of the messages between neighbours, which arrive as they are, late or not at all, and the receiver
            knows: `erasure`, also in bursts (`gilbert_elliott`), `hg.model.delayed`. One law for all edges, drawn apart
            for each, or a channel for each edge by its name "SENDER to RECEIVER"; lossless by default.
        rounds: exchanges of the neighbours at each step, 1 by default; more need a rule that intersects. Measurements
            are forwarded with the name of their node, so that each counts once.
        alpha: events. A node sends its estimate only if (xhat - xs)' P^-1 (xhat - xs) > alpha n, xs that which it sent
            last, predicted (at first the plant's mean); its measurement always. Neighbours intersect by the bound
            (1 + sqrt(alpha n))^2 P of xs, sent or not. For intersections, one round; None by default. Where messages
            get lost, xs is what each neighbour received last, predicted: the sender learns which arrived.

    Raises:
        ValueError: a rule that is none, neighbours that are none; links, rounds or events without neighbours.
    """

    filter: str = eqx.field(static=True)
    rule: AbstractFusion
    quantizer: Quantizer | Mapping[str, Quantizer] | None = None
    uplink: ReportLinks | None = None
    neighbours: dict[str, tuple[str, ...]] | None = None
    link: Channel | dict[str, Channel] | None = None
    rounds: int = eqx.field(static=True, default=1)
    alpha: float | None = eqx.field(static=True, default=None)

    def __init__(
        self,
        filter: str,
        rule: "AbstractFusion",
        quantizer: "Quantizer | Mapping[str, Quantizer] | None" = None,
        uplink: "ReportLinks | None" = None,
        neighbours: "Neighbours | None" = None,
        link: "Channel | Mapping[str, Channel] | None" = None,
        rounds: int = 1,
        alpha: Float[ArrayLike, ""] | None = None,
    ):
        """Check and store the rule, what is fused (the filter of this name), and how estimates are exchanged.

        Without `neighbours` (names of the nodes that each node hears) the fusion is at a centre, to which uplinks lead.
        With them messages go over the `link` between two nodes, in one or more `rounds` a step, perhaps only if an
        estimate has moved by more than `alpha`. A `quantizer` rounds the estimates that are sent.
        """
        self.filter = instance("filter of a fusion", filter, str, "its name")
        self.rule = instance("fusion rule", rule, AbstractFusion, "one such as CovarianceIntersection()")
        self.quantizer, self.uplink = quantizer, uplink
        self.neighbours = None if neighbours is None else neighbours_of(neighbours)
        self.link = dict(link) if isinstance(link, Mapping) else link
        self.rounds = check_count("rounds of a fusion", rounds)
        self.alpha = None if alpha is None else float(scalar("alpha of a fusion", alpha, 0.0))
        if neighbours is None and (link is not None or rounds > 1 or alpha is not None):
            raise fail("fusion", "neighbours, where there are links between them, rounds or events", "none")
        if neighbours is not None and uplink is not None:
            raise fail("fusion between neighbours", "a link of each edge (link=)", "an uplink")

    def check(self, nodes: Sequence[str], n: int) -> None:
        """Raise ValueError unless rule and quantizers fit these nodes and estimates of n components.

        A quantizer that may send nothing at a step, and a report link, need a rule that uses reports: one that knows
        what has arrived, and when it was sent.
        """
        self.rule.check(len(nodes))
        for quantizer in self._quantizers(nodes):
            if not isinstance(first(quantizer), AbstractQuantizer):
                raise fail("quantizer", "an AbstractQuantizer", type(quantizer).__name__)
            first(quantizer).check(n)
            if first(quantizer).silent and not self.rule.uses_reports:
                expected = "a rule that uses reports (AllReports)"
                raise fail(f"fusion through {type(first(quantizer)).__name__}", expected, type(self.rule).__name__)
        if self.by_report:
            if not self.rule.uses_reports:
                expected = "a rule that uses reports (AllReports)"
                raise fail("fusion over report links", expected, type(self.rule).__name__)
            check_reports(self.links(nodes), self._quantizers(nodes), n)
        self.uplinks(nodes)  # raises where quantizers are of several kinds

    @property
    def by_report(self) -> bool:
        """True if the fusion centre models each report: its link (gain, noise, loss, delay), or its quantizer's error.

        A report is the estimate that a node sends. Other rules fuse the estimates themselves as they arrive.
        """
        return self.uplink is not None or (self.rule.uses_reports and self.quantizer is not None)

    def links(self, nodes: Sequence[str]) -> list[ReportLink]:
        """Return the links over which these nodes report, in the order of the nodes."""
        return spread_over_names("report links", ReportLink() if self.uplink is None else self.uplink, nodes)

    def quantizers(self, nodes: Sequence[str]) -> list[AbstractQuantizer]:
        """Return the quantizers of these nodes' reports, which do not vary over time; an empty list without."""
        return [quantizer for quantizer in self._quantizers(nodes) if isinstance(quantizer, AbstractQuantizer)]

    def uplinks(self, nodes: Sequence[str]) -> Quantizer | None:
        """Return the quantizers on the nodes' uplinks, stacked along a leading axis; None without quantizers.

        Raises:
            ValueError: quantizers of different kinds.
        """
        return None if self.quantizer is None else stack(self._quantizers(nodes))

    def claim(self, claims: list[Claim]) -> Claim:
        """Return what the fused covariance is said to be ("exact", "upper" bound, or "nominal").

        `claims` says it of the filters' covariances. A quantizer may weaken them before the rule fuses.
        """
        if self.quantizer is None:
            return self.rule.claim(claims)
        # `check` allows quantizers of one class only, and the class decides the claim: any one of them will do.
        any_quantizer = next(iter(self.quantizer.values())) if isinstance(self.quantizer, Mapping) else self.quantizer
        quantizer = stack_over_time(any_quantizer)
        quantized_claims = [quantizer.claim(claim) for claim in claims]
        return self.rule.claim(quantized_claims)

    def _quantizers(self, nodes: Sequence[str]) -> list[Quantizer]:
        """Return the quantizer of each node, in their order; an empty list if nothing is quantized."""
        return [] if self.quantizer is None else spread_over_names("quantizers", self.quantizer, nodes)
