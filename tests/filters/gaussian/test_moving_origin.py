"""Filters about an origin that moves: the same numbers, but for the digits that a place takes."""

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from tests.follow import follow_known

STEPS = 40
LINE = hg.LinearPlant(
    lambda u: jnp.array([[1.0, u[0]], [0.0, 0.98]]), np.diag([1e-3, 1e-2]), [300.0, 1.5], np.eye(2), inputs=["dt"]
)
PLACE = hg.LinearSensor([[1.0, 0.0], [1.0, 2.0]], np.diag([0.3, 0.2]))


def turn(x, u):
    return jnp.stack([x[0] + u[0] * x[2] * jnp.cos(x[1]), x[1] + u[0], x[2]])


CAR = hg.Plant(
    turn, np.diag([1e-3, 1e-4, 1e-2]), [300.0, 3.0, 1.5], np.eye(3) * 0.1, inputs=["dt"],
    states=["x", "heading", "v"], circular=["heading"],
)  # fmt: skip
SEEN = hg.Sensor(
    lambda x: jnp.stack([jnp.hypot(x[0], 40.0), x[1] + 0.1 * x[2]]), np.diag([0.2, 0.01]),
    outputs=["range", "bearing"], circular=["bearing"],
)  # fmt: skip
FILTERS = {
    "Kalman": hg.kalman_filter(LINE, PLACE),
    "random gain": hg.cubature_filter(LINE, PLACE, hg.dropout(hg.hop(1.0, 0.1, dimension=2), 0.2)),
    "extended": hg.extended_filter(CAR, SEEN),
    "cubature": hg.cubature_filter(CAR, SEEN),
    "unscented": hg.unscented_filter(CAR, SEEN),
    "Huber": hg.robust_filter(CAR, SEEN, hg.perfect(2), hg.filters.Huber()),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("name", FILTERS)
def test_estimates_and_innovations_are_those_of_the_filter(name):
    """To 1e-9 of a deviation, in double: rounding at 300 is 1e-13 of one, and that of the prior noise of 1e-12."""
    base, rng = FILTERS[name], np.random.default_rng(4)
    centred = base.for_single_precision()
    assert len(centred.init()) == 4  # high and low, and two parts of the factors
    u = rng.uniform(0.05, 0.4, (STEPS, 1))
    x = 300 + np.cumsum(1.5 * u[:, 0])
    z = np.column_stack([x, x + 3.0]) if "x0" in base.states else np.column_stack([x, 3.0 + np.cumsum(u[:, 0])])
    z = np.where(rng.random(z.shape) < 0.2, np.nan, z + 0.3 * rng.normal(size=z.shape))
    right, got = follow_known(base, z, u), follow_known(centred, z, u)
    deviations = np.sqrt(np.diagonal(right.covariance, axis1=1, axis2=2))
    np.testing.assert_array_less(np.abs(got.mean - right.mean) / deviations, 1e-9)
    np.testing.assert_allclose(got.covariance, right.covariance, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(got.innovation.value, right.innovation.value, rtol=0, atol=1e-9)
    np.testing.assert_allclose(got.innovation.log_likelihood, right.innovation.log_likelihood, rtol=1e-9, atol=1e-9)


def test_others_stay_as_they_are():
    rates = hg.Plant(
        lambda x, u: hg.models.turn_attitude(x, u), 1e-4 * np.eye(3), np.zeros(3), np.eye(3) * 0.01,
        states=["a", "b", "c"], inputs=["p", "q", "r"], attitude=["a", "b", "c"],
    )  # fmt: skip
    attitude = hg.extended_filter(rates, hg.Sensor(lambda x: hg.models.rotation_matrix(x)[0], np.eye(3) * 0.01))
    assert attitude.for_single_precision() is attitude
    open_loop = hg.filters.open_loop_filter(LINE)
    assert open_loop.for_single_precision() is open_loop
