"""A drive through a real broker, its service killed three times: the estimates are those of one that was left alone."""

from collections.abc import Callable
from dataclasses import dataclass
from importlib import import_module
from typing import Any

from heliograph_studies import Study, check_fields
from heliograph_studies.demo.recording import plaza2

NEEDS = ("gtsam", "nats", "paho", "prometheus_client", "pydantic", "sqlalchemy", "starlette", "uvicorn")


@dataclass(frozen=True)
class Setting:
    """kills: with -9, at random moments; messages: of a hundred mowers, for the speed."""

    kills: int = 3
    messages: int = 20_000
    seed: int = 0

    def __post_init__(self) -> None:
        check_fields(self, kills=1, messages=2000)


def _part(name: str) -> Callable[..., Any]:
    """A function of `compute`, which needs the extra `live`, imported when it runs: others import `server` alone."""
    return lambda *arguments: getattr(import_module("heliograph_studies.live.compute"), name)(*arguments)


parts = _part("compute"), 3, _part("figures"), _part("words")
example = Study("live", Setting, *parts, data=_part("data"), needs=NEEDS, files=plaza2)
run = example.run
