"""The two settings: a robot that drives past a station, and a target that passes close to one."""

from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

import heliograph as hg
from heliograph.numerics.check import check_count, check_seed, scalar

SPEED, TURN = 1.0, 0.02  # m and rad a step
CHAIN = hg.random_affine.MarkovChain([[0.9, 0.1], [0.3, 0.7]])
QUIET = hg.parallel([hg.hop(1.0, 0.1), hg.hop(1.0, 1e-4)])
NOISY = hg.parallel([hg.hop(1.0, 4.0), hg.hop(1.0, 1e-2)])
LINK = hg.random_affine.Modes(CHAIN, [QUIET, NOISY])


@dataclass(frozen=True)
class Setting:
    """How much is simulated past the two stations, and close by behind the relay that fades.

    bearing: its standard deviation in rad. arrival: probability that a packet of the two stations arrives.
    """

    runs: int = 2000
    steps: int = 40
    fading_runs: int = 1000
    fading_steps: int = 80
    bearing: float = 0.02
    arrival: float = 0.8
    seed: int = 0

    def __post_init__(self) -> None:
        check_count("runs", self.runs, 2)
        check_count("fading_runs", self.fading_runs, 10)  # as many as there are classes of runs
        check_count("steps", self.steps)
        check_count("fading_steps", self.fading_steps)
        scalar("bearing", self.bearing, 0.0)
        scalar("arrival", self.arrival, 0.0, 1.0)
        check_seed("seed", self.seed)


def move(x: jax.Array, u: jax.Array) -> jax.Array:
    """x = (x, y, heading), u = (distance, turn)."""
    return jnp.stack([x[0] + u[0] * jnp.cos(x[2]), x[1] + u[0] * jnp.sin(x[2]), x[2] + u[1]])


def look(x: jax.Array) -> jax.Array:
    """Range and bearing from the station in the origin, of a state that begins with the place."""
    return jnp.stack([jnp.hypot(x[0], x[1]), jnp.arctan2(x[1], x[0])])


def passing(setting: Setting, side: float, circular: bool = True) -> hg.Network:
    """A robot that drives past two stations at one place, east of them (side 1) or west (-1), where bearings cross pi.

    Node "quiet" receives through Gaussian noise, node "bursts" through noise that is larger for a while; both lose
    packets. Not `circular`: numbers on a line, as without angles.
    """
    plant = hg.Plant(
        move,
        np.diag([0.05**2, 0.05**2, 0.01**2]),
        [30.0 * side, -12.0 * side, np.pi / 2 * side],
        np.diag([1.0, 1.0, 0.05**2]),
        states=("x", "y", "heading"),
        inputs=("distance", "turn"),
        circular=["heading"] if circular else [],
    )
    angles = ["bearing"] if circular else []
    sensor = hg.Sensor(look, np.diag([0.5**2, setting.bearing**2]), outputs=("range", "bearing"), circular=angles)
    direct = hg.cubature_filter(plant, sensor, QUIET)
    noisy = hg.cubature_filter(plant, sensor, LINK)
    quiet: dict[str, hg.filters.AbstractFilter] = {
        "cubature": direct,
        "extended": hg.extended_filter(plant, sensor, QUIET),
    }
    bursts: dict[str, hg.filters.AbstractFilter] = {
        "cubature": noisy,
        "imm": hg.filters.imm_filter(plant, sensor, LINK),
        "gpb1": hg.filters.gpb1_filter(plant, sensor, LINK),
        "gpb2": hg.filters.gpb2_filter(plant, sensor, LINK),
        "particle": hg.filters.particle_filter(plant, sensor, LINK, particles=50),
    }
    fused: dict[str, hg.Fusion | hg.filters.AbstractFilter] = {
        "intersection": hg.Fusion("cubature", hg.CovarianceIntersection()),
        "central": hg.filters.sequential_filter([direct, noisy]),
    }
    nodes = {
        "quiet": hg.Node(sensor, hg.erasure(QUIET, setting.arrival), quiet),
        "bursts": hg.Node(sensor, hg.erasure(LINK, setting.arrival), bursts),
    }
    return hg.Network(plant, nodes, fused)


def close_by(setting: Setting) -> hg.Network:
    """A target that passes a station; its range comes through two hops that fade, its bearing as it is."""
    step, drift = np.kron([[1.0, 1.0], [0.0, 1.0]], np.eye(2)), np.kron([[1 / 3, 1 / 2], [1 / 2, 1.0]], np.eye(2))
    plant = hg.LinearPlant(
        step,
        0.05 * drift,
        [300.0, 50.0, -10.0, 0.0],
        np.diag([20.0, 20.0, 2.0, 2.0]) ** 2,
        states=("x", "y", "vx", "vy"),
    )
    sensor = hg.Sensor(look, np.diag([1.0, setting.bearing**2]), outputs=("range", "bearing"), circular=["bearing"])
    relay = hg.amplify_and_forward([hg.hop(hg.Rayleigh(0.8), 0.02) for _ in range(2)])
    channel = hg.parallel([relay, hg.hop(1.0, 1e-4)])
    rules = {"second_order": 2, "four_points": 3, "seven_points": 6}  # degree; but for 2 one point more a direction
    filters: dict[str, hg.filters.AbstractFilter] = {
        "extended": hg.extended_filter(plant, sensor, channel),
        "cubature": hg.cubature_filter(plant, sensor, channel),
    }
    for name, degree in rules.items():
        rule = hg.filters.PolynomialMoments(degree)
        filters[name] = hg.filters.gaussian_filter(plant, sensor, channel, rule)
    return hg.Network(plant, {"station": hg.Node(sensor, channel, filters)})
