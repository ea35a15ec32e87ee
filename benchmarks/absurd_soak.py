"""A live service with absurd values among good ones, against one that never received them: the same, bit for bit.

Run: python benchmarks/absurd_soak.py [MESSAGES]. One message in a hundred is absurd: sentinels, overflows, inputs that
no machine can give, in every place that a message has them, in batches of up to BATCH. A message with an absurd value
and an absurd input is refused twice, once for each part, and is counted as two parts. Prints how many were refused and
the time of both, and writes them to benchmarks/absurd_soak.json; ends with an error if a final estimate differs, or
what is refused of the good messages, and why, or if the absurd parts are not all refused once.
"""

import json
import sys
import time
from collections import Counter
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

PLANTS, SHARE, BATCH, SEED = 50, 0.01, 2000, 0
ABSURD = 1_000_000  # from this sequence number on
RESULTS = Path(__file__).with_suffix(".json")
VALUES = [1e16, 1e20, -1e30, 3.4e38, 1e155, -1e308, 1e308]

Sent = dict[str, Any]


def stained(good: list[Sent], share: float, rng: np.random.Generator) -> tuple[list[Sent], int]:
    """The messages with absurd ones in between (of the same node, with inputs or without, or inputs alone), and parts.

    The number is that of absurd values and inputs: of a message that has both, two.
    """
    results: list[Sent] = []
    parts = 0
    for item in good:
        if rng.random() < share:
            bad = {k: v for k, v in item.items() if k != "inputs"}
            bad |= {"sequence": item["sequence"] + ABSURD, "values": [float(rng.choice(VALUES))]}
            kind = rng.integers(3)
            if kind == 1:
                bad["inputs"] = [float(rng.choice(VALUES[1:]))]
            elif kind == 2:
                bad |= {"node": "inputs", "values": [float(rng.choice(VALUES[1:]))]}
            parts += 1 + (kind == 1)
            results.append(bad)
        results.append(item)
    return results, int(parts)


class Outcome(NamedTuple):
    """Final estimates without their numbers, refusals of good messages likewise, all refusals by reason, seconds."""

    final: list[bytes]
    of_good: list[bytes]
    refused: Counter[str]
    seconds: float


def outcome(network: Any, sent: list[Sent], batch: int) -> Outcome:
    """Of a service that receives these messages."""
    from heliograph.serving import Fleet, InMemoryStore, NetworkProgram, Options, Service

    service = Service(Fleet(NetworkProgram(network), Options(5.0)), InMemoryStore())
    final: list[bytes] = []
    of_good: list[bytes] = []
    refused: Counter[str] = Counter()
    begun = time.perf_counter()
    parts = [sent[i : i + batch] for i in range(0, len(sent), batch)]
    for outputs in (
        *(service.take([json.dumps(item).encode() for item in part]) for part in parts),
        service.finish(True),
    ):
        final += [output.body.partition(b",")[2] for output in outputs if output.kind == "final"]
        for item in (output for output in outputs if output.kind == "refused"):
            said = json.loads(item.body)
            refused[said["reason"]] += 1
            if said["sequence"] < ABSURD:
                of_good.append(item.body.partition(b",")[2])
    return Outcome(sorted(final), sorted(of_good), refused, time.perf_counter() - begun)


def main(messages: int) -> None:
    sys.path.append(str(Path(__file__).resolve().parents[1]))
    from tests.serving import worlds

    measured: dict[str, Any] = {}
    for name, network, whole in (("steps", worlds.stepping(), True), ("seconds", worlds.moving(), False)):
        good = worlds.messages(PLANTS, messages // PLANTS, SEED, whole)
        bad, parts = stained(good, SHARE, np.random.default_rng(SEED))
        clean, with_absurd = outcome(network, good, BATCH), outcome(network, bad, BATCH)
        assert with_absurd.final == clean.final, "final estimates: expected those of a service without absurd messages"
        assert with_absurd.of_good == clean.of_good, "refusals of good messages: expected those without absurd ones"
        of_absurd = with_absurd.refused.total() - len(with_absurd.of_good)
        assert of_absurd == parts, f"refusals of absurd values and inputs: expected {parts}, got {of_absurd}"
        measured[name] = {
            "messages": len(good),
            "absurd messages": len(bad) - len(good),
            "absurd values and inputs in them": parts,
            "refused": dict(with_absurd.refused),
            "refused of the good ones": len(clean.of_good),
            "final estimates, all the same": len(clean.final),
            "seconds": round(with_absurd.seconds, 1),
            "seconds without absurd ones": round(clean.seconds, 1),
        }
        print(f"{name}: {measured[name]}", flush=True)
    RESULTS.write_text(json.dumps(measured, indent=2) + "\n")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000)
