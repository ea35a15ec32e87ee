"""The same filter as anybody would write it for one run with jax.numpy.linalg, vectorised over the runs."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from batches import vectorised
from problems import transition
from timed import Arrays, Contender, serve


def points(mean: Any, spread: Any) -> Any:
    """2 n cubature points, (2 n, n)."""
    offsets = jnp.sqrt(float(len(mean))) * jnp.linalg.cholesky(spread).T
    return mean + jnp.concatenate([offsets, -offsets])


def prepare(p: Arrays) -> Contender:
    def step(state: Any, z: Any) -> tuple[Any, Any]:
        moved = jax.vmap(lambda x: jnp.stack(transition(x)))(points(*state))
        mean = moved.mean(axis=0)
        spread = (moved - mean).T @ (moved - mean) / len(moved) + p["Q"]
        drawn = points(mean, spread)
        y = drawn @ p["C"].T
        expected = y.mean(axis=0)
        signal = (y - expected).T @ (y - expected) / len(y) + p["R"]
        cross = p["gain"] * (y - expected).T @ (drawn - mean) / len(y)
        second = signal + jnp.outer(expected, expected)
        innovation = p["gain_variance"] * second + p["gain"] ** 2 * signal + p["noise"]
        gain = jnp.linalg.solve(innovation, cross).T
        mean = mean + gain @ (z - p["gain"] * expected)
        spread = spread - gain @ cross
        return (mean, (spread + spread.T) / 2), mean

    def one_run(z: Any) -> tuple[Any, Any]:
        start = jnp.asarray(p["mean"]), jnp.asarray(p["covariance"])
        last, means = jax.lax.scan(step, start, z)
        return means, last[1]

    p = {name: value if name == "z" else np.asarray(value) for name, value in p.items()}
    return vectorised(one_run, [p["z"]])


if __name__ == "__main__":
    serve(prepare, ("jax", "numpy"))
