"""What the publications state, beside what is found here; verdicts follow from the numbers of an `Outcome`."""

from typing import Any

import numpy as np

from heliograph_studies.intermittent_observations.compute import Link, Outcome
from heliograph_studies.intermittent_observations.setting import threshold
from heliograph_studies.statement import Evidence, Sampled, Statement, Verdict, holds

SINOPOLI = "Sinopoli et al. (2004)"
THRESHOLD = 1e-6  # of a probability that was searched
SIGMAS = 4.0  # standard errors within which a simulation agrees
SHRINKS = 0.99  # ratio of increments from step to step below which they go to zero
DIVERGED = 1e6  # of a covariance that starts near 1, after 100 steps
MEASURE = 1e-9  # relative: two ways to one covariance


def statements(outcome: Outcome) -> dict[str, list[Statement]]:
    """Theorems, special cases, successors, and what is often taken for granted."""
    parts = _critical, _bounds, _meeting, _losses, _errata
    return {"papers": [statement for part in parts for statement in part(outcome)]}


def _critical(result: Outcome) -> list[Statement]:
    outcome, v = result.critical["scalar"], result.verdicts
    eigenvalues = np.abs(np.linalg.eigvals(result.setting.coupled.transition))
    product = 1 - float(np.prod(eigenvalues[eigenvalues > 1])) ** -2
    coupled = result.critical["coupled"]
    return [
        Statement("An unstable plant has a critical arrival probability: E P diverges below, is bounded above",
            f"{SINOPOLI}, Theorem 2", "1 − 1/a² = 0.36 for a = −1.25",
            f"{outcome.lower:.6f} to {outcome.upper:.6f}; just below: {v['below']}, just above: {v['above']}",
            {"lower": outcome.lower, "upper": outcome.upper, "predicted": _predicted(result),
             "impossible_below": float(v["below"] == "impossible"),
             "certified_above": float(v["above"] == "certified")},
            _critical_arrival),
        Statement("With one output the modified Riccati equation is solvable above 1 - prod |unstable eigenvalue|^-2",
            "Elia (2005); Schenato et al. (2007)", f"{product:.6f} in the coupled example",
            f"certified from {coupled.upper:.6f} on", {"result": coupled.upper, "predicted": product}, _as_predicted),
    ]  # fmt: skip


def _predicted(outcome: Outcome) -> float:
    return threshold(outcome.setting.scalar.transition[0, 0])


def _critical_arrival(
    lower: float, upper: float, predicted: float, impossible_below: float, certified_above: float
) -> Verdict:
    near = abs(lower - predicted) < THRESHOLD and upper - lower < THRESHOLD
    return holds(near and impossible_below == certified_above == 1)


def _as_predicted(result: float, predicted: float) -> Verdict:
    return holds(abs(result - predicted) < THRESHOLD)


def _bounds(outcome: Outcome) -> list[Statement]:
    links = {"scalar": outcome.scalar, "coupled": outcome.coupled, "one unstable": outcome.one_unstable}
    ours = "; ".join(f"{name}: {_between(link)}" for name, link in links.items())
    bursts = "; ".join(f"fail {b.fail:g}, recover {b.recover:g}: {_between(b)}" for b in outcome.bursts)
    last, scalar = outcome.bursts[-1], outcome.scalar
    each_link = {f"{key}_of_{name.replace(' ', '_')}": value
                 for name, link in links.items() for key, value in _numbers(link).items()}  # fmt: skip
    each_burst = {f"{key}_of_{i}": value for i, b in enumerate(outcome.bursts) for key, value in _numbers(b).items()}
    same = {"bound": last.bound, "bound_independent": scalar.bound, "mean": last.mean_error,
            "mean_independent": scalar.mean_error}  # fmt: skip
    return [
        Statement("S ≤ lim E P ≤ V, the steady solutions without and with a filter's correction",
            f"{SINOPOLI}, Theorem 4", "no numbers", ours, each_link, _all_inside),
        Statement("The bounds by mode hold for losses that come in bursts",
            "after Huang and Dey (2007), Xie and Xie (2008)", "no numbers", bursts,
            each_burst, _all_inside),
        Statement("A chain whose rows are equal is the independent case", "by definition", "equal",
            f"fail 0.4, recover 0.6: bound {last.bound:.6f} and {scalar.bound:.6f}, mean {last.mean_error:.6f} and "
            f"{scalar.mean_error:.6f}", same, _equal),
    ]  # fmt: skip


def _numbers(link: Link) -> dict[str, float | Sampled]:
    """The bounds, what was simulated, and what is known of the mean: NaN where nothing is."""
    simulated = Sampled(link.simulated.mean, link.simulated.error)
    return {"lower": link.lower, "mean": link.mean_error, "simulated": simulated, "bound": link.bound}


def _all_inside(**evidence: float | Sampled) -> Verdict:
    """All means lie between their bounds, and simulations agree with those that are known."""
    names = {name.removeprefix("lower_of_") for name in evidence if name.startswith("lower_of_")}
    return holds(all(_inside(*(evidence[f"{key}_of_{name}"] for key in KEYS)) for name in names))


KEYS = "lower", "mean", "simulated", "bound"


def _inside(lower: Any, mean: Any, simulated: Any, bound: Any) -> bool:
    """Whether lower <= mean <= bound for the mean, as known or as simulated, and the two agree."""
    known = not np.isnan(mean)
    agrees = not known or abs(simulated.value - mean) < SIGMAS * simulated.error
    return bool(lower <= (mean if known else simulated.value) <= bound and agrees)


def _equal(bound: float, bound_independent: float, mean: float, mean_independent: float) -> Verdict:
    return holds(abs(bound / bound_independent - 1) < MEASURE and abs(mean / mean_independent - 1) < MEASURE)


def _between(link: Link) -> str:
    simulated = f"{link.simulated.mean:.5g} ± {link.simulated.error:.2g}"
    mean = f"simulated {simulated}" if np.isnan(link.mean_error) else f"{link.mean_error:.5f} (simulated {simulated})"
    return f"{link.lower:.6g} ≤ {mean} ≤ {link.bound:.8g}"


def _meeting(outcome: Outcome) -> list[Statement]:
    def gap(*names: str) -> Evidence:
        return {f"gap_of_{name}": outcome.critical[name].upper - outcome.critical[name].lower for name in names}

    def both(name: str) -> str:
        return f"{outcome.critical[name].lower:.6f} and {outcome.critical[name].upper:.6f}"

    shrinking, growing, turning = (_ratio(values) for values in (outcome.between, outcome.below, outcome.turning[::2]))
    ours = (
        f"at arrival {outcome.setting.between:g}, over all patterns of {len(outcome.between) - 1} steps, the last "
        f"increment of E tr P is {shrinking:.3f} of the one before; below the lower condition {growing:.3f}; the "
        f"bound's would grow by {outcome.between_bound:.3f}. Evidence, no proof"
    )
    return [
        Statement("The two conditions meet where the output shows the whole state", f"{SINOPOLI}, C invertible", "meet",
            both("components"), gap("components"), _meet),
        Statement("The conditions meet where one eigenvalue is unstable", f"{SINOPOLI}, special case", "meet",
            both("one_unstable"), gap("one_unstable"), _meet),
        Statement("The conditions always meet", "asked since 2004", "open there", f"coupled example: {both('coupled')}",
            gap(*outcome.critical), _meet),
        Statement("With distinct moduli of the unstable eigenvalues the lower condition is the truth",
            "You, Fu and Xie (2011); Mo and Sinopoli (2012)", "proved there", ours,
            {"between": shrinking, "below": growing},
            lambda between, below: holds(between < SHRINKS and below > 1)),
        Statement("The lower condition is the truth for every plant", "taken for granted at times", "1 - 1/ρ²",
            "turned by 90 degrees a step and received in one coordinate, 1.3 times larger each time: arrival "
            f"{sum(outcome.critical['turning'][:2]) / 2:.3f} lies above it, and the increments of E tr P over two "
            f"steps grow by {turning:.3f}", {"turning": turning}, lambda turning: holds(turning < SHRINKS)),
    ]  # fmt: skip


def _meet(**gaps: float) -> Verdict:
    return holds(all(gap < THRESHOLD for gap in gaps.values()))


def _ratio(values: np.ndarray) -> float:
    """The last increment over the one before."""
    increments = np.diff(values)
    return float(increments[-1] / increments[-2])


def _losses(outcome: Outcome) -> list[Statement]:
    v, factors = outcome.verdicts, np.diag(outcome.setting.components.transition)
    expected = [threshold(factor) for factor in factors]
    components = {"first": outcome.components[0], "second": outcome.components[1], "first_predicted": expected[0],
                  "second_predicted": expected[1], "certified_above": float(v["both_above"] == "certified"),
                  "impossible_below": float(v["first_below"] == v["second_below"] == "impossible")}  # fmt: skip
    recoveries = ", ".join(f"{r:.6f} (fail {f:g})" for f, r in outcome.recovery.items())
    needed = {f"recovery_at_{f:g}": r for f, r in outcome.recovery.items()}
    return [
        Statement("Components lost on their own, of a plant without coupling, have thresholds of their own",
            "Liu and Goldsmith (2004)", "1 - 1/a_i^2: 0.84 and 0.5556",
            f"{outcome.components[0]:.6f} and {outcome.components[1]:.6f}; both above: {v['both_above']}, one below: "
            f"{v['first_below']}", components, _by_component),
        Statement("In bursts, a scalar plant's error is bounded if recovery > 1 - 1/a^2, however often links fail",
            "Huang and Dey (2007)", "0.36", recoveries,
            {**needed, "predicted": _predicted(outcome)}, _all_as_predicted),
    ]  # fmt: skip


def _by_component(
    first: float,
    second: float,
    first_predicted: float,
    second_predicted: float,
    certified_above: float,
    impossible_below: float,
) -> Verdict:
    near = abs(first - first_predicted) < THRESHOLD and abs(second - second_predicted) < THRESHOLD
    return holds(near and certified_above == impossible_below == 1)


def _all_as_predicted(predicted: float, **result: float) -> Verdict:
    return holds(all(abs(value - predicted) < THRESHOLD for value in result.values()))


def _errata(outcome: Outcome) -> list[Statement]:
    it, constant, scalar = outcome.iterated, outcome.constant, outcome.critical["scalar"]
    right = abs(it.joseph[-1] / outcome.coupled.bound - 1)
    wrong = abs(it.subtracted[-1] / outcome.coupled.bound - 1)
    unknown_losses = "; ".join(
        f"{name}: {unknown_loss.verdict}, {unknown_loss.reason}"
        for name, unknown_loss in outcome.unknown_losses.items()
    )
    return [
        Statement("A V A' + Q - arrival K S K' can be iterated as it stands", "the equation as printed everywhere",
            "exact arithmetic", f"coupled example, {len(it.joseph)} steps: tr V = {it.subtracted[-1]:.6g}, since V's "
            f"skew part, which is rounding, is measured by nothing and grows by {it.skew_growth:.4f} a step; as a sum "
            f"of squares {it.joseph[-1]:.6g}, right to {right:.1g}", {"relative_error": wrong},
            lambda relative_error: holds(relative_error < THRESHOLD)),
        Statement("The steady gain of the filter that receives everything is as stable as the filter that is informed",
            "taken for granted at times", "same threshold",
            f"it needs {constant.upper:.4f}, the filter that is informed {scalar.upper:.4f}",
            {"fixed_gain": constant.upper, "known": scalar.upper},
            lambda fixed_gain, known: holds(fixed_gain - known < THRESHOLD)),
        Statement("Losses that are not observed have a critical probability too", "taken for granted at times",
            "a threshold", unknown_losses,
            {"impossible": float(sum(item.verdict == "impossible" for item in outcome.unknown_losses.values()))},
            lambda impossible: holds(impossible == 0)),
        Statement("Where E P diverges, so does P", "refuted by Shi, Epstein and Murray (2010)", "diverges",
            f"scalar example at arrival {scalar.lower - 0.06:.2f}: the median of P after z is {outcome.typical:.3f} "
            "after 100 steps; the mean is infinite for its rare long losses",
            {"median": outcome.typical}, lambda median: holds(median > DIVERGED)),
    ]  # fmt: skip
