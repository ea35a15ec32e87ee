"""A service that says what a test wants it to, and its observer: so that the page can be looked at without a filter."""

import asyncio
import urllib.request
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import jax.numpy as jnp
import numpy as np
from pydantic_core import to_json

import heliograph as hg
from heliograph.live import LinkCounts
from heliograph.serving.observation import parse_page_address, serve_page, watch_of
from heliograph.serving.output import Output


def observer_of(states: Sequence[str] | Mapping[str, str], title: str = "", inputs: Sequence[str] = ()) -> Any:
    """The observer of services of a network with these states, whose two nodes are fused."""
    n = len(states)
    transition = (lambda u: jnp.eye(n)) if inputs else np.eye(n)
    plant = hg.LinearPlant(transition, np.eye(n), np.zeros(n), np.eye(n), states=states, inputs=inputs)
    sensor = hg.LinearSensor(np.eye(n), np.eye(n))
    node = hg.Node(sensor, hg.perfect(n), {"cubature": hg.linear_filter(plant, sensor, hg.perfect(n))})
    fusion = {"both": hg.Fusion("cubature", hg.fusion.EqualIntersection())}
    return watch_of(hg.Network(plant, {"node 0": node, "node 1": node}, fusion), title)


def metrics_of(watch: Any) -> str:
    """The metrics of services, as their page gives them."""

    async def ask() -> str:
        async with serve_page(watch, parse_page_address("0", {})) as port:
            opened = await asyncio.to_thread(urllib.request.urlopen, f"http://127.0.0.1:{port}/metrics", None, 10)
            return opened.read().decode()

    return asyncio.run(ask())


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
