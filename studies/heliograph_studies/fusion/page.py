"""How the example is shown."""

from collections.abc import Mapping

from heliograph.report.figures import BLUE, PURPLE, VERMILION
from heliograph.report.page import Code, KeyFigure, KeyFigures, Page, Picture, Section, Table, Text
from heliograph_studies.fusion.compute import CASES, MANY, MEASURED_STEPS, RUNS, STEPS, STRONG_RUNS, Outcome
from heliograph_studies.fusion.pictures import KINDS, LABELS, NETWORKS


def fusion_page(outcome: Outcome, pictures: Mapping[str, bytes]) -> Page:
    """The report."""
    rooms, equal, tree = outcome.cases["three_rooms"], outcome.cases["four_equal"], outcome.tree
    rows = [[label, *(_number(outcome.cases[case][rule]) for case in CASES)] for rule, label in LABELS.items()]
    judged = [
        [
            LABELS.get(rule, "root of the tree"),
            f"{m['claimed']:.4f}",
            f"{m['measured']:.4f} ± {m['standard_error']:.4f}",
        ]
        for rule, m in outcome.measured.items()
    ]
    scale = outcome.scale
    machine = [
        [LABELS.get(rule, "equal intersection"), f"{error:.4f}", f"{outcome.strong_claimed[rule]:.4f}"]
        for rule, error in outcome.strong.items()
    ]
    sent = [
        [KINDS[kind][0], f"{p['level']:g}", f"{p['reports']:.3f}", f"{p['error']:.4f}", f"{p['claimed']:.4f}"]
        for kind, points in outcome.traffic.items()
        for p in points
    ]
    sections = [
        Section("What each rule reaches", [
            KeyFigures([
                _key("equal intersection claims", rooms["equal_intersection_claimed"], "three rooms", VERMILION),
                _key("matrix weights", rooms["matrix"], "three rooms", BLUE),
                _key("matrix weights", equal["matrix"], "four equal sensors", BLUE),
                _key("all reports", equal["all_reports"], "four equal sensors", PURPLE),
            ]),
            Table(["rule", *(NETWORKS[name] for name in CASES)], rows,
                  f"Traces of the error's covariance after {STEPS} steps."),
            Picture(pictures["traces"], "Traces of five rules in three networks: intersection claims more than twice.",
                    "The same beside the central filter, which hears every sensor itself (dashed: as good as that)."),
        ]),
        Section("Simulated", [
            Table(["rule", "claimed", "measured"], judged,
                  f"Three rooms, and the root of a tree of twelve nodes: mean square error at step {MEASURED_STEPS} "
                  f"of {RUNS} simulated runs."),
        ]),
        Section("Filters that are not linear", [
            Table(["rule", "root mean squared error", "claimed"], machine,
                  f"An induction machine behind strong relays, cubature filters, {STRONG_RUNS} runs. These filters "
                  "approximate: what they claim is not guaranteed."),
        ]),
        Section("What is sent", [
            Picture(pictures["traffic"], "Reports per step and node against the error, and what is claimed of it",
                    "Three rooms: reports that are sent, and the error that is left. Lower left is better."),
            Table(["sent", "d or threshold", "reports", "error", "claimed"], sent,
                  "A node that sends only on change tells by its silence that little changed. A centre that takes the "
                  "silence for a loss guarantees nothing."),
        ]),
        Section("Trees and many nodes", [
            Picture(pictures["tree"], "A tree of relays with the covariance of each place's error as an ellipse",
                    "How well each place of the tree knows where the point is: ellipses of one deviation, and traces."),
            Text([
                "Twelve nodes heard by four relays, these by two, these by a root, each forwarding one estimate made "
                f"with matrix weights. Traces: {tree['root']:.4f} at the root, {tree['flat']:.4f} where one centre "
                f"hears all nodes, {tree['central']:.4f} for the central filter.",
                f"All cross-covariances and weights of {MANY:,} nodes took {scale['seconds']:.1f} s and "
                f"{scale['peak_gb']:.2f} GB. One node by itself has the trace {scale['local']:.2f}, all together "
                f"{scale['matrix']:.4f}.",
                f"A tree of {scale['tree_nodes']:,} nodes in which each relay hears {scale['tree_degree']} took "
                f"{scale['tree_seconds']:.1f} s and {scale['tree_peak_gb']:.2f} GB: {scale['tree_root']:.4f} at its "
                "root.",
            ]),
        ]),
        Section("Run it again", [Code("heliograph example fusion --out out")]),
    ]  # fmt: skip
    lead = (
        "Local filters of one plant share its noise, so their errors are correlated. Covariance intersection is safe "
        f"for every correlation: in a network of three rooms it claims {_number(rooms['equal_intersection_claimed'])}. "
        "For linear filters the correlation is known before any data; weights that use it leave "
        f"{_number(rooms['matrix'])}, which is what they claim."
    )
    title = "Fusion that knows how errors are correlated claims less than half, and is right"
    return Page("Heliograph example", title, lead, sections)


def _key(label: str, value: float | list[float], note: str, colour: str) -> KeyFigure:
    return KeyFigure(label, _number(value), note, colour)


def _number(value: float | list[float]) -> str:
    return f"{value:.4f}" if isinstance(value, float) else ", ".join(f"{v:.4g}" for v in value)
