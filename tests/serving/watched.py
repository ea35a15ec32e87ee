"""A service that says what a test wants it to: so that the page can be looked at without a filter."""

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from pydantic_core import to_json

from heliograph.live import LinkCounts
from heliograph.serving.output import Output


@dataclass
class OnePlant:
    links: dict[str, LinkCounts] = field(default_factory=dict)


@dataclass
class Last:
    took: float = 0.002
    committed: float = 0.001
    lag: float = 40.0


@dataclass
class Scripted:
    """Says that each message, a number, was a row of `plant` with this innovation in units of its claim.

    The last `waiting` rows of a batch are not final; more nodes than one are `node 0`, `node 1`, ...
    """

    scale: float = 1.0
    plant: str = "mower"
    nodes: int = 1
    waiting: int = 0
    senders: dict[str, dict[str, object]] = field(default_factory=dict)
    forecast: list[dict[str, object]] = field(default_factory=list)
    plants: dict[str, OnePlant] = field(default_factory=dict)
    malformed: int = 0
    last: Last = field(default_factory=Last)

    def dead_senders(self) -> dict[str, int]:
        return {}

    def remarks(self) -> dict[tuple[str, str], int]:
        return {}

    def unpublished(self) -> list[Output]:
        return []

    def published(self, outputs: Sequence[Output]) -> None: ...

    def finish(self, ended: bool) -> list[Output]:
        return []

    def take(self, payloads: Sequence[bytes]) -> list[Output]:
        names = ["<b>node"] if self.nodes == 1 else [f"node {i}" for i in range(self.nodes)]
        links = self.plants.setdefault(self.plant, OnePlant()).links
        results = []
        for payload in payloads:
            i = int(payload)
            for name in names:
                links.setdefault(name, LinkCounts()).used += 1
            nis = self.scale * float(np.random.default_rng(i).chisquare(2))
            covariance = [[0.04 * (1 + 4 / (1 + i)), 0.0], [0.0, 0.01]]
            message = {"mean": [np.sin(i / 20), np.cos(i / 20)], "covariance": covariance}
            message |= {"claim": "nominal", "nis": nis, "received": 2, "modes": [0.75, 0.25]}
            body = {
                "id": i,
                "plant": self.plant,
                "time": i / 10,
                "estimates": {name: {"cubature": message} for name in names},
            }
            if i < len(payloads) - self.waiting:
                results.append(Output(i, self.plant, "final", to_json(body | {"kind": "final"})))
            newest = body | {"kind": "provisional", "senders": self.senders, "forecast": self.forecast}
            results.append(Output(None, self.plant, "provisional", to_json(newest)))
        return results
