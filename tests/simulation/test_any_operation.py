"""Plants of operations that native code does not take are simulated by XLA, to the numbers of JAX."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg

NOISE = 1e-9  # deviation of the plant's noise: a truth is f of the one before it, to six of these
TURN = np.array([[0.0, 0.3, -0.1], [-0.3, 0.0, 0.2], [0.1, -0.2, 0.0]])


def tied(x):
    """An invertible matrix of the state."""
    return jnp.eye(3) * (2.0 + x[0] ** 2) + jnp.outer(x, jnp.array([0.3, -0.2, 0.1]))


MOVES = {
    "solve": lambda x: 0.9 * jnp.linalg.solve(tied(x), x + 1.0),
    "sort": lambda x: 0.9 * jnp.sort(x),
    "argsort": lambda x: 0.9 * x[jnp.argsort(-x)],
    "svd": lambda x: 0.3 * jnp.linalg.svd(tied(x))[1],
    "eigh": lambda x: 0.3 * jnp.linalg.eigh(tied(x) + tied(x).T)[0],
    "expm": lambda x: 0.9 * jax.scipy.linalg.expm(TURN * x[0]) @ x,
    "qr": lambda x: jnp.abs(jnp.linalg.qr(tied(x))[1]) @ jnp.full(3, 0.1),
    "det": lambda x: jnp.stack([jnp.tanh(jnp.linalg.det(tied(x)) / 30), 0.9 * x[0], 0.9 * x[1]]),
    "fft": lambda x: 0.3 * jnp.fft.rfft(x).real[jnp.array([0, 1, 1])],
    "median": lambda x: 0.9 * jnp.stack([jnp.median(x), x[0], jnp.percentile(x, 30.0)]),
    "while": lambda x: jax.lax.while_loop(lambda y: jnp.sum(y**2) > 1.0, lambda y: 0.7 * y, x) + 0.1,
}


@pytest.mark.slow
@pytest.mark.parametrize("name", MOVES)
def test_a_plant_of_any_operation_is_simulated_and_filtered(name):
    """Each true state is f of the one before it; the filter's numbers are those of its own step, called from JAX."""
    move = MOVES[name]
    plant = hg.Plant(lambda x, u: move(x), NOISE**2 * np.eye(3), [0.5, -1.0, 2.0], 0.01 * np.eye(3))
    sensor = hg.LinearSensor(np.eye(2, 3), 0.1)
    f = hg.cubature_filter(plant, sensor)
    record = hg.monte_carlo(hg.Network(plant, {"a": hg.Node(sensor, hg.perfect(2), {"f": f})}), 5, 3, 0)
    truth, found = np.asarray(record.truth), np.asarray(record.estimates["a"]["f"].mean)
    with jax.enable_x64(True):
        by_jax = np.asarray(jax.vmap(jax.vmap(move))(jnp.asarray(truth[:, :-1])))
        np.testing.assert_allclose(truth[:, 1:], by_jax, rtol=1e-12, atol=8 * NOISE)
        state, means = jax.tree.map(jnp.asarray, f.init()), []
        for k, z in enumerate(np.asarray(record.measurements["a"])[0]):
            state, estimate = f.step(state, jnp.asarray(z), jnp.zeros(0), k)
            means.append(np.asarray(estimate.mean))
    np.testing.assert_allclose(found[0], means, rtol=1e-9, atol=1e-9)
