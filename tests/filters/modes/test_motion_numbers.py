"""Published numbers of two laws of motion: of a mode that is known, of one that is estimated, and of likelihoods."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from tests.filters.modes.test_modes_of_motion import FILTERS, LINK, MATRICES, NOISES, ROWS, SENSOR, START, motion


def simulate(steps, runs, filters, **options):
    """A Monte Carlo simulation in which a second node tells the mode of each step."""
    plant = motion()
    tells = [hg.Sensor(lambda x, mode=mode: jnp.full(1, mode), 1e-12) for mode in (0.0, 1.0)]
    nodes = {
        "node": hg.Node(SENSOR, LINK, {name: FILTERS[name](plant, SENSOR, LINK) for name in filters}),
        "mode": hg.Node(hg.markov_sensor(tells, modes=plant), LINK, {}),
    }
    return hg.monte_carlo(hg.Network(plant, nodes), steps, runs, 0, **options)


@pytest.mark.slow
def test_the_brier_score_of_the_mode_filtered_and_smoothed():
    """At k = 30 of 60: .100, and .056 given all data. Of 8,000 runs squares have errors of .0025 and .0020."""
    record = simulate(60, 8_000, ["imm"], smooth=hg.smoothing.FixedInterval())
    assert record.smoothed is not None
    mode = record.measurements["mode"][:, 29, 0]
    for estimates, published in ((record.estimates, 0.100), (record.smoothed.estimates, 0.056)):
        squares = (estimates["node"]["imm"].modes[:, 29, 1] - mode) ** 2
        assert abs(squares.mean() - published) < 3 * squares.std() / len(squares) ** 0.5
        assert squares.std() / len(squares) ** 0.5 < 0.003
    # What is claimed of position and velocity, in two and three digits as they are printed.
    claimed = np.diagonal(record.smoothed.estimates["node"]["imm"].covariance[:, 29], axis1=1, axis2=2).mean(axis=0)
    np.testing.assert_allclose(claimed, [0.226, 0.208], rtol=0.01)


@pytest.mark.slow
def test_errors_where_the_mode_is_known():
    """The Kalman filter of the path of modes, an input here: squares .457 and .499, claims .457 and .497, NEES .998."""
    record = simulate(60, 20_000, [])
    told = hg.Plant(
        lambda x, u: jnp.where(u[0] < 0.5, MATRICES[0] @ x, MATRICES[1] @ x),
        lambda u: jnp.where(u[0] < 0.5, *NOISES),
        [0.0, 0.0], np.eye(2), inputs=["mode"],
    )  # fmt: skip
    filter = hg.extended_filter(told, SENSOR, LINK)  # exact: f is linear in x

    def last(z, u):
        """Return the last estimate and its covariance."""
        state, _ = jax.lax.scan(lambda state, row: (filter.step(state, *row)[0], None), filter.init(), (z, u))
        estimate = filter.estimate(state)
        return estimate.mean, estimate.covariance

    mode = np.rint(record.measurements["mode"])
    mean, covariance = hg.simulation.over_runs(last, record.measurements["node"], mode)
    errors = record.truth[:, -1] - mean
    claimed = np.diagonal(covariance, axis1=1, axis2=2)
    size = np.einsum("ri,rij,rj->r", errors, np.linalg.inv(covariance), errors)[:, None] / 2
    # Of 20,000 runs squares have errors of 1.1 and 2.6 percent, claims of 0.3 and 1.4; three of those.
    for values, published in ((errors**2, [0.457, 0.499]), (claimed, [0.457, 0.497]), (size, [0.998])):
        error = values.std(axis=0) / len(values) ** 0.5
        assert np.all(np.abs(values.mean(axis=0) - published) < 3 * error) and np.all(
            error < 0.03 * values.mean(axis=0)
        )


def sum_over_paths(z):
    """Log-likelihood of each run (runs, steps), by a Gaussian for each path of modes and Bayes' rule."""
    runs, steps = z.shape
    log_weight, mean = np.zeros((runs, 1)), np.zeros((runs, 1, 2))
    covariance, last = np.eye(2)[None], np.zeros(1, dtype=int)  # the same of all runs; the mode that a path ends with
    for k in range(steps):
        branches = []
        for j in (0, 1):
            chance = np.full(1, START[j]) if k == 0 else ROWS[last, j]
            m, p = mean @ MATRICES[j].T, MATRICES[j] @ covariance @ MATRICES[j].T + NOISES[j]
            s, e = p[:, 0, 0] + 1.0, z[:, k, None] - m[..., 0]
            gain = p[:, :, 0] / s[:, None]
            log_density = -(np.log(2 * np.pi * s) + e**2 / s) / 2
            p = p - gain[:, :, None] * p[:, None, 0]
            branches.append((log_weight + np.log(chance) + log_density, m + gain * e[..., None], p, np.full(len(p), j)))
        log_weight, mean = (np.concatenate([b[i] for b in branches], axis=1) for i in (0, 1))
        covariance, last = (np.concatenate([b[i] for b in branches]) for i in (2, 3))
    return np.logaddexp.reduce(log_weight, axis=1)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "published", "deviation"), [("imm", -0.112, 0.45), ("gpb2", -0.032, 0.23), ("gpb1", -0.56, 1.08)]
)
def test_what_a_log_likelihood_of_ten_rows_lacks_of_the_exact_one(name, published, deviation):
    """Of all 1,024 paths. 3,000 runs have a mean within the published deviation over root 3,000; three of those."""
    z = simulate(10, 3_000, []).measurements["node"]
    filter = FILTERS[name](motion(), SENSOR, LINK)

    def likelihood(z):
        """Return the log-likelihood of a run."""

        def step(state, row):
            state, innovation = filter.correct(filter.predict(state), row)
            return state, innovation.log_likelihood

        return jnp.sum(jax.lax.scan(step, filter.init(), z)[1])

    exact = np.concatenate([sum_over_paths(part[..., 0]) for part in np.split(z, 10)])
    lacking = hg.simulation.over_runs(likelihood, z) - exact
    assert abs(lacking.mean() - published) < 3 * deviation / 3000**0.5
    # Of a law with heavy tails: three times what lies between halves of the runs.
    assert abs(lacking.std() - deviation) < 0.2 * deviation
