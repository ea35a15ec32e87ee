"""Signals that add up against as many channels: processor time of simulation and filter, paired, and of a description.

Run: python benchmarks/superposed.py [TRANSMITTERS]. 64 transmitters unless given: each round runs the sum and the
parallel links in turn, so that what else the machine does falls on both, and the median of the ratios is printed. Then
the processor time of the second moments of 1,000 links that add up, their construction among it.

On two cores shared with others: 4.1 us a step and run added up, 629 on 64 channels, whose filter has 64 outputs.
"""

import sys
from time import process_time

import numpy as np

import heliograph as hg
from heliograph.random_affine.moments.second_moments import second_order

RUNS, STEPS, ROUNDS = 500, 20, 7
PLANT = hg.LinearPlant([[0.95]], [[0.1]], [0.0], [[1.0]])


def make_network(count: int, added: bool) -> hg.Network:
    """Return so many sensors of one state behind Rayleigh fading, added up or each on its own channel."""
    sensor = hg.LinearSensor(np.ones((count, 1)), 0.05 * np.eye(count))
    links = [hg.hop(hg.Rayleigh(0.8), noise=0.0 if added else 0.1) for _ in range(count)]
    channel = hg.superposed(links, noise=0.1) if added else hg.parallel(links)
    return hg.Network(PLANT, {"a": hg.Node(sensor, channel, {"f": hg.linear_filter(PLANT, sensor, channel)})})


def time_run(network: hg.Network, key: int) -> float:
    """Return the processor seconds of a Monte Carlo of the network."""
    start = process_time()
    hg.monte_carlo(network, STEPS, RUNS, key, keep=hg.Statistics())
    return process_time() - start


if __name__ == "__main__":
    COUNT = int(sys.argv[1]) if len(sys.argv) > 1 else 64
    together, apart = make_network(COUNT, True), make_network(COUNT, False)
    for network in (together, apart):
        time_run(network, 0)  # compiles
    pairs = np.array([(time_run(together, k), time_run(apart, k)) for k in range(1, ROUNDS + 1)])
    ratio, per_step = np.median(pairs[:, 0] / pairs[:, 1]), np.median(pairs, axis=0) / RUNS / STEPS * 1e6
    print(f"{COUNT} transmitters: added up {per_step[0]:.2f} us a step and run, on channels {per_step[1]:.2f}")
    print(f"ratio {ratio:.2f}", flush=True)
    begun = process_time()
    second_order(hg.superposed([hg.hop(hg.Rayleigh(0.8), noise=0.0) for _ in range(1000)], noise=0.1))
    print(f"1,000 links that add up are described in {process_time() - begun:.2f} s")
