"""Second moments of a route, all that data can identify of it: mean gain, gain variance, noise."""

from typing import TYPE_CHECKING

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.learning.intervals import quantile
from heliograph.learning.likelihood.joint import joint_world
from heliograph.model.over_time import OverTime, first
from heliograph.numerics.small_matrix import congruence, contract
from heliograph.numerics.types import Array
from heliograph.random_affine.moments.second_moments import second_order

if TYPE_CHECKING:
    from heliograph.learning.solution import Solution

KINDS = ("mean gain", "gain variance", "noise")


def route_sentences(solution: "Solution") -> list[str]:
    """Sentences on the identified mean gain, gain variance and noise of each output, the sensor's noise included."""
    description = solution.surface.objective.description
    _, sensor, channel = joint_world(description.start)
    if isinstance(channel, OverTime) or isinstance(sensor, OverTime) or channel.remembers or channel.past:
        return []

    # mean gain, gain variance, and M R M' + spread of the constant part, of each output
    def totals(x: Array) -> jax.Array:
        world = joint_world(description.at(description.parameters.values(x)))
        local, link = first(world[1]), first(world[2])
        result, r = second_order(link), jnp.asarray(local.noise.covariance)
        mean, p = jnp.asarray(result.mean_gain), result.mean_gain.shape[1]
        spread = jnp.asarray(result.nominal.center)
        whole = jnp.zeros((p + 1, p + 1)).at[:p, :p].set(r).at[p, p].set(1.0)
        noise = jnp.diagonal(congruence(mean, r) + contract(spread, whole))
        reached = jnp.argmax(jnp.abs(mean), axis=1)
        rows = jnp.arange(len(mean))
        return jnp.stack([mean[rows, reached], spread[rows, rows, reached, reached], noise], axis=1)

    with jax.enable_x64(True):
        x = jnp.asarray(solution.x)
        values, slopes = np.asarray(totals(x)), np.asarray(jax.jacfwd(totals)(x))
    # intervals by the derivatives, for what is identified
    covariance, freedom = solution.covariance()
    lines = []
    for i, name in enumerate(sensor.outputs if len(sensor.outputs) == len(values) else range(len(values))):
        report = [
            f"{kind} {value:.3g} ({value - reach:.3g} .. {value + reach:.3g})"
            for kind, value, row in zip(KINDS, values[i], slopes[i][:, solution.active], strict=True)
            if solution.identifies(row)
            for reach in [quantile(freedom) * float(np.sqrt(max(row @ covariance @ row, 0.0)))]
        ]
        if report:
            label = name if isinstance(name, str) else f"z{name}"
            lines.append(f"The received {label} has {', '.join(report)}, 95 %, the sensor's noise included.")
    return lines
