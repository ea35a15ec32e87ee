"""Ten thousand random networks: no result that is no number goes unflagged, and no claim is broken.

Run: python benchmarks/soak.py [COUNT]. What is done is kept in out/soak.jsonl, so that a later start goes on; another
seed or another release starts anew. Writes benchmarks/soak.json. Networks of one structure share what is compiled, so
that one process after another takes a structure whole; compiling in a hurry pays, since little is simulated.

Each network is simulated RUNS times. An estimate that is not finite, or a covariance that is indefinite, must be among
the failures that the statistics list. Where "exact" or "upper" is claimed, e_d^2 is compared with the claimed variance
at every step, along every component and one direction of all; what lies beyond SUSPECT standard errors is simulated
again with more runs and another seed, and what lies there beyond them at that place with more still: a claim is broken
beyond the quantile that all comparisons together exceed by chance with probability FALSE_ALARM. Every SCALED-th
network, of all structures in turn, is also rescaled.
"""

import json
import multiprocessing
import os
import subprocess
import sys
import time
import traceback
import warnings
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import ProcessPoolExecutor, as_completed
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import numpy as np
from scipy import stats
from soak_networks import HORIZON, STRUCTURES, network

import heliograph as hg
from heliograph.testing import check_scaling

HERE = Path(__file__).resolve().parent
DONE, RESULTS = HERE.parent / "out" / "soak.jsonl", HERE / "soak.json"
COUNT, SEED, RUNS, SCALED = 10_000, 1, 256, 49
AGAIN = 2_048, 20_480  # runs of what is looked at again, and once more
SUSPECT, FALSE_ALARM = 4.0, 1e-3
WORST = 10  # cases kept
ROUNDING = 1e-12  # of a state's size: what a dozen steps in double precision may be off
HURRY = "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"


class Place(NamedTuple):
    """Where a claim looks worst: its excess in standard errors, the step and the direction."""

    z: float
    step: int
    direction: np.ndarray


def excesses(result: Any, directions: np.ndarray, reach: np.ndarray | float = 0.0) -> np.ndarray:
    """(mean e_d^2 - claimed variance) in its standard errors, (time, direction); inf where a certainty is wrong.

    A state that is known may be off by the rounding of its own size, `reach` (n,).
    """
    gap = np.einsum("di,btij,dj->btd", directions, result.outer - result.covariance, directions)
    size = np.einsum("di,btij,dj->td", directions, result.covariance, directions) / result.runs
    used = result.count > 0
    gap, count = gap[used], result.count[used][:, None, None]
    mean = gap.sum(axis=0) / count.sum()
    spread = np.sqrt(np.sum((gap - mean * count) ** 2, axis=0) * len(gap) / (len(gap) - 1)) / count.sum()
    rounding = (ROUNDING * np.sum(np.abs(directions) * reach, axis=1)) ** 2
    certain = (spread <= 1e-9 * np.abs(size)) | (np.abs(size) <= rounding)
    off = np.where(np.abs(mean) <= 1e-6 * np.abs(size) + rounding + 1e-300, 0.0, np.copysign(np.inf, mean))
    return np.where(certain, off, mean / np.where(certain, 1.0, spread))


def directions_of(result: Any, random: np.random.Generator) -> np.ndarray:
    """Unit components, and one random direction in units of each component's own deviation."""
    deviation = np.sqrt(np.maximum(np.diagonal(result.claimed(), axis1=1, axis2=2).max(axis=0), 0.0))
    unit = np.where(deviation > 0, deviation, 1.0)
    return np.concatenate([np.eye(len(unit)), (random.normal(size=len(unit)) / unit)[None]])


def reach_of(plant: Any) -> np.ndarray:
    """How far from zero the states may come in HORIZON steps: the mean, and a deviation of what is random."""
    start, noise = (np.sqrt(np.diag(np.asarray(c))) for c in (plant.initial_covariance, plant.noise.covariance))
    sizes = [np.abs(np.asarray(plant.initial_mean)) + start]
    for _ in range(HORIZON):
        moved = np.abs(plant.matrix) @ sizes[-1] if isinstance(plant, hg.LinearPlant) else sizes[-1] + 1
        sizes.append(moved + noise)
    return np.asarray(np.max(sizes, axis=0))


def worst_place(result: Any, random: np.random.Generator, reach: np.ndarray | float = 0.0) -> Place:
    """The largest excess; of an exact claim also the largest lack."""
    directions = directions_of(result, random)
    z = excesses(result, directions, reach)
    judged = np.abs(z) if result.claim == "exact" else z
    step, place = np.unravel_index(int(np.nanargmax(judged)), z.shape)
    return Place(float(z[step, place]), int(step), directions[place])


def beyond(z: float, claim: str) -> float:
    """How far a claim is from what it says: an exact one in both directions."""
    return abs(z) if claim == "exact" else z


def hidden(result: Any) -> bool:
    """Whether something that is no number, or no covariance, is not among the failures."""
    if result.failed_runs:
        return False
    if not np.all(np.isfinite(result.outer)):
        return True
    if result.claim == "none":
        return False
    claimed = result.claimed()
    if not (np.all(np.isfinite(claimed)) and np.all(np.isfinite(result.nees[..., :0]))):
        return True
    unit = np.sqrt(np.abs(np.diagonal(claimed, axis1=1, axis2=2)))
    unit = np.where(unit > 0, unit, 1.0)
    return bool(np.min(np.linalg.eigvalsh(claimed / (unit[:, :, None] * unit[:, None]))) < -1e-9)


def looked_at_again(
    place: Place, claim: str, again: Callable[[int], Any], at: tuple[str, str], reach: np.ndarray
) -> tuple[float, int]:
    """The excess at a place, by more runs and more still while it is a suspect's, and how many runs it is from."""
    z, looked = place.z, 0
    for runs in AGAIN:
        if beyond(z, claim) <= SUSPECT:
            break
        z, looked = float(excesses(again(runs)[at[0]][at[1]], place.direction[None], reach)[place.step, 0]), runs
    return z, looked


def soak(index: int) -> dict[str, Any]:
    """Everything about one network, as it is kept."""
    result: dict[str, Any] = {
        "index": index,
        "comparisons": 0,
        "hidden": [],
        "suspects": [],
        "flagged": [],
        "claims": {},
    }
    try:
        item = network(index, SEED)
    except ValueError as error:
        return result | {"refused": str(error)}
    statistics = hg.monte_carlo(item, HORIZON, RUNS, index, keep=hg.Statistics())
    result["flagged"] = statistics.failures()

    @cache
    def again(runs: int) -> Any:
        return hg.monte_carlo(item, HORIZON, runs, index + 10**6, keep=hg.Statistics(), chunk=RUNS)

    random, reach = np.random.default_rng([SEED, 2, index]), reach_of(item.plant)
    claims: Counter[str] = Counter()
    for node, filters in statistics.items():
        for name, filter_ in filters.items():
            claims[filter_.claim] += 1
            if hidden(filter_):
                result["hidden"].append(f"{node}/{name}")
            if filter_.claim not in ("exact", "upper") or filter_.failed_runs:
                continue
            place = worst_place(filter_, random, reach)
            result["comparisons"] += filter_.outer.shape[1] * (filter_.outer.shape[2] + 1)
            z, runs = looked_at_again(place, filter_.claim, again, (node, name), reach)
            if runs:
                at = {"at": f"{node}/{name}", "claim": filter_.claim, "step": place.step, "first": place.z}
                result["suspects"].append(at | {"again": z, "runs": runs})
    result["claims"] = dict(claims)
    if index % SCALED == 0:
        result["scaling"] = scaling(item)
    return result


def scaling(item: hg.Network) -> str:
    """What `check_scaling` has to say, empty if nothing."""
    try:
        check_scaling(item, steps=HORIZON)
    except (AssertionError, ValueError) as error:
        return str(error)
    return ""


def release() -> str:
    """What decides about the results: the sources' tree."""
    paths = ["src", "benchmarks/soak.py", "benchmarks/soak_networks.py"]
    completed = subprocess.run(["git", "ls-files", "-s", "--", *paths], cwd=HERE.parent, capture_output=True, text=True)
    return str(hash_of(completed.stdout))


def hash_of(text: str) -> str:
    """A short checksum."""
    from hashlib import sha256

    return sha256(text.encode()).hexdigest()[:16]


def recorded(key: dict[str, Any]) -> dict[int, dict[str, Any]]:
    """What an earlier start with the same key has done; a line cut short is done again."""
    if not DONE.exists():
        return {}
    rows = []
    for line in DONE.read_text().splitlines():
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return {row["index"]: row for row in rows if row.get("key") == key}


def summary(rows: list[dict[str, Any]], key: dict[str, Any]) -> dict[str, Any]:
    """The counts, and the worst cases."""
    comparisons = sum(row["comparisons"] for row in rows)
    limit = float(stats.norm.isf(FALSE_ALARM / 2 / max(comparisons, 1)))
    suspects = [s | {"index": row["index"]} for row in rows for s in row["suspects"]]

    suspects.sort(key=lambda s: beyond(s["again"], s["claim"]), reverse=True)
    claims: Counter[str] = Counter()
    for row in rows:
        claims.update(row["claims"])
    scaled = [row for row in rows if "scaling" in row]
    return {
        **key,
        "networks": len(rows),
        "refused": Counter(row["refused"].split(":")[0] for row in rows if "refused" in row),
        "errors": [{"index": row["index"], "error": row["error"]} for row in rows if "error" in row],
        "estimates by claim": claims,
        "comparisons": comparisons,
        "limit in standard errors": limit,
        "broken claims": [s for s in suspects if beyond(s["again"], s["claim"]) > limit],
        "simulated again": len(suspects),
        "worst": suspects[:WORST],
        "unflagged": [{"index": row["index"], "at": row["hidden"]} for row in rows if row["hidden"]],
        "networks with flagged failures": sum(bool(row["flagged"]) for row in rows),
        "flagged": [{"index": row["index"], "failures": row["flagged"]} for row in rows if row["flagged"]][:WORST],
        "rescaled": len(scaled),
        "depend on units": [{"index": row["index"], "what": row["scaling"]} for row in scaled if row["scaling"]],
        "seconds": round(sum(row["seconds"] for row in rows), 1),
    }


def tried(index: int) -> dict[str, Any]:
    """What `soak` finds, or the bug that it came upon, which is what is looked for: the others shall be tried too."""
    try:
        return soak(index)
    except Exception:
        nothing: dict[str, Any] = {"comparisons": 0, "hidden": [], "suspects": [], "flagged": [], "claims": {}}
        return nothing | {"index": index, "error": traceback.format_exc(limit=-3)}


def work(indices: list[int], key: dict[str, Any]) -> int:
    """Try these networks and keep each as it is done; a line is written at once, so that processes share the file."""
    warnings.simplefilter("ignore")
    file = os.open(DONE, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    for index in indices:
        begun = time.perf_counter()
        row = tried(index) | {"seconds": time.perf_counter() - begun, "key": key}
        os.write(file, (json.dumps(row) + "\n").encode())
    os.close(file)
    jax.clear_caches()
    return len(indices)


def by_structure(left: list[int]) -> Iterator[list[int]]:
    """The networks that are to be tried, structure by structure."""
    for structure in range(STRUCTURES):
        alike = [index for index in left if index % STRUCTURES == structure]
        if alike:
            yield alike


def main(count: int) -> int:
    """Do what is not done, then sum up; 1 if a promise is broken."""
    os.environ.setdefault("XLA_FLAGS", HURRY)  # read by the processes that are started below
    key = {"seed": SEED, "runs": RUNS, "structures": STRUCTURES, "release": release()}
    DONE.parent.mkdir(exist_ok=True)
    left = sorted(set(range(count)) - set(recorded(key)))
    done = count - len(left)
    with ProcessPoolExecutor(os.cpu_count(), multiprocessing.get_context("spawn"), compile_in_a_hurry) as pool:
        for job in as_completed([pool.submit(work, alike, key) for alike in by_structure(left)]):
            done += job.result()
            print(f"\r{done:,} of {count:,} networks", end="", file=sys.stderr)
    rows = recorded(key)
    result = summary([rows[i] for i in sorted(rows) if i < count], key)
    RESULTS.write_text(json.dumps(result, indent=1) + "\n")
    wrong = {name: len(result[name]) for name in ("errors", "broken claims", "unflagged", "depend on units")}
    print(f"\n{result['networks']:,} networks, {result['comparisons']:,} comparisons: {wrong}")
    return int(any(wrong.values()))


def compile_in_a_hurry() -> None:
    """Before JAX compiles anything in this process: five steps of a few hundred runs are not worth an optimisation."""
    jax.config.update("jax_disable_most_optimizations", True)


if __name__ == "__main__":
    sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else COUNT))
