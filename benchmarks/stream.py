"""Time of one sample through `Stream.push`: the README's filter, which receives one range through a relay.

Run: python benchmarks/stream.py. Microseconds of a call, the least and the median of many.
"""

import time
from typing import Any

import jax.numpy as jnp
import numpy as np
from alone import show

import heliograph as hg

SAMPLES = 5000
WARM = 200


def drive(x: Any, u: Any) -> Any:
    """Position and velocity of a cart; input: acceleration and time step."""
    return jnp.stack([x[0] + u[1] * x[1], x[1] + u[1] * u[0]])


def readme_filter() -> hg.filters.AbstractFilter:
    """The filter that knows its relay."""
    plant = hg.Plant(
        drive,
        noise=lambda u: jnp.diag(jnp.stack([1e-4, 1e-2 * u[1] + 1e-6])),
        initial_mean=[0.0, 1.0],
        initial_covariance=np.diag([1.0, 0.1]),
        states=["position", "velocity"],
        inputs=["acceleration", "dt"],
    )
    sensor = hg.Sensor(lambda x: jnp.stack([x[0], 10.0 - x[0]]), noise=0.01, outputs=["left", "right"])
    relay = hg.amplify_and_forward([hg.hop(hg.Rayleigh(0.8), noise=0.02), hg.hop(1.0, noise=0.01, amplification=1.2)])
    return hg.cubature_filter(plant, sensor, hg.parallel([relay, hg.perfect()]))


def measure() -> dict[str, Any]:
    """The least and the median time of a call."""
    stream, z, u = hg.Stream(readme_filter()), [np.nan, 9.6], [0.1, 0.5]
    times = []
    for _ in range(WARM + SAMPLES):
        begun = time.perf_counter_ns()
        stream.push(z, u)
        times.append(time.perf_counter_ns() - begun)
    result = np.array(times[WARM:]) / 1e3
    values = {"one sample, least": float(result.min()), "one sample, median": float(np.median(result))}
    return {"unit": "us", "values": values, "at_most": dict.fromkeys(values, 15)}


if __name__ == "__main__":
    show(measure())
