"""Estimates and refusals as lines of JSON."""

from collections.abc import Mapping
from math import isfinite

from pydantic_core import to_json

from heliograph.filters.plausibility import in_words
from heliograph.live.senders import SenderStatus
from heliograph.serving.lanes import Lanes, Place


class Teller:
    """Writer of a network's outputs as lines of JSON; numbers that are not finite become null."""

    def __init__(self, lanes: Lanes):
        self._n = len(lanes.network.states)
        self._nodes: dict[str, list[Place]] = {}
        for place in lanes.places:
            self._nodes.setdefault(place.node, []).append(place)

    def estimates(
        self, kind: str, plant: str, time: float | str, outputs: list[float], senders: Mapping[str, SenderStatus]
    ) -> bytes:
        """Return a line with the estimates of all filters after a row, from its outputs, and the senders."""
        results = {
            node: {place.filter: self._filter(place, outputs) for place in places}
            for node, places in self._nodes.items()
        }
        parts: dict[str, object] = {"kind": kind, "plant": plant, "time": time, "estimates": results}
        if senders:
            parts["senders"] = {name: status._asdict() | {"dead": status.dead} for name, status in senders.items()}
        return line(parts)

    def _filter(self, place: Place, outputs: list[float]) -> dict[str, object]:
        n, mean, begin, judged = self._n, place.mean, place.covariance, place.judgement
        covariance = None if place.claim == "none" else [outputs[i : i + n] for i in range(begin, begin + n * n, n)]
        numbers = all(map(isfinite, (*outputs[mean : mean + n], *outputs[begin : begin + n * n])))
        claim = place.claim if numbers else "none"
        results: dict[str, object] = {"mean": outputs[mean : mean + n], "covariance": covariance, "claim": claim}
        if judged is None:
            return results
        if outputs[judged.reason] > 0:
            why = in_words(outputs[judged.reason], outputs[judged.distance])
            return results | {"nis": None, "received": 0, "implausible": why}
        return results | {"nis": outputs[judged.distance], "received": int(outputs[judged.arrived])}


def line(parts: dict[str, object]) -> bytes:
    """Encode a value as one line of JSON, without the newline."""
    return to_json(parts, inf_nan_mode="null")
