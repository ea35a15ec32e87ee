"""Figures of the example, and what its page says beside the numbers."""

import numpy as np
from matplotlib.figure import Figure

from heliograph.report.figures import AMBER, BLUE, GREEN, INK, PURPLE, VERMILION
from heliograph_studies.curves import Curve, Panel, curves_over_time
from heliograph_studies.delays.compute import Clocks, Deviation, Outcome
from heliograph_studies.delays.setting import STEP

LATE = {  # filter: how it is called, and its colour
    "as_current": ("taken as current", VERMILION),
    "uninformed": ("delays not known", BLUE),
    "informed": ("time stamps", GREEN),
    "constant": ("all one step late", PURPLE),
    "none": ("not late", INK),
}
CLOCKS = {
    "ignored": "stamps taken as true",
    "estimated": "clock estimated",
    "guarded": "clock estimated while it can be",
}
SITUATIONS = {"moving": "in motion", "at_rest": "at rest", "no_true_clock": "no true clock"}


def figures(outcome: Outcome) -> dict[str, Figure]:
    """Claims beside truths of late data; clocks in motion, and where nobody can know them."""
    late = {name: (outcome.delays[name], *shown) for name, shown in LATE.items()}
    claims = [Curve(label, colour, score.claimed_over_time) for score, label, colour in late.values()]
    truths = [Curve(label, colour, score.error_over_time) for score, label, colour in late.values()]
    motion, rest, alone = (outcome.clocks[name] for name in SITUATIONS)
    position = pair(motion["ignored"]["position"], VERMILION, "ignored")
    position += pair(motion["guarded"]["position"], BLUE, "estimated")
    offset = pair(motion["guarded"]["offset"], BLUE, "estimated")
    traps = [Panel("offset in s, at rest", offsets(rest)), Panel("offset in s, no true clock", offsets(alone))]
    steps = np.arange(1.0, len(outcome.delays["none"].true_over_time) + 1)
    time = STEP * np.arange(1.0, len(motion["ignored"]["position"].true_over_time) + 1)
    return {
        "late": curves_over_time(steps, [Panel("claimed variance", claims), Panel("mean square error", truths)]),
        "clocks": curves_over_time(time, [Panel("position error", position), Panel("offset error in s", offset)], "s"),
        "traps": curves_over_time(time, traps, "s"),
    }


def offsets(scores: Clocks) -> list[Curve]:
    """Of the filter that always estimates, and of the one that checks first."""
    always, guarded = (scores[name]["offset"] for name in ("estimated", "guarded"))
    return [*pair(always, AMBER, "always"), *pair(guarded, BLUE, "while it can be")]


def pair(score: Deviation, colour: str, name: str) -> list[Curve]:
    """What is true, and what is claimed in grey or green, as deviations."""
    return [
        Curve(f"{name}: true", colour, score.true_over_time),
        Curve(f"{name}: claims", INK if colour == VERMILION else GREEN, score.claimed_over_time),
    ]


def words(outcome: Outcome) -> dict[str, object]:
    """How filters and situations are called."""
    return {"late": LATE, "filters": CLOCKS, "situations": SITUATIONS}
