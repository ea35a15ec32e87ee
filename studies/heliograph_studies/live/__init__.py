"""A drive through a real broker, its service killed three times: the estimates are those of one that was left alone."""

from typing import TYPE_CHECKING

from heliograph_studies.demo.recording import plaza2
from heliograph_studies.live.setting import Setting as Setting
from heliograph_studies.stages import Stages
from heliograph_studies.study import Study

if TYPE_CHECKING:  # what needs the extra `live` is imported when it runs: others import `server` and `mower` alone
    from matplotlib.figure import Figure

    from heliograph_studies.live.compute import Outcome


def _compute(setting: Setting, stages: Stages) -> "Outcome":
    from heliograph_studies.live import compute

    return compute.compute(setting, stages)


def _figures(outcome: "Outcome") -> "dict[str, Figure]":
    from heliograph_studies.live import figures

    return figures.figures(outcome)


def _words(outcome: "Outcome") -> dict[str, object]:
    from heliograph_studies.live import figures

    return figures.words(outcome)


NEEDS = ("nats", "paho", "prometheus_client", "pydantic", "sqlalchemy", "starlette", "uvicorn")
example = Study(
    "live",
    Setting,
    _compute,
    3,
    _figures,
    _words,
    data=lambda outcome, folder: outcome.draw(folder),
    needs=NEEDS,
    files=plaza2,
)
run = example.run
