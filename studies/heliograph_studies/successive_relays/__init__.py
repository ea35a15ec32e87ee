"""Recursive filtering with filter-and-forward successive relays, reproduced and repaired; see README.md."""

from dataclasses import replace

import numpy as np
import scipy
from matplotlib.figure import Figure

import heliograph as hg
from heliograph.report.figures import AMBER, BLUE, GREEN, INK, MUTED, PURPLE, VERMILION
from heliograph_studies import Statement, Study, stated
from heliograph_studies.curves import Curve, Panel, curves_over_time
from heliograph_studies.successive_relays import compute, misprints
from heliograph_studies.successive_relays.compute import FILTERS, Outcome
from heliograph_studies.successive_relays.setting import STATES, TRANSITION, circuit
from heliograph_studies.successive_relays.setting import Setting as Setting

FALSE_ALARM = 1e-3  # that some step of a right design is said to disagree with the simulation
BATCHES = 50

COLOURS = {"relay_1": AMBER, "relay_2": VERMILION, "receiver": BLUE}
LABELS = {"relay_1": "relay 1", "relay_2": "relay 2", "receiver": "receiver"}
TITLES = {
    "paper": "the paper's gains", "joint": "all gains chosen for the receiver",
    "joint_quiet": "the same, at the paper's power",
    "lmmse": "the paper's relays, best linear receiver",
    "lmmse_tuned_from_paper": "best linear receiver, relays chosen for it",
    "lmmse_tuned": "the same, searched from another start", "lmmse_quiet": "the same, at the paper's power",
    "no_relay": "no relay: one hop, as late", "sensor_itself": "no relay, no channel: as late",
    "no_relay_filtered": "no relay: one hop, without delay",
    "sensor_itself_filtered": "no relay, no channel: without delay", "nothing_received": "nothing received",
}  # fmt: skip
UNITS = ("V", "V", "A")


def figures(outcome: Outcome) -> dict[str, Figure]:
    """Figs 2 to 5 by file name, and the tuned designs."""
    drawn = {f"fig{2 + i}_{state}": _trajectory(outcome, i) for i, state in enumerate(STATES)}
    drawn["fig5_traces"] = _traces(outcome)
    drawn["tuned"] = _tuned(outcome)
    return drawn


def _trajectory(outcome: Outcome, i: int) -> Figure:
    assert outcome.shown.truth is not None
    curves = [Curve("true", INK, outcome.shown.truth[0, :, i])]
    for name in FILTERS:
        curves.append(
            Curve(LABELS[name], COLOURS[name], np.asarray(outcome.shown.estimates[name]["local"].mean)[0, :, i])
        )
    label = f"{STATES[i].replace('_', ' ')} ({UNITS[i]})"
    return curves_over_time(outcome.shown.time, [Panel(label, curves)], "step k")


def _traces(outcome: Outcome) -> Figure:
    time = np.arange(outcome.setting.horizon + 1)
    designed = [Curve(LABELS[f], COLOURS[f], np.log10(outcome.designs.paper.trace(f))) for f in FILTERS]
    simulated = outcome.simulated
    ratio = simulated.mean["receiver"] / outcome.designs.paper.trace("receiver")
    band = simulated.error["receiver"] / outcome.designs.paper.trace("receiver")
    panels = [
        Panel("log10 of error variance", designed),
        Panel("simulated / computed", [Curve("receiver", BLUE, ratio), Curve("+2 s.e.", MUTED, 1 + 2 * band),
                                       Curve("−2 s.e.", MUTED, 1 - 2 * band)]),
    ]  # fmt: skip
    return curves_over_time(time, panels, "step k")


def _tuned(outcome: Outcome) -> Figure:
    time, paper = np.arange(1, outcome.setting.horizon + 1), outcome.designs.paper
    designs = {"free power": (GREEN, outcome.designs.tuned), "same power": (PURPLE, outcome.designs.bounded)}
    trace, power = paper.trace("receiver")[1:], paper.total_power()
    panels = [
        Panel("error / paper's", [Curve(n, c, d.trace("receiver")[1:] / trace) for n, (c, d) in designs.items()]),
        Panel("power / paper's", [Curve(n, c, d.total_power() / power) for n, (c, d) in designs.items()]),
    ]
    return curves_over_time(time, panels, "step k")


def words(outcome: Outcome) -> dict[str, object]:
    """Titles, colours, and the rows of three tables."""
    designs, total = outcome.designs, {name: s.even + s.odd for name, s in outcome.states.items()}
    z, where = worst_z(outcome)
    rows = [
        (TITLES[name], s.even, s.odd, total[name] / total["paper"],
         " / ".join(f"{p:.3f}" for p in s.power / outcome.states["paper"].power) if np.any(s.power) else "none")
        for name, s in ((name, outcome.states[name]) for name in TITLES if name in outcome.states)
    ]  # fmt: skip
    names = {"the paper's gains": designs.paper, "chosen for the receiver": designs.tuned,
             "the same, at the paper's power": designs.bounded}  # fmt: skip
    return {
        "free": designs.mean_ratio(designs.tuned),
        "same": designs.mean_ratio(designs.bounded),
        "total": total,
        "worse": [designs.tuned.trace(f)[-1] / designs.paper.trace(f)[-1] for f in ("relay_2", "receiver")],
        "z": z,
        "where": where,
        "limit": z_limit(outcome.setting.horizon + 1),
        "rows": rows,
        "early": [
            (name, d.trace("receiver") / designs.paper.trace("receiver"),
             d.total_power() / designs.paper.total_power(), d.trace("relay_2")[-1])
            for name, d in names.items()
        ],
        "published_bounds": outcome.certificates["paper"].bounds.values(),
    }  # fmt: skip


def worst_z(outcome: Outcome, name: str = "receiver") -> tuple[float, int]:
    """Largest |designed - simulated| in standard errors over k = 0 .. horizon, and where."""
    simulated = outcome.simulated
    z = np.abs(simulated.mean[name] - outcome.designs.paper.trace(name)) / simulated.error[name]
    return float(z.max()), int(z.argmax())


def z_limit(steps: int) -> float:
    """What the largest of `steps` values of |z| exceeds with probability FALSE_ALARM at most (Bonferroni)."""
    return float(scipy.stats.t.isf(FALSE_ALARM / 2 / steps, BATCHES - 1))


def statements(outcome: Outcome) -> dict[str, list[Statement]]:
    """Results first, then bounds, then misprints, with the numbers that decide."""
    numbers = {**vars(outcome), **words(outcome), **_designs(outcome), **_bounds(outcome), **_circuit(outcome)}
    return stated(__file__, numbers)


def _designs(outcome: Outcome) -> dict[str, object]:
    """Numbers on the filters: errors in two ways, and how far estimates are off."""
    paper, other, setting = outcome.designs.paper, outcome.certificates["paper"].recomputed, outcome.setting
    trace, state = paper.trace("receiver"), np.trace(paper.moments[:, :3, :3], axis1=1, axis2=2)
    gaps = [np.abs(other.covariance[f] - paper.covariance[f]).max(axis=(1, 2)) for f in FILTERS]
    sizes = [np.abs(paper.covariance[f]).max(axis=(1, 2)) for f in FILTERS]
    # Root of tr P_k over the root of E |x_k|^2.
    means = {k: np.linalg.matrix_power(setting.transition, k) @ setting.initial_mean for k in (10, 50, 100)}
    relative = {k: float(np.sqrt(trace[k] / (state[k] + np.sum(mean**2)))) for k, mean in means.items()}
    return {
        "steps": len(trace),
        "false_alarm": FALSE_ALARM,
        "batches": BATCHES,
        "gap_of_traces": np.abs(outcome.misprints["none"].claimed - 1).max(),
        "gap_of_recursions": np.max(np.array(gaps) / np.array(sizes)),
        "correlation": max(np.max(value) for value in other.correlation.values()),
        "bias": max(np.max(np.linalg.norm(other.mean[f], axis=1) / np.sqrt(paper.trace(f))) for f in FILTERS),
        "worst_z": max(worst_z(outcome, name)[0] for name in FILTERS),
        "without_fading": misprints.without_fading(setting),
        "relative": relative,
        "of_state": trace / state,
        "best_gain": 1 - np.min(outcome.designs.best_behind / trace[1:]),
        "first_gain": np.abs(paper.gains["receiver"][0]).max(),
    }


def _bounds(outcome: Outcome) -> dict[str, object]:
    """Numbers on the bounds; slack: smallest eigenvalue of cov x_k - E e e' over its trace, over all k."""
    scalar, slack = outcome.certificates["scalar"], dict[str, dict[str, float]]()
    for name in ("paper", "tuned"):
        other = outcome.certificates[name].recomputed
        size = np.trace(other.state, axis1=1, axis2=2)
        gaps = {f: np.linalg.eigvalsh(other.state - other.covariance[f])[:, 0] / size for f in FILTERS}
        slack[name] = {f: float(gap.min()) for f, gap in gaps.items()}
    return {
        "paper": outcome.certificates["paper"].bounds,
        "scalar": scalar.bounds,
        "slack": slack,
        "printed": misprints.printed_scalar(),
        "at_rest": {f: scalar.recomputed.covariance[f][-1, 0, 0] for f in FILTERS},
        "squared": misprints.noise_squared(),
        "least_direction": misprints.largest_noise(),
        "used_before_known": misprints.used_before_known(misprints.ORDER),
    }


def _circuit(outcome: Outcome) -> dict[str, object]:
    """Numbers on the circuit's matrix, with two inductances and the other sign."""
    printed, plus = replace(outcome.setting, transition=circuit(0.5)).network(), circuit(5.0, second_sign=1.0)
    gaps = {"gap_of_half": circuit(0.5), "gap_of_five": circuit(5.0), "gap_with_plus": plus}
    return {
        **{name: np.abs(matrix - TRANSITION).max() for name, matrix in gaps.items()},
        "trace_of_half": hg.relays.local_error_design(printed, 10).trace("receiver")[10],
        "radius_with_plus": np.abs(np.linalg.eigvals(plus)).max(),
    }


publication = Study(
    name="successive-relays",
    setting=Setting,
    compute=compute.compute,
    stages=4,
    figures=figures,
    words=words,
    publication="Recursive filtering for stochastic systems with filter-and-forward successive relays",
    statements=statements,
    data=compute.write_record,
)
run = publication.run
