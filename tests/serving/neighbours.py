"""Two nodes that measure and one between them, which estimate from what they send one another."""

from typing import Any

import heliograph as hg

PLANT = hg.LinearPlant([[1.0, 0.3], [0.0, 0.95]], 0.1, [1.0, 0.0], [[1.0, 0.0], [0.0, 1.0]])
NEAR = {"a": ["b"], "b": ["a", "c"], "c": ["b"]}


def chain(rule: hg.fusion.AbstractFusion | None = None, **options: Any) -> hg.Network:
    """Two nodes that measure one state each, and one between them that has no sensor."""
    parts: dict[str, hg.Node | None] = {"b": None}
    for name, row in (("a", [1.0, 0.0]), ("c", [0.0, 1.0])):
        sensor = hg.LinearSensor([row], 0.3)
        parts[name] = hg.Node(sensor, hg.perfect(), {"alone": hg.kalman_filter(PLANT, sensor)})
    item = hg.Fusion("alone", rule or hg.fusion.TraceIntersection(), neighbours=NEAR, **options)
    return hg.Network(PLANT, {name: parts[name] for name in "abc"}, {"mesh": item})
