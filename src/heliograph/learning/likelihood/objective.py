"""Objective of a fit: the likelihood of all nodes together as a function of the free numbers, scores, information."""

from dataclasses import dataclass
from functools import partial
from typing import Literal, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter
from heliograph.filters.gaussian.gaussian import cubature_filter
from heliograph.filters.innovation import log_density
from heliograph.filters.linear.linear import LinearFilter, linear_filter
from heliograph.learning.description import Description
from heliograph.learning.likelihood import steady_gains
from heliograph.model.channel import Channel, parallel
from heliograph.model.clock import joint_sensor
from heliograph.model.fading import without_memory
from heliograph.model.over_time import OverTime, first, over_time, unstack
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AbstractSensor, AnySensor, LinearSensor, is_linear
from heliograph.numerics.check import fail
from heliograph.numerics.float64 import quickly_compiled, to_numpy
from heliograph.numerics.linalg import solve
from heliograph.numerics.module import same
from heliograph.numerics.traced import library
from heliograph.numerics.types import Array, Float, PyTree
from heliograph.random_affine.erasure import arrived
from heliograph.random_affine.moments.second_moments import has_known_gain, has_random_gain, second_order
from heliograph.random_affine.noise import Independent
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node


def joint_world(network: Network) -> tuple[AnyPlant, AnySensor, Channel]:
    """Plant, sensor and channel of all nodes together, in their order, as if no observed loss ever happened.

    Raises:
        ValueError: relays that filter and forward, several nodes of which one varies over time.
    """
    if network.relays is not None:
        raise fail("network to be learned", "nodes that receive sensors through channels", "relays that filter")
    if network.common is not None:
        return network.plant, network.common.sensor, _joint_channel(network.common.channel)
    nodes = [node for name in network.names if isinstance(node := network.nodes[name], Node)]
    if len(nodes) == 1:
        return network.plant, nodes[0].sensor, _joint_channel(nodes[0].channel)
    if any(isinstance(part, OverTime) for node in nodes for part in (node.sensor, node.channel)):
        raise fail("network to be learned", "one node, where its sensor or channel varies over time", len(nodes))
    sensors = {name: first(node.sensor) for name, node in zip(network.names, nodes, strict=True)}
    return network.plant, _joined(sensors), parallel([first(_joint_channel(node.channel)) for node in nodes])


def _joined(sensors: dict[str, AbstractSensor]) -> AbstractSensor:
    parts = [sensor for sensor in sensors.values() if isinstance(sensor, LinearSensor)]
    if len(parts) < len(sensors):
        return joint_sensor(sensors)
    matrices = [part.matrix for part in parts]
    outputs = [f"{name}_{output}" for name, part in zip(sensors, parts, strict=True) for output in part.outputs]
    return LinearSensor(library(matrices).concatenate(matrices), Independent([part.noise for part in parts]), outputs)


def _joint_channel(channel: Channel) -> Channel:
    """Channel without observed losses, which leave rows out; with memory losses tell the modes, and stay."""
    if first(channel).remembers or not first(channel).erases:
        return channel
    if isinstance(channel, OverTime):
        return over_time([arrived(item) for item in unstack(channel)])
    return arrived(channel)


Form = Literal["linear", "conditional"]


class Data(NamedTuple):
    """Recordings of one network, joined over its nodes and filled up with rows in which nothing arrived.

    Shapes: measurements (recordings, steps, received), inputs (recordings, steps, inputs), lengths (recordings,).
    """

    measurements: Float[np.ndarray, "recordings steps received"]
    inputs: Float[np.ndarray, "recordings steps inputs"]
    lengths: tuple[int, ...]

    @property
    def plain(self) -> bool:
        """True if everything arrived, and there are no inputs."""
        return not self.inputs.shape[2] and not np.isnan(self.measurements).any()


class Evaluation(NamedTuple):
    """Log-likelihoods and scores of each step at points of the line, and the Gauss-Newton information of both halves.

    Shapes: density (points, recordings, steps), score (points, recordings, steps, p), halves (points, 2, p, p).
    """

    density: Float[Array, "points recordings steps"]
    score: Float[Array, "points recordings steps p"]
    halves: Float[Array, "points 2 p p"]

    @property
    def information(self) -> Float[np.ndarray, "points p p"]:
        """Gauss-Newton information of all data."""
        return np.asarray(self.halves.sum(axis=1))

    @property
    def late(self) -> Float[np.ndarray, "points p p"]:
        """Information of the second half, to which the initial state adds nothing."""
        return np.asarray(self.halves[:, 1])

    @property
    def total(self) -> Float[np.ndarray, " points"]:
        """Log-likelihoods of all data."""
        return np.asarray(self.density.sum(axis=(1, 2)))

    @property
    def gradient(self) -> Float[np.ndarray, "points p"]:
        """Scores of all data."""
        return np.asarray(self.score.sum(axis=(1, 2)))


@dataclass(frozen=True, eq=False)
class Objective:
    """Filter of one form, as a function of numbers on the line. Equal ones share a compiled program.

    A function may read numbers that live outside of it; a change of these shows in the network that it returns at the
    start.

    Args:
        description: the network with its free numbers.
        form: "linear" or "conditional".
        steady: true for a `LinearFilter` of which nothing varies over time, so that its gains reach a steady state.
        random: true if gains are random, so that gains of the filter depend on the state's second moment.
    """

    description: Description
    form: Form
    steady: bool
    random: bool

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Objective) and same(self._parts(), other._parts())

    def __hash__(self) -> int:
        return hash((self.description.build, self.form))

    def _parts(self) -> tuple[object, ...]:
        return self.form, self.description, self.description.start

    def filter(self, x: Array) -> AbstractFilter:
        """Filter at a point of the line."""
        return filter_of(self.description.at(self.description.parameters.values(x)), self.form)

    def innovations(self, x: Array, z: Array, u: Array) -> tuple[jax.Array, jax.Array]:
        """Innovations (steps, m), NaN where nothing arrived, and their covariances (steps, m, m)."""
        item = self.filter(x)

        def body(state: PyTree, row: tuple[jax.Array, ...]) -> tuple[PyTree, tuple[jax.Array, jax.Array]]:
            k, z_k, u_k = row
            after, innovation = item.correct(item.predict(state, u_k, k), z_k, k)
            return after, (jnp.asarray(innovation.value), jnp.asarray(innovation.covariance))

        start = jax.tree.map(jnp.asarray, item.init())
        result: tuple[jax.Array, jax.Array] = jax.lax.scan(
            body, start, (jnp.arange(len(z)), jnp.asarray(z), jnp.asarray(u))
        )[1]
        return result


def objectives(network: Description) -> list[Objective]:
    """Objectives that the network allows, the linear one first.

    Linear: the spread of a random gain by the state's unconditional moments, for linear plants; its score has mean zero
    whatever the laws. Conditional: by the state's moments given data, for channels without memory or delay. Without a
    random gain both are the same, the first.

    Raises:
        ValueError: a network whose likelihood no filter here knows.
    """
    built = network.start
    forms, steady = forms_of(built), _is_steady(built)
    return [Objective(network, form, steady and form == "linear", len(forms) > 1) for form in forms]


def forms_of(network: Network) -> list[Form]:
    """The forms that a network allows."""
    plant, sensor, channel = joint_world(network)
    item = first(channel)
    plain = not item.remembers and not item.past
    if not is_linear(plant, sensor) or first(plant).circular or first(sensor).circular:
        if item.past:
            raise fail("network to be learned", "a linear plant and sensor behind links that are late", "others")
        return ["conditional"]
    if not plain or has_known_gain(item) or not has_random_gain(item, second_order(item)):
        return ["linear"]
    return ["linear", "conditional"]


def _is_steady(network: Network) -> bool:
    """Decide whether the linear filter is one without memory or delay, of which nothing varies over time."""
    world = joint_world(network)
    item = first(world[2])
    return not item.remembers and not item.past and not any(isinstance(part, OverTime) for part in world)


def filter_of(network: Network, form: Form) -> AbstractFilter:
    """Filter of all that the network's nodes receive, whose likelihood is of this form."""
    plant, sensor, channel = joint_world(network)
    if form == "linear":
        return linear_filter(plant, sensor, channel)
    return cubature_filter(plant, sensor, without_memory(channel))


def at_points(objective: Objective, x: Float[np.ndarray, "points p"], data: Data, lanes: int) -> Evaluation:
    """Likelihood, scores and information at points of the line, `lanes` of them at a time in one compiled program.

    Where gains reach a steady state, one at a time: there is enough to do in parallel within a recording.
    """
    every: dict[int, Evaluation] = {}
    with jax.enable_x64(True):
        for i, point in enumerate(x if objective.steady and data.plain else ()):
            result, converged = to_numpy(_with_steady_gains(objective, point, data.measurements))
            if converged:
                every[i] = result
        left = [i for i in range(len(x)) if i not in every]
        for begin in range(0, len(left), lanes):
            places = left[begin : begin + lanes]
            full = x[places + places[-1:] * (lanes - len(places))]
            result = to_numpy(_at_points(objective, full, data.measurements, data.inputs))
            every |= {i: Evaluation(*(leaf[lane] for leaf in result)) for lane, i in enumerate(places)}
    return Evaluation(*(np.stack(item) for item in zip(*(every[i] for i in range(len(x))), strict=True)))


@quickly_compiled
def _at_points(objective: Objective, x: Array, z: Array, u: Array) -> Evaluation:
    evaluation: Evaluation = jax.vmap(lambda point: all_recordings(objective, point, z, u))(jnp.asarray(x))
    return evaluation


@quickly_compiled
def _with_steady_gains(objective: Objective, x: Array, z: Array) -> tuple[Evaluation, jax.Array]:
    def numbers(x: Array) -> PyTree:
        return eqx.filter(objective.filter(x), eqx.is_inexact_array)

    item, directions = objective.filter(jnp.asarray(x)), jnp.eye(len(x))
    slopes = jax.vmap(lambda along: jax.jvp(numbers, (jnp.asarray(x),), (along,))[1])(directions)
    assert isinstance(item, LinearFilter)  # as of every steady objective
    received, derivatives, converged = steady_gains.innovations(item, slopes, z, objective.random)
    scored = jax.vmap(_scored, in_axes=(0, None, 1, None, 0))
    result = Evaluation(
        *scored(received.value, received.covariance, derivatives.value, derivatives.covariance, jnp.asarray(z))
    )
    return result._replace(halves=jnp.sum(result.halves, axis=0)), converged


def all_recordings(objective: Objective, x: Array, z: Array, u: Array) -> Evaluation:
    """Evaluation at one point: density (recordings, steps), score (recordings, steps, p), halves (2, p, p)."""
    result = jax.vmap(lambda z, u: one_recording(objective, x, z, u))(jnp.asarray(z), jnp.asarray(u))
    return Evaluation(result.density, result.score, jnp.sum(result.halves, axis=0))


def one_recording(objective: Objective, x: Array, z: Array, u: Array) -> Evaluation:
    """Evaluate one recording: density (steps,), score (steps, p) and information (2, p, p).

    s = -de' S^-1 e - tr(S^-1 dS) / 2 + e' S^-1 dS S^-1 e / 2, I = sum de' S^-1 de + tr(S^-1 dS S^-1 dS) / 2, over the
    components that arrived; derivatives run forward through the scan.
    """
    local = partial(objective.innovations, z=z, u=u)
    (e, s), (de, ds) = jax.vmap(lambda along: jax.jvp(local, (x,), (along,)), out_axes=(None, 0))(jnp.eye(len(x)))
    return Evaluation(*_scored(e, s, de, ds, jnp.asarray(z)))


def _scored(
    e: jax.Array, s: jax.Array, de: jax.Array, ds: jax.Array, z: jax.Array
) -> tuple[jax.Array, jax.Array, jax.Array]:
    p, steps, m = de.shape
    e, z, s = e.T, z.T[:m], jnp.moveaxis(s, 0, -1)  # time last, as the kernels of small matrices want it
    de, ds = jnp.moveaxis(de, (0, 1), (1, 2)), jnp.moveaxis(ds, (0, 1), (2, 3))
    # components that arrived, and the log-density of their innovation
    present = ~jnp.isnan(e)
    both = present[:, None] & present
    density = log_density(e, s, jnp.abs(z) + jnp.abs(z - e))
    e, s = jnp.where(present, e, 0.0), jnp.where(both, s, 0.0)
    de, ds = jnp.where(present[:, None], de, 0.0), jnp.where(both[:, :, None], ds, 0.0)
    # S^-1 (e, de, dS) by one factorisation, then score and information
    right = jnp.concatenate([e[:, None], de, jnp.reshape(jnp.swapaxes(ds, 1, 2), (m, p * m, steps))], axis=1)
    solved = solve(s, right)
    w, v, q = solved[:, 0], solved[:, 1 : 1 + p], solved[:, 1 + p :].reshape(m, p, m, steps)  # S^-1 (e, de, dS)
    score = jnp.einsum("iak,ik->ka", -de, w) - jnp.einsum("iaik->ka", q) / 2
    score = score + jnp.einsum("ik,ijak,jk->ka", w, ds, w) / 2
    late = jnp.stack([jnp.arange(steps) < steps // 2, jnp.arange(steps) >= steps // 2]).astype(e.dtype)
    halves = jnp.einsum("hk,iak,ibk->hab", late, de, v) + jnp.einsum("hk,iajk,jbik->hab", late, q, q) / 2
    return density, score, halves
