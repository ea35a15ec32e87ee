"""Every benchmark: ours beside its peers, as ratios of one session on one machine, in a table and in results.json.

Run: python benchmarks/run.py [--without-peers] [--old SRC]; the former for machines without a network, the latter
measures another release beside ours: by number of nodes, and its programs of the same names in turn with ours.

Peers and ours are programs (benchmarks/peers) that read one file of data. Their estimates are compared first; then
each is asked for one pass in turn, ROUNDS times, and the least time of each counts. Nobody's threads are restricted,
and every program has chosen its best width of a batch before.

results.json: date, load (of the machine, before), machine, threads, and `comparisons` and `alone` by name.
A comparison has title, unit, runs, steps, floor (arithmetic, memory), distance (ours over the larger), ours, and peers
by title. Each of these has best, median, processors (the least time of all threads together), how, runs and versions; a
peer also difference (None: it computes something else, as its title says), ratio, target and met, or only absent, the
reason. Where another release was measured, old_release has its best and median, the difference, and how many times as
long ours takes. A benchmark alone has unit, values, at_most and met.
"""

import argparse
import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from peers import machine, problems
from peers.environments import python_of
from peers.running import Running, program_of

HERE = Path(__file__).resolve().parent
RESULTS = HERE / "results.json"
ROUNDS = 15
OTHER = "heliograph, the other release"
AGREEMENT = 1e-8  # largest difference of any estimate; all are of order one
SINGLE = 1e-4  # the same of single precision: a hundred steps of its eps, over gains of order one
ALONE = (
    "startup", "stream", "timeline", "nodes", "h_infinity", "quadratic", "successive_relays", "cubature_fusion",
    "links_with_memory", "event_triggered", "fleet", "network_design", "robust", "own_filters", "particles",
)  # fmt: skip
WITH_PEERS = ("learning", "one_series")  # like those alone, but they ask peers of their own


class Program(NamedTuple):
    """A file of benchmarks/peers, what the table calls it, the environment it needs, and how much faster we shall be.

    `target` None: no aim. `same` False: it computes something else, which its title says, and is not compared.
    `agreement`: how far its estimates may be from ours, which are of order one.
    """

    file: str
    title: str
    environment: str | None = None
    target: float | None = None
    same: bool = True
    source: Path | None = None  # the src folder of another release of ours
    agreement: float = AGREEMENT


class Comparison(NamedTuple):
    """A problem and who solves it."""

    problem: Callable[[], problems.Problem]
    ours: Program
    peers: tuple[Program, ...]


def torch_kf(what: str) -> tuple[Program, Program]:
    """Filtering or smoothing by torch-kf in double and in single precision."""
    return (
        Program(f"{what}_planned_torch_kf_double", "torch-kf", "torch-kf"),
        Program(f"{what}_planned_torch_kf_single", "torch-kf, single precision", "torch-kf", agreement=SINGLE),
    )


COMPARISONS = {
    "kalman": Comparison(
        problems.kalman,
        Program("kalman_heliograph", "heliograph"),
        (
            Program("kalman_cuthbert", "cuthbert, vectorised", "cuthbert", target=25),
            Program("kalman_numpy", "NumPy, stacked matrices", target=8),
            Program("kalman_filterpy", "FilterPy, a loop", "filterpy", target=250),
        ),
    ),
    "smoothing": Comparison(
        problems.smoothing,
        Program("smoothing_heliograph", "heliograph"),
        (
            Program("smoothing_cuthbert", "cuthbert, vectorised", "cuthbert", target=15),
            Program("smoothing_pykalman", "pykalman, a loop", "pykalman", target=250),
        ),
    ),
    "smoothing_planned": Comparison(
        partial(problems.smoothing, gains_differ=False),
        Program("smoothing_planned_heliograph", "heliograph"),
        (
            Program("smoothing_cuthbert", "cuthbert, vectorised", "cuthbert", target=15),
            *torch_kf("smoothing"),
        ),
    ),
    "filtering_planned": Comparison(
        problems.filtering_planned, Program("filtering_planned_heliograph", "heliograph"), torch_kf("filtering")
    ),
    "modes": Comparison(
        problems.modes,
        Program("modes_heliograph", "heliograph"),
        (Program("modes_filterpy", "FilterPy, a loop", "filterpy", target=200),),
    ),
    "motion": Comparison(
        problems.motion,
        Program("motion_heliograph", "heliograph"),
        (Program("motion_filterpy", "FilterPy, a loop", "filterpy", target=200),),
    ),
    "cubature": Comparison(
        problems.cubature,
        Program("cubature_heliograph", "heliograph"),
        (
            Program("cubature_jax", "jax.numpy.linalg, vectorised", target=3),
            Program("cubature_filterpy", "FilterPy, given the relays' moments", "filterpy"),
            Program("cubature_filterpy_mean_gain", "FilterPy, mean gain only", "filterpy", target=600, same=False),
        ),
    ),
}


def compare(item: Comparison, rates: dict[str, Any], with_peers: bool, old: str | None = None) -> dict[str, Any]:
    """All programs on one problem, as it stands in results.json."""
    problem = item.problem()
    runs, steps = problem.arrays["z"].shape[:2]
    other = None if old is None else earlier(item.ours, Path(old))
    requested = (item.ours, *item.peers) if other is None else (item.ours, other, *item.peers)
    results = {program: interpreter(program, with_peers) for program in requested}
    running = together(problem, {program: python for program, python in results.items() if isinstance(python, Path)})
    ours = running[item.ours].result()
    floor = {"arithmetic": problem.flops / rates["gflops"], "memory": problem.bytes / rates["gbytes"]}
    peers = {
        peer.title: judged(peer, running[peer], running[item.ours]) if peer in running else {"absent": results[peer]}
        for peer in item.peers
    }
    result: dict[str, Any] = {
        "title": problem.title, "unit": "ns per step and run", "runs": runs, "steps": steps,
        "floor": {name: round(value, 2) for name, value in floor.items()},
        "distance": round(ours["best"] / max(floor.values()), 1), "ours": ours, "peers": peers,
    }  # fmt: skip
    return result if other is None else result | {"old_release": compared(running[other], running[item.ours])}


def earlier(ours: Program, source: Path) -> Program | None:
    """The same program of another release, if it has one: in turn with ours, so that a ratio means something."""
    return ours._replace(title=OTHER, source=source) if program_of(source, ours.file).exists() else None


def compared(its: Running, ours: Running) -> dict[str, Any]:
    """Another release's times, and how many times as long ours takes: of the best, and from one pass to the next.

    The latter is the median over the passes: what the machine does beside them slows both of a pair.
    """
    result, local = its.result(), ours.result()
    ratios = np.divide(ours.times, its.times)
    return {
        "best": result["best"], "median": result["median"], "difference": difference(its, ours),
        "ours over it": round(local["best"] / result["best"], 3), "in turn": round(float(np.median(ratios)), 3),
    }  # fmt: skip


def together(problem: problems.Problem, pythons: dict[Program, Path]) -> dict[Program, Running]:
    """Start every program, ours first, compare their estimates, and time them in turn."""
    running: dict[Program, Running] = {}
    with tempfile.TemporaryDirectory() as folder:
        data = Path(folder) / "problem.npz"
        np.savez(data, **problem.arrays)
        try:
            for program, python in pythons.items():
                running[program] = Running(program.file, python, data, program.source)
            ours, *peers = running
            for peer in peers:
                if peer.same:
                    check_agreement(peer.file, difference(running[peer], running[ours]), peer.agreement)
            for _ in range(ROUNDS):
                for item in running.values():
                    item.ask()
        finally:
            for item in running.values():
                item.stop()
    return running


def interpreter(peer: Program, with_peers: bool) -> Path | str:
    """The Python that runs a peer, or the reason why none does."""
    if peer.environment is None:
        return Path(sys.executable)
    if not with_peers:
        return "left out: run without peers"
    try:
        return python_of(peer.environment)
    except RuntimeError as error:
        return str(error)


def difference(peer: Running, ours: Running) -> float:
    """Largest difference of a peer's means from ours, on the runs that it took."""
    return float(np.abs(peer.means - ours.means[: len(peer.means)]).max())


def check_agreement(name: str, gap: float, most: float = AGREEMENT) -> None:
    """End everything where estimates differ by more than rounding: a time of something else says nothing."""
    if not gap <= most:
        raise SystemExit(f"{name}: expected our estimates within {most:g}, got a difference of {gap:g}")


def judged(peer: Program, its: Running, ours: Running) -> dict[str, Any]:
    """A peer's times, how many times faster ours is, and whether that is enough."""
    result = its.result()
    ratio = round(result["best"] / ours.result()["best"], 2)
    gap = difference(its, ours) if peer.same else None
    met = None if peer.target is None else ratio >= peer.target
    return {**result, "difference": gap, "ratio": ratio, "target": peer.target, "met": met}


def alone(name: str, old: str | None) -> dict[str, Any]:
    """A benchmark without peers, in a process of its own: two of them restrict threads before anything is loaded."""
    code = f"import json, {name}; print(json.dumps({name}.measure({repr(old) if name == 'nodes' else ''})))"
    completed = subprocess.run([sys.executable, "-c", code], cwd=HERE, stdout=subprocess.PIPE, text=True, check=True)
    measured = json.loads(completed.stdout.splitlines()[-1])
    measured["values"] = {key: float(f"{value:.4g}") for key, value in measured["values"].items()}
    met = {key: measured["values"][key] <= most for key, most in measured["at_most"].items()}
    return {**measured, "met": met}


def show_comparison(c: dict[str, Any]) -> None:
    print(f"\n{c['title']}\n{c['runs']:,} runs of {c['steps']} steps; {c['unit']}")
    print(f"  {'':<36}{'best':>11}{'median':>11}{'ratio':>9}{'target':>8}{'met':>5}{'difference':>12}")
    ours = c["ours"]
    print(f"  {'heliograph':<36}{ours['best']:>11,.1f}{ours['median']:>11,.1f}  {ours['how']}")
    print(f"  {'of processors, all threads':<36}{ours['processors']:>11,.1f}")
    for title, p in c["peers"].items():
        if "absent" in p:
            print(f"  {title:<36}{p['absent']}")
            continue
        gap = "other model" if p["difference"] is None else f"{p['difference']:.0e}"
        print(f"  {title:<36}{p['best']:>11,.1f}{p['median']:>11,.1f}{p['ratio']:>9.1f}{p['target'] or '-':>8}"
              f"{word(p['met']):>5}{gap:>12}  {p['how']}")  # fmt: skip
    if "old_release" in c:
        old = c["old_release"]
        times = f"ours takes {old['ours over it']} (best) and {old['in turn']} (in turn) times as long"
        print(f"  {OTHER:<36}{old['best']:>11,.1f}{old['median']:>11,.1f}  {times}; difference {old['difference']:.0e}")
    floor = c["floor"]
    print(
        f"  floor: arithmetic {floor['arithmetic']}, memory {floor['memory']}; ours takes {c['distance']} times as long"
    )


def show_alone(name: str, b: dict[str, Any]) -> None:
    print(f"\n{name}; {b['unit']}")
    for key, value in b["values"].items():
        limit = f"at most {b['at_most'][key]:g}: {word(b['met'][key])}" if key in b["at_most"] else ""
        print(f"  {key:<36}{value:>11,.4g}  {limit}")


def word(met: bool | None) -> str:
    return "-" if met is None else "yes" if met else "no"


def main() -> None:
    parser = argparse.ArgumentParser(description="Run every benchmark and write benchmarks/results.json.")
    parser.add_argument("--without-peers", action="store_true", help="leave out what needs a peer's environment")
    parser.add_argument("--old", help="the src folder of another release, measured beside ours")
    chosen = parser.parse_args()
    with_peers = not chosen.without_peers
    load, rates = os.getloadavg()[0], machine.describe()
    print(f"{rates['cpu']}, {rates['cores']} cores, {rates['gflops']} Gflop/s, {rates['gbytes']} GB/s; load {load:.1f}")
    comparisons, others = {}, {}
    for name, item in COMPARISONS.items():
        comparisons[name] = compare(item, rates, with_peers, chosen.old)
        show_comparison(comparisons[name])
    for name in (*ALONE, *(WITH_PEERS if with_peers else ())):
        others[name] = alone(name, chosen.old)
        show_alone(name, others[name])
    results = {
        "date": datetime.now(UTC).date().isoformat(), "load": round(load, 2), "machine": rates,
        "threads": "comparisons: no program's threads are restricted; alone: quadratic and successive_relays on one",
        "comparisons": comparisons, "alone": others,
    }  # fmt: skip
    RESULTS.write_text(json.dumps(results, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
