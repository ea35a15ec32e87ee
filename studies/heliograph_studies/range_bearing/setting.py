"""The two settings: a robot that drives past a station, and a target that passes close to one."""

import jax
import jax.numpy as jnp
import numpy as np

import heliograph as hg

SPEED, TURN = 1.0, 0.02  # m and rad a step
STEPS = 40
BEARING = 0.02  # rad, standard deviation
CHAIN = hg.random_affine.MarkovChain([[0.9, 0.1], [0.3, 0.7]])
QUIET = hg.parallel([hg.hop(1.0, 0.1), hg.hop(1.0, 1e-4)])
NOISY = hg.parallel([hg.hop(1.0, 4.0), hg.hop(1.0, 1e-2)])
LINK = hg.random_affine.Modes(CHAIN, [QUIET, NOISY])
ARRIVAL = 0.8


def move(x: jax.Array, u: jax.Array) -> jax.Array:
    """x = (x, y, heading), u = (distance, turn)."""
    return jnp.stack([x[0] + u[0] * jnp.cos(x[2]), x[1] + u[0] * jnp.sin(x[2]), x[2] + u[1]])


def look(x: jax.Array) -> jax.Array:
    """Range and bearing from the station in the origin, of a state that begins with the place."""
    return jnp.stack([jnp.hypot(x[0], x[1]), jnp.arctan2(x[1], x[0])])


def passing(side: float, circular: bool = True) -> hg.Network:
    """A robot that drives past two stations at one place, east of them (side 1) or west (-1), where bearings cross pi.

    Node "quiet" hears through Gaussian noise, node "bursts" through noise that is larger for a while; both lose one
    packet in five. Not `circular`: numbers on a line, as without angles.
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
    sensor = hg.Sensor(look, np.diag([0.5**2, BEARING**2]), outputs=("range", "bearing"), circular=angles)
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
        "quiet": hg.Node(sensor, hg.erasure(QUIET, ARRIVAL), quiet),
        "bursts": hg.Node(sensor, hg.erasure(LINK, ARRIVAL), bursts),
    }
    return hg.Network(plant, nodes, fused)


FADE = hg.Rayleigh(0.8)
FADING_STEPS = 80


def close_by() -> hg.Network:
    """A target that passes a station; its range comes through two hops that fade, its bearing as it is."""
    step, drift = np.kron([[1.0, 1.0], [0.0, 1.0]], np.eye(2)), np.kron([[1 / 3, 1 / 2], [1 / 2, 1.0]], np.eye(2))
    plant = hg.LinearPlant(
        step,
        0.05 * drift,
        [300.0, 50.0, -10.0, 0.0],
        np.diag([20.0, 20.0, 2.0, 2.0]) ** 2,
        states=("x", "y", "vx", "vy"),
    )
    sensor = hg.Sensor(look, np.diag([1.0, BEARING**2]), outputs=("range", "bearing"), circular=["bearing"])
    relay = hg.amplify_and_forward([hg.hop(FADE, 0.02), hg.hop(FADE, 0.02)])
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
