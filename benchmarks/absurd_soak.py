"""A live service with absurd values among good ones, against one that never received them: the same, bit for bit.

Run: python benchmarks/absurd_soak.py [MESSAGES]. One message in a hundred is absurd: sentinels, overflows, inputs that
no machine can give, in every place that a message has them, in batches of up to BATCH. Prints how many were refused and
the time of both; ends with an error if a final estimate differs.
"""

import json
import sys
import time
from collections import Counter
from typing import Any

import numpy as np

PLANTS, SHARE, BATCH, SEED = 50, 0.01, 2000, 0
VALUES = [1e16, 1e20, -1e30, 3.4e38, 1e155, -1e308, 1e308]

Sent = dict[str, Any]


def stained(good: list[Sent], share: float, rng: np.random.Generator) -> tuple[list[Sent], int]:
    """The messages with absurd ones in between: of the same node, with inputs or without, or inputs alone."""
    results: list[Sent] = []
    for item in good:
        if rng.random() < share:
            bad = {k: v for k, v in item.items() if k != "inputs"}
            bad |= {"sequence": item["sequence"] + 1_000_000, "values": [float(rng.choice(VALUES))]}
            kind = rng.integers(3)
            if kind == 1:
                bad["inputs"] = [float(rng.choice(VALUES[1:]))]
            elif kind == 2:
                bad |= {"node": "inputs", "values": [float(rng.choice(VALUES[1:]))]}
            results.append(bad)
        results.append(item)
    return results, len(results) - len(good)


def finals(network: Any, sent: list[Sent], batch: int) -> tuple[list[bytes], Counter[str], float]:
    """Final estimates without their numbers, refusals by reason, and seconds."""
    from heliograph.serving import Fleet, InMemoryStore, Lanes, Options, Service

    service = Service(Fleet(Lanes(network), Options(5.0)), InMemoryStore())
    known: list[bytes] = []
    refused: Counter[str] = Counter()
    begun = time.perf_counter()
    parts = [sent[i : i + batch] for i in range(0, len(sent), batch)]
    for outputs in (
        *(service.take([json.dumps(item).encode() for item in part]) for part in parts),
        service.finish(True),
    ):
        known += [output.body.partition(b",")[2] for output in outputs if output.kind == "final"]
        refused.update(json.loads(output.body)["reason"] for output in outputs if output.kind == "refused")
    return sorted(known), refused, time.perf_counter() - begun


def main(messages: int) -> None:
    sys.path.append(str(__import__("pathlib").Path(__file__).resolve().parents[1]))
    from tests.serving import worlds

    for name, network, whole in (("steps", worlds.stepping(), True), ("seconds", worlds.moving(), False)):
        good = worlds.messages(PLANTS, messages // PLANTS, SEED, whole)
        bad, count = stained(good, SHARE, np.random.default_rng(SEED))
        expected, _, clean = finals(network, good, BATCH)
        got, refused, took = finals(network, bad, BATCH)
        assert got == expected, "final estimates: expected those of a service that never received absurd messages"
        print(f"{name}: {len(good):,} messages and {count:,} absurd ones, {dict(refused)}; {len(got):,} final "
              f"estimates the same; {took:.1f} s, without them {clean:.1f} s", flush=True)  # fmt: skip


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 1_000_000)
