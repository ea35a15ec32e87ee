"""The example as a folder of results."""

from functools import partial
from pathlib import Path

from heliograph.numerics.check import check_seed
from heliograph.report.results import Json, Results, report_results
from heliograph_studies.demo.recording import find_recording
from heliograph_studies.demo.run import numbers
from heliograph_studies.network_design.compute import SEEDS, STAGES, Case, Outcome, compute, path_powers


def example(out: Path, seed: int = 0) -> None:
    """Design every network and write figures, report and summary to `out`/network-design.

    Raises:
        ValueError: a folder that cannot be written, or one that holds something else.
        ModuleNotFoundError: an extra of `recordings`, `report` is not installed.
    """
    check_seed(f"last of {SEEDS} seeds", check_seed("seed", seed) + SEEDS - 1)
    find_recording()  # a missing extra is told before the work starts
    report_results(Path(out) / "network-design", STAGES, partial(compute, seed), results)


def results(outcome: Outcome) -> Results:
    """Everything that the folder holds."""
    from heliograph_studies.network_design.page import design_figures, design_page

    return Results(design_figures(outcome), partial(design_page, outcome), summary(outcome))


def summary(outcome: Outcome) -> dict[str, Json]:
    """Errors, powers and bounds by case."""
    return {
        "one_hop": {
            f"{total:g}": {**_case(one), "gap": one.best.certificate.gap} for total, one in outcome.one_hop.items()
        },
        "two_hops": {
            f"{total:g}": {
                **_case(one),
                "bound": one.best.certificate.bound,
                "hop_powers": [float(power[0]) for power in one.best.powers.values()],
                "least_power_same_paths": one.narrow.total,
                "least_power_bound": one.least.certificate.bound,
            }
            for total, one in outcome.two_hops.items()
        },
        "front": {key: value.tolist() for key, value in outcome.front._asdict().items()},
        "demonstration": {name: numbers(one) for name, one in outcome.demonstration.items()},
        "circuit": {
            "error_saved_percent": outcome.circuit.error_saved_percent,
            "power_saved_percent": outcome.circuit.power_saved_percent,
        },
        "packets": {f"{times:g}": dict(saved) for times, saved in outcome.packets.items()},
        "schedules": _schedules(outcome),
        "sites": {
            f"{rho:g}": {
                "one_relay": {
                    "site": float(one.sites[0]), "noise": one.noise, "midpoint": one.even, "direct": one.direct,
                },
                "with_fading": {"relays": len(best.lengths) - 1, "noise": best.noise, "direct": best.direct},
            }
            for rho, (one, best) in outcome.lines.items()
        },
    }  # fmt: skip


def _schedules(outcome: Outcome) -> dict[str, Json]:
    schedule, bursts = outcome.schedule, outcome.bursts
    return {
        "by_period": {str(period): error for period, error in schedule.by_period.items()},
        "steps": [list(step) for step in schedule.steps],
        "error": schedule.error,
        "bound": schedule.bound,
        "greedy": schedule.greedy,
        "bursts": {
            "errors": {str(every): error for every, error in bursts.errors.items()},
            "every": bursts.every, "error": bursts.error, "bound": bursts.bound,
        },
        "sensors": {
            str(count): {"chosen": list(one.chosen), "error": one.error, "bound": one.bound}
            for count, one in outcome.sensors.items()
        },
    }  # fmt: skip


def _case(one: Case) -> dict[str, Json]:
    return {
        "equal": one.equal,
        "best": one.best.error,
        "powers": list(path_powers(one.best).values()),
        "least_power": one.least.total,
    }
