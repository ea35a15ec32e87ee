"""A service that is killed with -9 at random moments, and what that changes: nothing may.

Run: python benchmarks/kills.py [KILLS]. A fleet's messages, late and out of order, go through the pipe of
`heliograph serve`; after each kill all of them are sent again from the first. At the end the states of all plants and
the journal are compared with those of a service that was never disturbed, byte by byte, and what was read from the pipe
with the journal. Exit code 1 if anything differs.
"""

import json
import random
import signal
import subprocess
import sys
import tempfile
from contextlib import suppress
from pathlib import Path
from threading import Thread
from time import sleep
from typing import Any

from heliograph.files.network_file import load_network
from heliograph.live.fleet import Fleet
from heliograph.live.fleet_options import Options
from heliograph.live.network_step_program import NetworkProgram
from heliograph.live.stored.plant_codec import pack_plant, unpack_plant
from heliograph.serving.service import Service
from heliograph.serving.storage.store import Store
from heliograph.serving.storage.store_protocol import identity

NETWORK = """
import jax.numpy as jnp
import heliograph as hg
plant = hg.Plant(lambda x, u: x + u[0] * u[1], lambda u: jnp.diag(0.3 * u[1:]), [0.0], 1.0, inputs=["speed", "dt"])
sensor, hop = hg.LinearSensor([[1.0]], 0.1), hg.hop(hg.Discrete([0.6, 1.2], [0.5, 0.5]), 0.05)
node = hg.Node(sensor, hop, {"cubature": hg.cubature_filter(plant, sensor, hop)})
network = hg.Network(plant, {"a": node, "b": node})
"""
PLANTS, STEPS, WINDOW, LATEST = 5, 400, 5.0, 3.0
AHEAD = 0.1  # of `heliograph serve` by default
PART = 40  # lines that are written at once
PAUSE = 0.01  # seconds between


def messages(seed: int) -> list[bytes]:
    """Of each plant, a third late, some twice, in the order of their arrival."""
    chance, results = random.Random(seed), []
    for plant in range(PLANTS):
        for i in range(STEPS):
            time = 0.4 * i + chance.uniform(0, 0.3)
            item = {"plant": f"p{plant}", "node": "ab"[i % 2], "sequence": i // 2, "time": time,
                   "values": [chance.gauss(1, 0.5)],
                   "arrival": time + (chance.uniform(0, LATEST) if chance.random() < 1 / 3 else 0.0)}  # fmt: skip
            item |= {"inputs": [chance.gauss(0, 0.1)]} if i % 6 == 0 else {}
            results += [item] * (2 if chance.random() < 0.1 else 1)
    return [json.dumps(item).encode() + b"\n" for item in sorted(results, key=lambda item: item["arrival"])]


class Running:
    """`heliograph serve` in a process of its own; `known` has the lines that came out of it."""

    def __init__(self, network: Path, store: Path):
        options = "--store", str(store), "--window", str(WINDOW)
        command = [sys.executable, "-m", "heliograph", "serve", str(network), *options]
        self.process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        self.known: list[dict[str, Any]] = []
        self._reader = Thread(target=self._read)
        self._reader.start()

    def _read(self) -> None:
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.endswith(b"\n"):  # a line that the kill cut is published again
                self.known.append(json.loads(line))

    def write(self, lines: list[bytes]) -> None:
        """Send these, a part at a time, and then the end; until it no longer listens."""
        assert self.process.stdin is not None
        try:
            for begin in range(0, len(lines), PART):
                self.process.stdin.write(b"".join(lines[begin : begin + PART]))
                self.process.stdin.flush()
                sleep(PAUSE)
            self.process.stdin.close()
        except BrokenPipeError:
            return

    def end(self) -> int:
        """Wait for its end; its exit code."""
        assert self.process.stdin is not None and self.process.stdout is not None
        code = self.process.wait()
        self._reader.join()
        self.process.stdout.close()
        with suppress(BrokenPipeError):
            self.process.stdin.close()
        return code


def killed(count: int, seed: int, folder: Path) -> dict[str, Any]:
    """What became of a service that was killed so often."""
    chance, sent = random.Random(seed), messages(seed)
    network, store = folder / "network.py", folder / "killed.db"
    network.write_text(NETWORK)
    known, differently = dict[int, dict[str, Any]](), 0
    for kill in range(count + 1):
        running = Running(network, store)
        writer = Thread(target=running.write, args=(sent,))
        writer.start()
        if kill < count:
            while not running.known and running.process.poll() is None:  # before the first answer nothing can be lost
                sleep(PAUSE)
            sleep(chance.uniform(0, PAUSE * len(sent) / PART))
            running.process.send_signal(signal.SIGKILL)
        writer.join()
        code = running.end()
        for item in running.known:
            if "id" in item:
                differently += known.setdefault(item["id"], item) != item
    outcome = compared(network, store, sent, known)
    return {"kills": count, "messages": len(sent), "exit_code": code, "told_differently": differently, **outcome}


def compared(network: Path, store: Path, sent: list[bytes], known: dict[int, dict[str, Any]]) -> dict[str, Any]:
    """The store against that of a service that was never disturbed, and what was read against the journal."""
    fleet = Fleet(NetworkProgram(load_network(str(network))), Options(WINDOW, AHEAD))
    mine = identity(fleet)
    calm = Service(fleet, Store(str(store.with_name("calm.db")), mine))
    calm.take(sent)
    names, both = [f"p{i}" for i in range(PLANTS)], []
    for place in (calm.store, Store(str(store), mine)):
        assert isinstance(place, Store)
        plants = {name: unpack_plant(name, item.body, fleet) for name, item in place.load(names).items()}
        for plant in plants.values():
            plant.links = {}  # what came again was counted
        rows = {entry.number: json.loads(entry.body) for entry in place.entries()}
        finals = sorted(
            (row["plant"], row["time"], row["estimates"]) for row in rows.values() if row["kind"] == "final"
        )
        place.close()
        both.append(({name: pack_plant(plant, fleet) for name, plant in plants.items()}, finals))
    (states, finals), (killed_states, killed_finals) = both
    moments = [(plant, time) for plant, time, _ in killed_finals]
    return {
        "states_identical": states == killed_states,
        "finals": len(finals),
        "finals_identical": finals == killed_finals,
        "counted_twice": len(moments) - len(set(moments)),
        "lost": sum(number not in known for number in rows),
        "told_and_not_kept": sum(rows.get(number) != item for number, item in known.items()),
    }


def sound(outcome: dict[str, Any]) -> bool:
    """Whether nothing changed."""
    clean = all(
        outcome[name] == 0 for name in ("exit_code", "told_differently", "counted_twice", "lost", "told_and_not_kept")
    )
    return clean and outcome["states_identical"] and outcome["finals_identical"] and outcome["finals"] > 0


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        result = killed(int(sys.argv[1]) if len(sys.argv) > 1 else 50, 0, Path(folder))
    print(json.dumps(result))
    sys.exit(not sound(result))
