"""Errors and claims of every rule in every column of the robust updates' table, computed elsewhere with NumPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from tests.oracles.robust_updates import simulated

pytestmark = pytest.mark.slow
RUNS, REFERENCE_RUNS, STEPS, FIRST = 200, 100, 1000, 50
COLUMNS = ("student", "mixture", "clean", "outliers", "bursts", "relay")
# Error of the place and NEES per dimension of 100 runs. None: an error without a second moment (a plain update or a
# limit behind noise of 2.01 degrees) or with one that 100 runs do not show (the gate that locks itself out).
TABLE = {
    "plain": (None, (36.2, 250), (0.813, 1.00), (1.69, 2.7), (2.91, 2.5), (1.74, 1.9)),
    "gate": (None, (1.84, 1.02), (0.826, 1.01), None, None, (1.03, 1.07)),
    "Huber": ((2.27, 1.27), (2.00, 1.10), (0.831, 1.01), (0.914, 1.08), (2.24, 1.11), (1.03, 1.07)),
    "WoLF": ((2.53, 1.20), (2.24, 1.08), (1.04, 1.06), (1.07, 1.06), (2.44, 1.05), (1.19, 1.14)),
    "inverse multiquadric": ((2.27, 1.24), (1.88, 1.01), (0.828, 0.99), (0.896, 1.04), (2.24, 1.08), (1.02, 1.05)),
    "Student, VB": ((2.27, 1.31), (1.98, 1.15), (0.856, 1.06), (0.893, 1.08), (2.35, 1.17), (1.01, 1.06)),
    "Student, score": ((2.19, 1.00), (1.90, 0.92), (0.837, 0.91), (0.877, 0.92), (2.18, 0.93), (1.01, 0.98)),
    "contaminated, score": (None, (1.83, 1.00), (0.819, 0.98), (0.859, 1.00), (2.18, 1.00), (1.01, 1.02)),
}
EXACT = {"outliers": (1.49, 0.99), "relay": (1.33, 1.01)}  # of the best linear filter


def filters_of(column):
    """The filters of one column, by their names in the table; the best linear one is "second moments"."""
    relay, gain = column == "relay", hg.Rayleigh(np.sqrt(2 / np.pi))
    scale, far, degrees, share = {"student": (10.0, 400.0, 2.01, 0.1), "mixture": (10.0, 4000.0, 2.01, 0.05)}.get(
        column, (1.0, 100.0, 3.0, 0.05)
    )
    move = (0.95 if relay else 1.0) * (np.eye(4) + 0.1 * np.eye(4, k=2))
    plant = hg.LinearPlant(move, 0.1 * np.eye(4), [0.0, 0.0, 1.0, 1.0], np.eye(4))
    channel, output, r = hg.hop(gain, 0.5, dimension=2) if relay else hg.perfect(2), np.eye(2, 4), scale * np.eye(2)
    gaussian, student, contaminated = (
        hg.LinearSensor(output, law) for law in (r, hg.StudentT(r, degrees), hg.Contaminated(r, share, far * np.eye(2)))
    )
    rules = {
        "gate": hg.filters.Gate(9.0),
        "Huber": hg.filters.Huber(),
        "WoLF": hg.filters.WoLF(4 / np.sqrt(10)),
        "inverse multiquadric": hg.filters.InverseMultiquadric(),
    }
    return {
        "plain": hg.cubature_filter(plant, gaussian, channel),
        **{name: hg.robust_filter(plant, gaussian, channel, rule) for name, rule in rules.items()},
        "Student, VB": hg.robust_filter(plant, student, channel, hg.filters.StudentVB()),
        "Student, score": hg.robust_filter(plant, student, channel),
        "contaminated, score": hg.robust_filter(plant, contaminated, channel),
        **({"second moments": hg.linear_filter(plant, contaminated, channel)} if column in EXACT else {}),
    }


def run(item, rows):
    """Means and covariances of a filter over the rows of one run."""

    def step(state, row):
        state, _ = item.correct(item.predict(state, (), row[1]), row[0], row[1])
        estimate = item.estimate(state)
        return state, (jnp.asarray(estimate.mean), jnp.asarray(estimate.covariance))

    return jax.lax.scan(step, jax.tree.map(jnp.asarray, item.init()), (rows, jnp.arange(STEPS)))[1]


def judged(item, truth, z):
    """Mean squared error of the place and NEES per dimension of each run, (runs,) each; a program for each rule."""
    one_run = jax.tree_util.Partial(run, item)
    mean, covariance = (np.asarray(x)[:, FIRST:] for x in hg.simulation.over_runs(one_run, z))
    error = truth[:, FIRST:] - mean
    nees = np.sum(error * np.linalg.solve(covariance, error[..., None])[..., 0], axis=-1)
    return np.sum(error[..., :2] ** 2, axis=-1).mean(axis=1), nees.mean(axis=1) / 4


@pytest.mark.parametrize("column", COLUMNS)
def test_errors_and_claims_are_those_of_the_table(column):
    """Within 2 % besides three standard errors of both; NEES 0.95 to 1.05 where the law is true.

    Rules share their draws, so that an error over that of the score has a standard error far below its own.
    """
    truth, z = simulated(column, RUNS, STEPS, 11)
    made = {name: judged(item, truth, z) for name, item in filters_of(column).items()}
    table = {name: row[COLUMNS.index(column)] for name, row in TABLE.items()}
    table["second moments"] = EXACT.get(column)
    base = "Student, score" if column == "student" else "contaminated, score"
    both, error = np.sqrt(1 / RUNS + 1 / REFERENCE_RUNS), table[base][0]
    squares, nees = made[base]
    root = np.sqrt(squares.mean())
    assert root == pytest.approx(error, rel=0.02 + 3 * both * squares.std() / squares.mean() / 2)
    assert 0.95 < nees.mean() < 1.05
    for name, entry in table.items():
        if entry is None:
            continue
        other, judged_by = made[name]
        apart = np.std(other / other.mean() - squares / squares.mean()) / 2
        ratio, known = np.sqrt(other.mean()) / root, entry[0] / error
        rounding = 0.005 if min(entry[0], error) < 1.1 else 0.003  # half of the last digit
        assert ratio == pytest.approx(known, rel=0.02 + rounding + 3 * both * apart), name
        assert judged_by.mean() == pytest.approx(entry[1], rel=0.02, abs=0.01 + 3 * both * judged_by.std()), name
