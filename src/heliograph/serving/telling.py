"""Estimates and refusals as lines of JSON."""

from pydantic_core import to_json

from heliograph.filters.plausibility import in_words
from heliograph.serving.lanes import Lanes, Place


class Teller:
    """Writes what a network's filters tell as lines; what is no finite number is null."""

    def __init__(self, lanes: Lanes):
        self._n = len(lanes.network.states)
        self._nodes: dict[str, list[Place]] = {}
        for place in lanes.places:
            self._nodes.setdefault(place.node, []).append(place)

    def estimates(self, kind: str, plant: str, time: float | str, told: list[float]) -> bytes:
        """The filters' estimates after a row, from the numbers that they told there."""
        found = {
            node: {place.filter: self._filter(place, told) for place in places} for node, places in self._nodes.items()
        }
        return line({"kind": kind, "plant": plant, "time": time, "estimates": found})

    def _filter(self, place: Place, told: list[float]) -> dict[str, object]:
        n, mean, begin, judged = self._n, place.mean, place.covariance, place.judgement
        covariance = None if place.claim == "none" else [told[i : i + n] for i in range(begin, begin + n * n, n)]
        found: dict[str, object] = {"mean": told[mean : mean + n], "covariance": covariance, "claim": place.claim}
        if judged is None:
            return found
        if told[judged.reason] > 0:
            why = in_words(told[judged.reason], told[judged.distance])
            return found | {"nis": None, "heard": 0, "implausible": why}
        return found | {"nis": told[judged.distance], "heard": int(told[judged.arrived])}


def line(parts: dict[str, object]) -> bytes:
    """One line of JSON, without its end."""
    return to_json(parts, inf_nan_mode="null")
