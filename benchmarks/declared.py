"""The judge of declared variances on a receiver that declares 4.84 m: with a slow error, and without one.

Run: python benchmarks/declared.py [RECORDINGS]. Of each length and kind it draws so many recordings (200 unless given),
and prints in how many `hg.simulation.judge_declared` says that the declared deviation is too large for the white part,
that the error has a memory, and both; and in how many its 95 % intervals hold the true memory or scale. With a bias of
4.84 m and a memory of 300 s both are true; without one neither may be said in more than 1 of 100.
"""

import sys
from collections import Counter
from time import process_time

from tests.simulation.declared_noise.test_judgement import DECLARED, FILTER, MEMORY, WHITE, fixes, said

import heliograph as hg


def count_sentences(rows: int, bias: bool, recordings: int) -> Counter[str]:
    """Count what is said of recordings of one length and kind."""
    counts: Counter[str] = Counter()
    for seed in range(recordings):
        key = [seed, rows] if bias else [seed, rows, 1]
        judgement = hg.simulation.judge_declared(FILTER, fixes(key, rows, bias))
        white, memory = said(judgement.sentences())
        counts.update(white=white, memory=memory, both=white and memory)
        if judgement.bias is not None:
            counts["memory in its interval"] += judgement.bias.time_low < MEMORY < judgement.bias.time_high
        elif not bias:
            (one,) = judgement.classes
            counts["scale in its interval"] += one.scale_low < (WHITE / DECLARED) ** 2 < one.scale_high
    return counts


if __name__ == "__main__":
    RECORDINGS = int(sys.argv[1]) if len(sys.argv) > 1 else 200
    for length in (60, 120, 500):
        for slow in (True, False):
            start = process_time()
            counted = count_sentences(length, slow, RECORDINGS)
            took = (process_time() - start) / RECORDINGS
            kind = "bias" if slow else "white"
            print(f"{length} rows, {kind}, {took:.2f} s each:", dict(counted), flush=True)
