"""The example as a folder of results."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from heliograph.numerics.check import check_seed
from heliograph.report.progress import Advance
from heliograph.report.results import Json, Results, report_results
from heliograph_studies.demo.recording import find_recording
from heliograph_studies.live.server import find_server

if TYPE_CHECKING:  # extras that are missing are told by `example`, in one line
    from heliograph_studies.live.compute import Outcome

NEEDS = ("nats", "paho", "prometheus_client", "pydantic", "sqlalchemy", "starlette", "uvicorn")
STAGES = 7


def example(out: Path, seed: int = 0) -> None:
    """Serve the demonstration's drive through a broker that is started for it, kill the service, and compare.

    Raises:
        ValueError: a folder that cannot be written or holds something else.
        ModuleNotFoundError: an extra of `recordings`, `report`, `live` is not installed.
    """
    find_recording()  # what is missing is told before the work starts
    find_server()
    report_results(Path(out) / "live", STAGES, partial(_compute, check_seed("seed", seed)), results, NEEDS)


def _compute(seed: int, advance: Advance) -> "Outcome":
    from heliograph_studies.live.compute import compute

    return compute(seed, advance)


def results(outcome: "Outcome") -> Results:
    """Everything that the folder holds."""
    from heliograph_studies.live.page import live_figures, live_page

    def pictures(folder: Path) -> None:
        for name, data in outcome.pictures.items():
            (folder / f"{name}.png").write_bytes(data)

    return Results(live_figures(outcome), partial(live_page, outcome), summary(outcome), pictures)


def summary(outcome: "Outcome") -> dict[str, Json]:
    """Numbers of messages, whether killing changed anything, and how fast messages are used."""
    return {
        "messages": outcome.messages,
        "ranges_lost_on_the_way": outcome.unreceived,
        "too_late": outcome.late,
        "kills": outcome.kills,
        "final_estimates": len(outcome.killed),
        "final_estimates_identical": outcome.identical,
        "told_again": outcome.again,
        "lost": outcome.lost,
        "counted_twice": outcome.counted_twice,
        "steps_per_second": {name: round(value) for name, value in outcome.speed.items()},
        "position_rmse_m": outcome.rmse,
        "screenshots": sorted(outcome.pictures),
    }
