"""What the publications state, beside what is found here; verdicts follow from the numbers in a `Reproduction`."""

import numpy as np

from heliograph.papers.intermittent_observations import setting
from heliograph.papers.intermittent_observations.compute import Link, Reproduction
from heliograph.papers.statement import Statement, holds

SINOPOLI = "Sinopoli et al. (2004)"
THRESHOLD = 1e-6  # of a probability that was searched
SIGMAS = 4.0  # standard errors within which a simulation agrees
SHRINKS = 0.99  # ratio of increments from step to step below which they go to zero
MEASURE = 1e-9  # relative: two ways to one covariance


def statements(result: Reproduction) -> list[Statement]:
    """Theorems, special cases, successors, and what is often taken for granted."""
    return [*_critical(result), *_bounds(result), *_meeting(result), *_losses(result), *_errata(result)]


def _critical(result: Reproduction) -> list[Statement]:
    found, v = result.critical["scalar"], result.verdicts
    switches = v["below"] == "impossible" and v["above"] == "certified"
    single = found.upper - found.lower < THRESHOLD
    eigenvalues = np.abs(np.linalg.eigvals(setting.COUPLED.transition))
    product = 1 - float(np.prod(eigenvalues[eigenvalues > 1])) ** -2
    coupled = result.critical["coupled"]
    return [
        Statement("An unstable plant has a critical arrival probability: E P diverges below, is bounded above",
            f"{SINOPOLI}, Theorem 2", "1 - 1/a^2 = 0.36 for a = -1.25",
            f"{found.lower:.6f} to {found.upper:.6f}; just below: {v['below']}, just above: {v['above']}",
            holds(switches and single and abs(found.lower - (1 - 1.25**-2)) < THRESHOLD)),
        Statement("With one output the modified Riccati equation is solvable above 1 - prod |unstable eigenvalue|^-2",
            "Elia (2005); Schenato et al. (2007)", f"{product:.6f} in the coupled example",
            f"certified from {coupled.upper:.6f} on", holds(abs(coupled.upper - product) < THRESHOLD)),
    ]  # fmt: skip


def _bounds(result: Reproduction) -> list[Statement]:
    links = {"scalar": result.scalar, "coupled": result.coupled, "one unstable": result.one_unstable}
    ours = "; ".join(f"{name}: {_between(each)}" for name, each in links.items())
    bursts = "; ".join(f"fail {b.fail:g}, recover {b.recover:g}: {_between(b)}" for b in result.bursts)
    last, scalar = result.bursts[-1], result.scalar
    same = abs(last.bound / scalar.bound - 1) < MEASURE and abs(last.mean_error / scalar.mean_error - 1) < MEASURE
    return [
        Statement("S <= lim E P <= V, the steady solutions without and with a filter's correction",
            f"{SINOPOLI}, Theorem 4", "no numbers", ours, holds(all(map(_inside, links.values())))),
        Statement("The bounds by mode hold for losses that come in bursts",
            "after Huang and Dey (2007), Xie and Xie (2008)", "no numbers", bursts,
            holds(all(map(_inside, result.bursts)))),
        Statement("A chain whose rows are equal is the independent case", "by definition", "equal",
            f"fail 0.4, recover 0.6: bound {last.bound:.6f} and {scalar.bound:.6f}, mean {last.mean_error:.6f} and "
            f"{scalar.mean_error:.6f}", holds(same)),
    ]  # fmt: skip


def _mean(link: Link) -> float:
    return link.simulated.mean if np.isnan(link.mean_error) else link.mean_error


def _inside(link: Link) -> bool:
    known = np.isnan(link.mean_error) or abs(link.simulated.mean - link.mean_error) < SIGMAS * link.simulated.error
    return bool(link.lower <= _mean(link) <= link.bound and known)


def _between(link: Link) -> str:
    simulated = f"{link.simulated.mean:.5g} ± {link.simulated.error:.2g}"
    mean = f"simulated {simulated}" if np.isnan(link.mean_error) else f"{link.mean_error:.5f} (simulated {simulated})"
    return f"{link.lower:.6g} <= {mean} <= {link.bound:.8g}"


def _meeting(result: Reproduction) -> list[Statement]:
    def meet(name: str) -> bool:
        return result.critical[name].upper - result.critical[name].lower < THRESHOLD

    def both(name: str) -> str:
        return f"{result.critical[name].lower:.6f} and {result.critical[name].upper:.6f}"

    shrinking, growing, turning = (_ratio(values) for values in (result.between, result.below, result.turning[::2]))
    ours = (
        f"at arrival {setting.BETWEEN:g}, over all patterns of {len(result.between) - 1} steps, the last increment of "
        f"E tr P is {shrinking:.3f} of the one before; below the lower condition {growing:.3f}; the bound's would grow "
        f"by {result.between_bound:.3f}. Evidence, no proof"
    )
    return [
        Statement("The two conditions meet where the output shows the whole state", f"{SINOPOLI}, C invertible", "meet",
            both("components"), holds(meet("components"))),
        Statement("They meet where one eigenvalue is unstable", f"{SINOPOLI}, special case", "meet",
            both("one_unstable"), holds(meet("one_unstable"))),
        Statement("They meet always", "asked since 2004", "open there", f"coupled example: {both('coupled')}",
            holds(all(map(meet, result.critical)))),
        Statement("With distinct moduli of the unstable eigenvalues the lower condition is the truth",
            "You, Fu and Xie (2011); Mo and Sinopoli (2012)", "proved there", ours,
            holds(shrinking < SHRINKS and growing > 1)),
        Statement("The lower condition is the truth for every plant", "taken for granted at times", "1 - 1/rho^2",
            f"turned by 90 degrees a step and heard in one coordinate, 1.3 times larger each time: arrival "
            f"{sum(result.critical['turning'][:2]) / 2:.3f} lies above it, and the increments of E tr P over two steps "
            f"grow by {turning:.3f}", holds(turning < SHRINKS)),
    ]  # fmt: skip


def _ratio(values: np.ndarray) -> float:
    """The last increment over the one before."""
    increments = np.diff(values)
    return float(increments[-1] / increments[-2])


def _losses(result: Reproduction) -> list[Statement]:
    v, expected = result.verdicts, (1 - 2.5**-2, 1 - 1.5**-2)
    near = all(abs(a - b) < THRESHOLD for a, b in zip(result.components, expected, strict=True))
    sides = v["both_above"] == "certified" and v["first_below"] == v["second_below"] == "impossible"
    recoveries = ", ".join(f"{r:.6f} (fail {f:g})" for f, r in result.recovery.items())
    fixed = all(abs(r - (1 - 1.25**-2)) < THRESHOLD for r in result.recovery.values())
    return [
        Statement("Components lost on their own, of a plant without coupling, have thresholds of their own",
            "Liu and Goldsmith (2004)", "1 - 1/a_i^2: 0.84 and 0.5556",
            f"{result.components[0]:.6f} and {result.components[1]:.6f}; both above: {v['both_above']}, one below: "
            f"{v['first_below']}", holds(near and sides)),
        Statement("In bursts, a scalar plant's error is bounded if recovery > 1 - 1/a^2, however often links fail",
            "Huang and Dey (2007)", "0.36", recoveries, holds(fixed)),
    ]  # fmt: skip


def _errata(result: Reproduction) -> list[Statement]:
    it, constant, scalar = result.iterated, result.constant, result.critical["scalar"]
    right = abs(it.joseph[-1] / result.coupled.bound - 1)
    wrong = abs(it.subtracted[-1] / result.coupled.bound - 1)
    untold = "; ".join(f"{name}: {each.verdict}, {each.reason}" for name, each in result.untold.items())
    return [
        Statement("A V A' + Q - arrival K S K' can be iterated as it stands", "the equation as printed everywhere",
            "exact arithmetic", f"coupled example, {len(it.joseph)} steps: tr V = {it.subtracted[-1]:.6g}, since V's "
            f"skew part, which is rounding, is measured by nothing and grows by {it.skew_growth:.4f} a step; as a sum "
            f"of squares {it.joseph[-1]:.6g}, right to {right:.1g}", holds(wrong < THRESHOLD)),
        Statement("The steady gain of the filter that hears everything is as stable as the filter that is told",
            "taken for granted at times", "same threshold",
            f"it needs {constant.upper:.4f}, the filter that is told {scalar.upper:.4f}",
            holds(constant.upper - scalar.upper < THRESHOLD)),
        Statement("Losses that the receiver is not told have a critical probability too", "taken for granted at times",
            "a threshold", untold, holds(all(each.verdict != "impossible" for each in result.untold.values()))),
        Statement("Where E P diverges, so does P", "refuted by Shi, Epstein and Murray (2010)", "diverges",
            f"scalar example at arrival {scalar.lower - 0.06:.2f}: the median of P after z is "
            f"{result.typical:.3f} after 100 steps; the mean is infinite for its rare long losses",
            holds(result.typical > 1e6)),
    ]  # fmt: skip
