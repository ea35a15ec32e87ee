"""Two thousand random programs by native code and by XLA: loops, branches, gathers, scatters, integers, matrices.

Run: python benchmarks/random_programs.py [COUNT [FIRST]]: programs FIRST, FIRST + 1, ... What is done is kept in
out/random_programs.jsonl, so that a later start goes on; another release starts anew. Each program follows from its
number alone; one that differs is printed with it, and `--show NUMBER` prints any. Ends with an error where one differs,
fails or ends the process.

Numbers may differ as far as rounding moves them: XLA also computes each program with every rounded result moved by a
few units of its last place, and what these results decide, such as which branch is taken, is not compared. Matrices
that are solved or factored hold finite numbers: of others every library makes its own. Programs whose difference is
explained are listed in EXPLAINED with the reason: they are printed and counted apart, and are no error.
"""

import json
import os
import subprocess
import sys
import time
import traceback
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from programs.flow import program

HERE = Path(__file__).resolve().parent
DONE = HERE.parent / "out" / "random_programs.jsonl"
COUNT, TOGETHER = 2_000, 25  # programs, and how many of them a process tries
EXPLAINED = {  # programs that differ, each looked into
    988: "a scatter adds 0 times NaN: NaN by IEEE's rules and here, 0 by XLA, which leaves the product out",
    999: "an inverse of condition 2e5: of exact fractions native code is 4e-13 off, XLA 7e-13",
    1876: "an inverse of a matrix as nearly singular as that of 999: off by its condition in both",
    2298: "it iterates tan and powers of large numbers: chaos, which magnifies each rounding",
}
HURRY = "--xla_cpu_use_fusion_emitters=false --xla_cpu_parallel_codegen_split_count=1"


def release() -> str:
    """What decides about the results: the sources' tree."""
    from hashlib import sha256

    paths = ["src/straightline", "benchmarks/programs"]
    listed = subprocess.run(["git", "ls-files", "-s", "--", *paths], cwd=HERE.parent, capture_output=True, check=False)
    return sha256(listed.stdout).hexdigest()[:16]


def recorded(key: str) -> dict[int, dict[str, Any]]:
    """What an earlier start of this release has done; a line cut short is done again."""
    rows = []
    for line in DONE.read_text().splitlines() if DONE.exists() else ():
        try:
            rows.append(json.loads(line))
        except json.JSONDecodeError:
            continue
    return {row["number"]: row for row in rows if row["key"] == key}


def keep(row: dict[str, Any]) -> None:
    """Append a line at once, so that processes share the file."""
    file = os.open(DONE, os.O_WRONLY | os.O_APPEND | os.O_CREAT)
    os.write(file, (json.dumps(row) + "\n").encode())
    os.close(file)


def try_here(numbers: list[int], key: str) -> None:
    """Compare programs in this process, and keep each verdict as it is found."""
    import jax
    from programs.judged import Verdict, judged

    jax.config.update("jax_disable_most_optimizations", True)
    for number in numbers:
        begun = time.perf_counter()
        try:
            verdict = judged(number)
        except Exception:
            verdict = Verdict(f"an error: {traceback.format_exc(limit=-3)}")
        keep({"number": number, "key": key, "seconds": time.perf_counter() - begun, **verdict._asdict()})


def try_apart(numbers: list[int], key: str) -> None:
    """Compare programs in a process of their own; one that ends it is kept as such, and the others go on."""
    left = list(numbers)
    while left:
        command = [sys.executable, __file__, "--these", key, *map(str, left)]
        environment = {"XLA_FLAGS": HURRY, **os.environ}
        ended = subprocess.run(command, env=environment, capture_output=True, text=True, check=False)
        done = recorded(key)
        left = [number for number in left if number not in done]
        if left:
            said = f"the process ended by {ended.returncode}: {ended.stderr.strip().splitlines()[-1:]}"
            nothing = {"refused": "", "compared": 0, "sensitive": 0}
            keep({"number": left[0], "key": key, "seconds": 0.0, "differs": said, **nothing})
            left = left[1:]


def main(count: int, first: int) -> int:
    """Do what is not done, then sum up; 1 if a program differs."""
    key = release()
    DONE.parent.mkdir(exist_ok=True)
    wanted = range(first, first + count)
    left = sorted(set(wanted) - set(recorded(key)))
    parts = [left[i : i + TOGETHER] for i in range(0, len(left), TOGETHER)]
    done = count - len(left)
    with ThreadPoolExecutor(os.cpu_count()) as pool:
        for part, _ in zip(parts, pool.map(lambda part: try_apart(part, key), parts), strict=True):
            done += len(part)
            print(f"\r{done:,} of {count:,} programs", end="", file=sys.stderr, flush=True)
    rows = [row for number, row in sorted(recorded(key).items()) if number in wanted]
    different = [row for row in rows if row["differs"]]
    wrong = [row for row in different if row["number"] not in EXPLAINED]
    for row in wrong:
        print(f"\nProgram {row['number']}: {row['differs']}\n{program(row['number']).text}")
    for row in different:
        if row["number"] in EXPLAINED:
            print(f"\nProgram {row['number']}: {row['differs']}; explained: {EXPLAINED[row['number']]}")
    refused = Counter(row["refused"].split(" at ")[0] for row in rows if row["refused"])
    compared, sensitive = (sum(row[name] for row in rows) for name in ("compared", "sensitive"))
    explained = len(different) - len(wrong)
    print(f"\n{len(rows):,} programs, {compared:,} numbers, {sensitive:,} of them decided by rounding; not taken: "
          f"{refused.total()} {dict(refused)}; different: {len(wrong)}, and {explained} explained")  # fmt: skip
    return int(bool(wrong))


if __name__ == "__main__":
    if sys.argv[1:2] == ["--show"]:
        print(program(int(sys.argv[2])).text)
    elif sys.argv[1:2] == ["--these"]:
        try_here([int(number) for number in sys.argv[3:]], sys.argv[2])
    else:
        sys.exit(main(int(sys.argv[1]) if len(sys.argv) > 1 else COUNT, int(sys.argv[2]) if len(sys.argv) > 2 else 0))
