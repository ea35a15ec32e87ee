"""Quadratic filtering with dynamical bias under amplify-and-forward relays, reproduced and repaired; see README.md."""

from collections.abc import Mapping, Sequence

import numpy as np
from matplotlib.figure import Figure

import heliograph as hg
from heliograph.random_affine.noises.noise_from_moments import NoiseMoments
from heliograph.report.figures import AMBER, BLUE, GREEN, INK, MUTED, PURPLE, VERMILION
from heliograph_studies import Sampled, Statement, Study, stated
from heliograph_studies.curves import Curve, Panel, curves_over_time
from heliograph_studies.quadratic_bias import compute
from heliograph_studies.quadratic_bias.compute import CLAIMED, NODE, TRUE, Outcome
from heliograph_studies.quadratic_bias.setting import TABLE_1, Noises
from heliograph_studies.quadratic_bias.setting import Setting as Setting

NEEDS = ("xarray", "h5netcdf")
COLOURS = {
    "linear": VERMILION, CLAIMED: MUTED, TRUE: AMBER, "quadratic": BLUE, "memory": AMBER, "cubic": PURPLE,
    "quartic": MUTED, "mixture": GREEN,
}  # fmt: skip
LABELS = {TRUE: "printed, true", CLAIMED: "printed, claimed"}


def figures(outcome: Outcome) -> dict[str, Figure]:
    """Figs 1 to 6 by file name, and our scenario."""
    example, outage = outcome.example, outcome.outage
    drawn = {}
    for i, state in enumerate(example.model.states[:2]):
        variances = {name: by_state[state] for name, by_state in example.covariance.items()}
        errors = {name: values[:, i] for name, values in example.errors.items()}
        names = ("linear", "quadratic", "memory", "cubic", "quartic")
        drawn[f"fig{1 + i}_{state}"] = _trajectory(outcome.run, i, state)
        drawn[f"fig{3 + i}_covariance_{state}"] = _over_time(f"error variance of {state}", variances, names)
        drawn[f"fig{5 + i}_mse_{state}"] = _over_time(
            f"mean squared error of {state}", errors, ("linear", "quadratic", "cubic", "mixture"), begin=1
        )
    variances = {name: by_state["x"] for name, by_state in outage.covariance.items()}
    drawn["outage"] = _over_time("error variance of x", variances, ("linear", CLAIMED, TRUE, "quadratic"))
    return drawn


def _trajectory(run: hg.Record, i: int, state: str) -> Figure:
    assert run.truth is not None
    true = Curve("true", INK, run.truth[0, :, i])
    means = {name: run.estimates[NODE][name].mean[0, :, i] for name in ("quadratic", "mixture")}
    panels = [Panel(state, [true, Curve(name, COLOURS[name], np.asarray(mean))]) for name, mean in means.items()]
    return curves_over_time(run.time, panels, "t")


def _over_time(label: str, values: Mapping[str, np.ndarray], names: Sequence[str], begin: int = 0) -> Figure:
    curves = [Curve(LABELS.get(name, name), COLOURS[name], values[name]) for name in names]
    return curves_over_time(np.arange(begin, begin + len(values[names[0]])), [Panel(label, curves)], "t")


def statements(outcome: Outcome) -> dict[str, list[Statement]]:
    """All statements that the example and the scenario speak to, with the numbers that decide."""
    variance, beyond = outcome.example.covariance, outcome.outage.monte_carlo[TRUE]["minus_linear"]
    states = outcome.example.model.states[:2]
    moments = [[getattr(Noises(), name).law().moment((k,)) for k in (2, 3, 4)] for name in TABLE_1]
    numbers = {
        "printed": TRUE,
        "claimed": CLAIMED,
        "worst": min(100 * (1 - variance[TRUE][s][1:] / variance["linear"][s][1:]).min() for s in states),
        "excess": Sampled(beyond["x"], beyond["x_se"]),
        "largest_gap": np.abs(np.array(moments) - list(TABLE_1.values())).max(),
        "refused": [name for name, row in TABLE_1.items() if not _of_some_law(row)],
    }
    return stated(__file__, {**vars(outcome), **numbers})


def _of_some_law(moments: Sequence[float]) -> bool:
    try:
        NoiseMoments([0.0, *moments])
    except ValueError:
        return False
    return True


publication = Study(
    name="quadratic-bias",
    setting=Setting,
    compute=compute.compute,
    stages=3,
    figures=figures,
    publication="Quadratic filtering with dynamical bias under amplify-and-forward relays",
    statements=statements,
    data=compute.write_record,
    needs=NEEDS,
)
run = publication.run
