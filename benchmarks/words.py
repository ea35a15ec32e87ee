"""Claims behind words of finite length, over random networks with true bits: errors over what is claimed, by claim.

python benchmarks/words.py 100
"""

import sys
from typing import Any, cast

import numpy as np

import heliograph as hg

DITHERS = "triangular", "subtracted", "stochastic"
RUNS, STEPS = 2000, 30


def draw_network(rng: np.random.Generator) -> hg.Network:
    """Return a stable plant of two states, two words of different ranges, and a link that may fade."""
    a = rng.normal(size=(2, 2))
    a *= rng.uniform(0.5, 0.97) / np.abs(np.linalg.eigvals(a)).max()
    root = rng.normal(size=(2, 2))
    q = 0.1 * root @ root.T + 0.02 * np.eye(2)
    spread = np.eye(2)
    for _ in range(2000):
        spread = a @ spread @ a.T + q
    plant = hg.LinearPlant(a, q, [0.0, 0.0], spread)
    c, r = rng.normal(size=(2, 2)), np.diag(rng.uniform(0.01, 0.3, 2))
    sensor = hg.LinearSensor(c, r)
    reach = rng.uniform(5.5, 7.0) * np.sqrt(np.diag(c @ spread @ c.T + r))
    shift = rng.normal(size=2)
    if rng.random() < 0.5:  # a range that is not about 0, as a mean of the noise
        sensor = hg.LinearSensor(c, hg.Gaussian(r, shift))
    else:
        shift = np.zeros(2)
    bits, dither = int(rng.integers(3, 9)), cast(Any, str(rng.choice(DITHERS)))
    encoder = hg.Words(bits, shift - reach, shift + reach, dither)
    rate = float(rng.uniform(0, 0.05))
    law = hg.Discrete([rate, min(4 * rate, 0.3)], [0.8, 0.2]) if rng.random() < 0.5 else rate
    link = hg.decode_and_forward([law], dimension=2, per_message=bool(rng.random() < 0.5))
    filter = hg.linear_filter(plant, sensor, link, encoder=encoder)
    return hg.Network(plant, {"a": hg.Node(sensor, link, {"linear": filter}, encoder=encoder)})


def main(count: int) -> None:
    """Print the share of networks whose NEES is off by more than its interval, by claim."""
    rng, found = np.random.default_rng(0), dict[str, list[tuple[float, float]]]()
    for k in range(count):
        network = draw_network(rng)
        scores = hg.monte_carlo(network, STEPS, RUNS, k, keep=hg.Statistics())["a"]["linear"]
        nees, low, high = scores.nees_per_dimension(0.95)
        found.setdefault(network.claims()["a"]["linear"], []).append((nees, (high - low) / 2))
    for claim, pairs in found.items():
        nees, half = np.array(pairs).T
        off = np.mean(np.abs(nees - 1) > half)
        print(f"{claim}: {len(nees)} networks, mean NEES {nees.mean():.4f}, outside of 95 %: {off:.2f}, "
              f"largest distance {np.max(np.abs(nees - 1) / half):.2f} half widths")  # fmt: skip


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else 100)
