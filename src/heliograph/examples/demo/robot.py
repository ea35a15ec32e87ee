"""A robot mower hears four radio beacons; each range reaches the remote filters through a two-hop relay.

The constants come from the Plaza2 recording itself; `calibration` says how and computes them again.
"""

import jax
import jax.numpy as jnp
import numpy as np

import heliograph as hg

BEACONS = np.array([[-68.927, 18.378], [-37.581, 69.228], [-33.621, 26.968], [1.709, -5.812]])  # m, surveyed
GYRO_RATE = -6.916e-3  # rad/s, what the gyro reads before the robot first moves
RANGE_SCALE = 1.06974  # ranges on true distances, regression through the origin
RANGE_VARIANCE = 0.31464  # m^2, mean squared residual of that regression
POSITION_WALK = 2.0005e-3  # m^2 per metre and axis: drift along the true headings over 100 rows (22.6 s)
HEADING_WALK = 6.4035e-5  # rad^2/s: drift of the gyro's turn over 100 rows; the gyro's scale error is in it
HOP_VARIANCE = 0.1**2  # m^2, simulated
START = np.array([-34.209, 45.301, 1.1205])  # m, m, rad: the truth's first pose
START_DEVIATION = np.array([1.0, 1.0, 0.1])  # m, m, rad, stated


def move(x: jax.Array, u: jax.Array) -> jax.Array:
    """Dead reckoning along the chord of an arc; x = (x, y, heading), u = (distance, turn, dt)."""
    distance, turn = u[0], u[1] - GYRO_RATE * u[2]
    course = x[2] + turn / 2
    return x + jnp.array([distance * jnp.cos(course), distance * jnp.sin(course), turn])


def drift(u: jax.Array) -> jax.Array:
    """Covariance that one odometry step adds."""
    return jnp.diag(jnp.array([POSITION_WALK * u[0], POSITION_WALK * u[0], HEADING_WALK * u[2]]))


def ranges(x: jax.Array) -> jax.Array:
    """Range to each beacon."""
    return RANGE_SCALE * jnp.hypot(x[0] - BEACONS[:, 0], x[1] - BEACONS[:, 1])


plant = hg.Plant(
    move,
    drift,
    START,
    np.diag(START_DEVIATION**2),
    states=("x", "y", "heading"),
    inputs=("distance", "turn", "dt"),
)
sensor = hg.Sensor(ranges, RANGE_VARIANCE, outputs=("range_1", "range_2", "range_3", "range_4"))
gain = hg.Discrete([0.8, 1.0, 1.2], [0.25, 0.5, 0.25])
relay = hg.amplify_and_forward([hg.hop(gain, HOP_VARIANCE), hg.hop(gain, HOP_VARIANCE)])
channel = hg.parallel([relay] * 4)  # a relay path of its own for each beacon
filters = {
    "relay_aware": hg.cubature_filter(plant, sensor, channel),
    "mean_gain": hg.mean_gain_filter(plant, sensor, channel),
    "open_loop": hg.open_loop_filter(plant),
}
network = hg.Network(plant, {"robot": hg.Node(sensor, channel, filters)})
