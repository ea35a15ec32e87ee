"""Commands that are interrupted at random moments by SIGINT and SIGTERM, and the damage: there may be none.

Run: python benchmarks/interruptions.py [COUNT]. Each command announces its stages; a signal comes a random while
after a random one. Damage is another exit code than that of the signal (or 0, where the command was done; a service
always ends with 0 once it serves), anything on stderr but one line that begins with "heliograph:", a file that is half
written or left over, a fit that had begun to search and saved nothing. Exit code 1 if there is any.
"""

import json
import os
import random
import signal
import subprocess
import sys
import tempfile
from contextlib import suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from select import select
from time import monotonic, sleep

NETWORK = """
import heliograph as hg
plant = hg.LinearPlant([[0.95]], hg.free(0.5, "plant noise"), [0.0], 1.0)
sensor = hg.LinearSensor([[1.0]], 0.05, outputs=["far"])
channel = hg.hop(1.0, noise=hg.free(0.5, "hop noise"))
filters = {"aware": hg.linear_filter(plant, sensor, channel)}
network = hg.Network(plant, {"a": hg.Node(sensor, hg.erasure(channel, 0.9), filters)})
def build(noise=0.5):
    return network
"""
YARD = """
import heliograph as hg
plant, sensor = hg.LinearPlant([[0.95]], 0.5, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.05)
def at(x, y):
    far = hg.hop(hg.Discrete([0.5 / (1 + x**2 + y**2), 1 / (1 + x**2 + y**2)], [0.5, 0.5]), 0.2)
    return hg.Network(plant, {"near": hg.Node(sensor, hg.hop(0.8, 0.2), {}), "far": hg.Node(sensor, far, {})})
network = at(1.0, 0.0)
"""
DESIGN = """
network = "yard.py"
budget = 2.0
path_loss_exponent = 2.0
[map]
network = "yard.py:at"
x = [0.0, 1.0]
y = [0.0, 1.0]
points = 5
"""
CAMPAIGN = """
network = "net.py:build"
horizon = 50
runs = 4096
chunk = 512
[grid]
noise = [0.1, 0.2, 0.3]
"""
# A program that is the command, and announces its stages and where it is in reading the network on a pipe.
PROGRAM = """
import os, signal, sys
signal.signal(signal.SIGINT, signal.default_int_handler)  # what runs in the background ignores it
def say(stage):
    os.write({pipe}, (stage + "\\n").encode())
class Finder:
    def find_spec(self, name, path=None, target=None):
        if name in ("heliograph.cli", "heliograph.files.network_file", "jax"):
            say(name)
        if name == "heliograph.report.results_folder":
            import heliograph.report.progress as module
            bar = module.progress
            from contextlib import contextmanager
            @contextmanager
            def progress(stages):
                with bar(stages) as advance:
                    def announced(what, done=0, total=0):
                        advance(what, done, total)
                        say(what)
                    yield announced
            module.progress = progress
sys.meta_path.insert(0, Finder())
sys.argv[:1] = ["heliograph"]
from heliograph.__main__ import command  # before this is the interpreter's own start
wait = signal.signal
def heard(number, handler):  # the first that the command does
    signal.signal = wait
    known = wait(number, handler)
    say("start")
    return known
signal.signal = heard
command()
"""
COMMANDS: dict[str, tuple[str, ...]] = {
    "fit": ("fit", "net.py", "--measurements", "data.csv", "--out", "out", "--starts", "2"),
    "run": ("run", "net.py", "--measurements", "data.csv", "--out", "out.csv", "--report", "report"),
    "check": ("check", "net.py"),
    "serve": ("serve", "net.py", "--store", "store.db"),
    "demo": ("demo", "--out", "out"),
    "reproduce": ("reproduce", "quadratic-bias", "--out", "out", "--runs", "200"),
    "sweep": ("sweep", "campaign.toml", "--out", "out", "--workers", "1"),
    "design": ("design", "design.toml", "--out", "out"),
}
STAGES = {"fit": 14, "run": 6, "check": 3, "serve": 3, "demo": 7, "reproduce": 7, "sweep": 3, "design": 25}  # announced
SHARES = {"fit": 8, "run": 3, "check": 1, "serve": 3, "demo": 2, "reproduce": 2, "sweep": 1, "design": 3}
AFTER = 1.5  # seconds, at most, from a stage to the signal
PATIENCE = 120.0  # seconds in which a command has to end
KEPT = {"out", "out.csv", "report", "store.db", "store.db-wal", "store.db-shm", "store.db.lock"}


@dataclass(frozen=True)
class Interruption:
    """One interruption: what was interrupted, when, and how it ended."""

    command: str
    signal: str
    stage: str
    after: float
    code: int
    seconds: float
    said: str
    left: tuple[str, ...]
    damage: str


def prepared(folder: Path) -> None:
    """Write a network and its data."""
    (folder / "net.py").write_text(NETWORK)
    (folder / "yard.py").write_text(YARD)
    (folder / "campaign.toml").write_text(CAMPAIGN)
    (folder / "design.toml").write_text(DESIGN)
    chance, state, lines = random.Random(1), 0.0, ["time,far"]
    for row in range(4000):
        state = 0.95 * state + chance.gauss(0, 0.4)
        lines.append(f"{row},{state + chance.gauss(0, 0.8):.6f}" if chance.random() < 0.9 else f"{row},")
    (folder / "data.csv").write_text("\n".join(lines) + "\n")


def interrupt(name: str, number: signal.Signals, stages: int, after: float, folder: Path) -> Interruption:
    """Interrupt a command some time after so many of its announcements."""
    before = {path.name for path in folder.iterdir()}
    pipe, end = os.pipe()
    process = subprocess.Popen(
        [sys.executable, "-c", PROGRAM.format(pipe=end), *COMMANDS[name]], cwd=folder, pass_fds=[end], text=True,
        stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.PIPE, start_new_session=True)  # fmt: skip
    os.close(end)
    stage, seen = _stage(process, pipe, stages)
    sleep(after)
    begun = monotonic()
    with suppress(ProcessLookupError):  # a Ctrl-C is for all processes of the group, a SIGTERM for one
        (os.killpg if number is signal.SIGINT else os.kill)(process.pid, number)
    try:
        said = process.communicate(timeout=PATIENCE)[1]
    except subprocess.TimeoutExpired:
        process.kill()
        said = "it did not end\n" + process.communicate()[1]
    os.close(pipe)
    seconds, left = monotonic() - begun, tuple(sorted({path.name for path in folder.iterdir()} - before))
    damage = _damage(name, number, seen, process.returncode, said, left)
    return Interruption(name, number.name, stage, after, process.returncode, seconds, said[-2000:], left, damage)


def _stage(process: "subprocess.Popen[str]", pipe: int, stages: int) -> tuple[str, list[str]]:
    """Wait for so many announcements, or until there are no more for a while."""
    seen: list[str] = []
    while len(seen) < stages and process.poll() is None and select([pipe], [], [], 10.0 if seen else 60.0)[0]:
        text = os.read(pipe, 65536).decode()
        if not text:
            break
        seen += text.splitlines()
    return (seen[-1] if seen else ""), seen


def _damage(name: str, number: signal.Signals, seen: list[str], code: int, said: str, left: tuple[str, ...]) -> str:
    if code not in (0, 128 + number, -number):  # the last two are one to a shell
        return f"exit code {code}"
    lines = said.splitlines()
    if len(lines) > 1 or any(not line.startswith("heliograph:") for line in lines):
        return "words on stderr"
    if set(left) - KEPT:
        return f"left over: {sorted(set(left) - KEPT)}"
    searching = sum(stage.startswith("learning from") for stage in seen) > 1
    if name == "fit" and (searching or code == 0) and "out" not in left:
        return "a fit that had begun saved nothing"
    return ""


def interruptions(count: int, seed: int = 0, names: tuple[str, ...] = tuple(COMMANDS)) -> list[Interruption]:
    """Interrupt commands, drawn by their shares, at random moments."""
    chance, results = random.Random(seed), []
    for _ in range(count):
        name = chance.choices(names, [SHARES[name] for name in names])[0]
        number = chance.choice([signal.SIGINT, signal.SIGTERM])
        stages, after = chance.randint(1, STAGES[name]), chance.uniform(0, AFTER) * chance.choice([0.1, 1.0])
        with tempfile.TemporaryDirectory() as place:
            prepared(Path(place))
            results.append(interrupt(name, number, stages, after, Path(place)))
    return results


if __name__ == "__main__":
    total, damaged = int(sys.argv[1]) if len(sys.argv) > 1 else 200, 0
    in_time = 0  # before the command was done
    for index in range(total):
        (one,) = interruptions(1, index)
        damaged += bool(one.damage)
        in_time += one.code != 0 or one.command == "serve"
        print(json.dumps(asdict(one)), flush=True)
    print(json.dumps({"interruptions": total, "in_time": in_time, "with_damage": damaged}))
    sys.exit(damaged > 0)
