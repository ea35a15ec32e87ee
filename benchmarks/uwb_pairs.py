"""Generalisation of the `uwb` example: its rule learned on each two drives, judged on all others.

python benchmarks/uwb_pairs.py DIR
"""

import sys
from itertools import combinations
from pathlib import Path

import numpy as np

from heliograph_studies.uwb.compute import judged
from heliograph_studies.uwb.drives import drives
from heliograph_studies.uwb.learning import density, followed, learn, padded, slots
from heliograph_studies.uwb.setting import BEST, Setting


def main(folder: Path) -> None:
    """Print error, claim and log density of the true places of each drive, for each pair that taught the rule."""
    every, densities = drives(folder), []
    for pair in combinations(every, 2):
        numbers = learn(BEST, pair, Setting().iterations)
        for drive in (drive for drive in every if drive not in pair):
            rule, length = judged(BEST, drive, numbers), len(slots(drive).time)
            result = followed(BEST, [numbers], padded([drive]))
            log_density = density(drive, numbers.late, result.place[0, :length], result.covariance[0, :length])
            densities.append(log_density)
            taught = ", ".join(part.name for part in pair)
            print(f"{drive.name}: {rule.rmse:.3f} m, NEES {rule.nees:.2f}, {log_density:.2f} nats, by {taught}")
    print(f"mean log density: {np.mean(densities):.3f} nats")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
