"""A robot mower receives four radio beacons; each range reaches the remote filters through a two-hop relay.

The constants come from the Plaza2 recording; the tests compute them again. Of a drive elsewhere
(`plaza1`) only the place of its beacons, its start and what its gyro reads at rest are taken.
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np

import heliograph as hg

CALIBRATED = "plaza2"  # the recording on which the constants were measured
WINDOW = 100  # range rows over which odometry drift is measured: 22.6 s and 78 m on average
RANGE_SCALE = 1.06974  # ranges on true distances, regression through the origin
RANGE_VARIANCE = 0.31464  # m^2, mean squared residual of that regression
POSITION_WALK = 2.0005e-3  # m^2 per metre and axis: drift along the true headings over 100 rows (22.6 s)
HEADING_WALK = 6.4035e-5  # rad^2/s: drift of the gyro's turn over 100 rows; the gyro's scale error is in it
HOP_VARIANCE = 0.1**2  # m^2, simulated
START_DEVIATION = np.array([1.0, 1.0, 0.1])  # m, m, rad, stated


class Drive(NamedTuple):
    """What every drive has of its own."""

    beacons: np.ndarray  # (4, 2) m, surveyed
    gyro_rate: float  # rad/s, what the gyro reads before the robot first moves
    start: np.ndarray  # m, m, rad: the truth's first pose


class Constants(NamedTuple):
    """What the model of the robot and its radios needs to know, in the units above."""

    gyro_rate: float
    range_scale: float = RANGE_SCALE
    range_variance: float = RANGE_VARIANCE
    position_walk: float = POSITION_WALK
    heading_walk: float = HEADING_WALK


DRIVES = {
    "plaza1": Drive(
        np.array([[-46.623, 11.026], [11.036, -6.959], [22.053, 23.848], [-17.665, 59.009]]),
        5.532e-6,
        np.array([0.0, 0.0, 4.2224]),
    ),
    "plaza2": Drive(
        np.array([[-68.927, 18.378], [-37.581, 69.228], [-33.621, 26.968], [1.709, -5.812]]),
        -6.916e-3,
        np.array([-34.209, 45.301, 1.1205]),
    ),
}


def dead_reckoning(gyro_rate: float) -> Callable[[jax.Array, jax.Array], jax.Array]:
    """Along the chord of an arc; x = (x, y, heading), u = (distance, turn, dt)."""

    def move(x: jax.Array, u: jax.Array) -> jax.Array:
        distance, turn = u[0], u[1] - gyro_rate * u[2]
        course = x[2] + turn / 2
        return x + jnp.array([distance * jnp.cos(course), distance * jnp.sin(course), turn])

    return move


def drift(position_walk: float, heading_walk: float) -> Callable[[jax.Array], jax.Array]:
    """Covariance that one odometry step adds."""
    return lambda u: jnp.diag(jnp.array([position_walk * u[0], position_walk * u[0], heading_walk * u[2]]))


def ranges(beacons: np.ndarray, scale: float = RANGE_SCALE) -> Callable[[jax.Array], jax.Array]:
    """Range to each beacon."""
    return lambda x: scale * jnp.hypot(x[0] - beacons[:, 0], x[1] - beacons[:, 1])


gain = hg.Discrete([0.8, 1.0, 1.2], [0.25, 0.5, 0.25])
relay = hg.amplify_and_forward([hg.hop(gain, HOP_VARIANCE), hg.hop(gain, HOP_VARIANCE)])
channel = hg.parallel([relay] * 4)  # a relay path of its own for each beacon


def model(drive: Drive, constants: Constants) -> tuple[hg.Plant, hg.Sensor]:
    """The robot on this drive, and its radios."""
    plant = hg.Plant(
        dead_reckoning(constants.gyro_rate),
        drift(constants.position_walk, constants.heading_walk),
        drive.start,
        np.diag(START_DEVIATION**2),
        states=("x", "y", "heading"),
        inputs=("distance", "turn", "dt"),
    )
    outputs = ("range_1", "range_2", "range_3", "range_4")
    return plant, hg.Sensor(ranges(drive.beacons, constants.range_scale), constants.range_variance, outputs=outputs)


def network_of(drive: Drive) -> hg.Network:
    """The robot on this drive, received through the relays."""
    plant, sensor = model(drive, Constants(drive.gyro_rate))
    filters = {
        "relay_aware": hg.cubature_filter(plant, sensor, channel),
        "mean_gain": hg.mean_gain_filter(plant, sensor, channel),
        "open_loop": hg.filters.open_loop_filter(plant),
    }
    return hg.Network(plant, {"robot": hg.Node(sensor, channel, filters)})


def plaza1() -> hg.Network:
    """The other drive."""
    return network_of(DRIVES["plaza1"])


network = network_of(DRIVES["plaza2"])
