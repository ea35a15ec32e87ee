"""Laws of noise of deviation 1, each with a function that draws it: Gaussian, Student's, contaminated."""

import numpy as np

import heliograph as hg

LAWS = {
    "Gaussian": (hg.Gaussian([[1.0]]), lambda rng, n: rng.standard_normal(n)),
    "Student": (hg.StudentT(1.0, 3.0), lambda rng, n: rng.standard_t(3, n)),
    "contaminated": (
        hg.Contaminated(1.0, 0.05, 100.0),
        lambda rng, n: np.where(rng.random(n) < 0.05, 10.0, 1.0) * rng.standard_normal(n),
    ),
}
