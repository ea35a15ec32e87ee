"""Objective of a fit: the likelihood of all nodes together as a function of the free numbers, scores, information."""

from dataclasses import dataclass
from functools import lru_cache
from types import FunctionType
from typing import Literal

import jax
import jax.numpy as jnp

from heliograph.filters.base import AbstractFilter
from heliograph.filters.filter_for_likelihood import likelihood_filter
from heliograph.learning.parametric_network import Build, Description
from heliograph.model.augmented.joint_sensors import join_links
from heliograph.model.channel import Channel
from heliograph.model.estimate import Innovation
from heliograph.model.over_time import at_each_step, first
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor, is_linear
from heliograph.numerics.angles.angle import wrap_near
from heliograph.numerics.check import fail
from heliograph.numerics.module import are_same
from heliograph.numerics.types import Array, PyTree
from heliograph.random_affine.moments.second_moments import has_random_gain, second_order
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node


def join_all_nodes(network: Network) -> tuple[AnyPlant, AnySensor, Channel]:
    """Return the plant, and the sensor and channel of all nodes together in their order, if all packets arrive.

    A fit takes what all nodes receive as one measurement, since their sensors see one state. `join_links` stacks
    sensors and channels side by side. A network with one channel for all nodes has it as `common`.

    Raises:
        ValueError: relays that filter and forward, sensors with feedback, senders of words (a sensor with a resolution
            can be learned).
    """
    network.check_sends_numbers("network to be learned")
    if network.relays is not None:
        raise fail("network to be learned", "nodes that receive sensors through channels", "relays that filter")
    # All nodes receive through one common channel.
    if network.common is not None:
        return network.plant, network.common.sensor, _condition_on_arrivals(network.common.channel)
    nodes = [node for name in network.names if isinstance(node := network.nodes[name], Node)]
    channels = [_condition_on_arrivals(node.channel) for node in nodes]
    if len(nodes) == 1:
        return network.plant, nodes[0].sensor, channels[0]
    sensors = {name: node.sensor for name, node in zip(network.names, nodes, strict=True)}
    return network.plant, *join_links(sensors, channels)


def _condition_on_arrivals(channel: Channel) -> Channel:
    """Return the channel given that packets arrive, since lost rows are left out; a channel with memory stays as it is.

    With memory a loss tells something about the channel's mode.
    """
    if first(channel).remembers or not first(channel).erases:
        return channel
    complete: Channel = at_each_step(lambda step: step.condition_on_arrival(), channel)
    return complete


Form = Literal["linear", "conditional", "truth"]


@dataclass(frozen=True, eq=False)
class Objective:
    """What a fit maximises: the likelihood of the filter of one form, as a function of the free numbers.

    Equal objectives share a compiled program. They are compared by the code and closure of the function that builds the
    network. It may also read numbers that live outside of it; a change of these shows in the network that it returns at
    the start, which is compared too.

    Args:
        description: the network with its free numbers.
        form: "linear" or "conditional", the measurements' likelihood; "truth", the density of the true states.
    """

    description: Description
    form: Form

    def __eq__(self, other: object) -> bool:
        """Return whether the other objective has the same likelihood; a program compiled for one then serves both."""
        return isinstance(other, Objective) and are_same(self._list_distinctions(), other._list_distinctions())

    def __hash__(self) -> int:
        """Return the hash of parts in which equal objectives agree: code of the building function, and form."""
        return hash((_list_code_and_closure(self.description.build)[0], self.form))

    def _list_distinctions(self) -> tuple[object, ...]:
        """Return a tuple of everything by which two objectives may differ, to compare them.

        The network at the start is among it, as the function may read numbers that live outside of it.
        """
        description = self.description
        return (
            self.form,
            _list_code_and_closure(description.build),
            description.parameters,
            description.named,
            description.start,
        )

    def filter(self, x: Array) -> AbstractFilter:
        """Return the filter of this form with the free numbers at unconstrained coordinates x (p,)."""
        return make_filter_of_form(self.description.at(self.description.parameters.values(x)), self.form)

    def compute_innovations(self, x: Array, z: Array, u: Array) -> tuple[jax.Array, jax.Array]:
        """Return the filter's innovations (steps, m), NaN where nothing arrived, and their covariances (steps, m, m).

        The filter has the free numbers at x (p,), and runs over measurements z (steps, received) and inputs u (steps,
        inputs). Where the estimate is no number the innovation is 0 and its covariance NaN, so that the likelihood is
        NaN there, and not that of a row in which nothing arrived. `filter.scan(z, u, judged)` runs the filter over all
        rows and stacks what `judged` returns of each.
        """
        filter = self.filter(x)

        def judged(state: PyTree, innovation: Innovation, k: jax.Array) -> tuple[jax.Array, jax.Array]:
            """Return a row's innovation and its covariance, or 0 and NaN if the filter has lost its estimate (NaN).

            The NaN makes the likelihood NaN. An innovation of NaN would count as a row where nothing arrived.
            """
            is_lost = jnp.any(jnp.isnan(jnp.asarray(filter.estimate(state).mean)))
            value = jnp.asarray(innovation.value)
            covariance = jnp.asarray(innovation.covariance)
            return jnp.where(is_lost, 0.0, value), jnp.where(is_lost, jnp.nan, covariance)

        innovations: tuple[jax.Array, jax.Array] = filter.scan(z, u, judged)
        return innovations

    def compute_errors(self, x: Array, z: Array, u: Array, truth: Array) -> tuple[jax.Array, jax.Array]:
        """Return the errors (steps, n) of the estimates by the filter at x (p,), and the covariances that they claim.

        Errors are NaN where the truth is not known. z: measurements (steps, received). u: inputs (steps, inputs).
        `truth`: true states (steps, n). Errors of angles are taken the short way around (`wrap_near`).
        """
        filter = self.filter(x)
        angles = first(self.description.start.plant).angles

        def read_estimate(state: PyTree, innovation: Innovation, k: jax.Array) -> tuple[jax.Array, jax.Array]:
            """Return mean and claimed covariance of the estimate after a row.

            `filter` is the filter with the free numbers at x.
            """
            estimate = filter.estimate(state)
            return jnp.asarray(estimate.mean), jnp.asarray(estimate.covariance)

        mean, covariance = filter.scan(z, u, read_estimate)
        return wrap_near(jnp.asarray(truth), mean, angles) - mean, covariance


def _list_code_and_closure(build: Build) -> tuple[object, ...]:
    """Return what makes two functions equal: their code, defaults and the values they close over.

    Any other callable is compared by itself. `build`: the user's function that returns the network.
    """
    if not isinstance(build, FunctionType):
        return (build,)
    cells = [cell.cell_contents for cell in build.__closure__ or ()]
    return build.__code__, build.__defaults__, build.__kwdefaults__, cells


def make_objectives(network: Description, by_truth: bool = False) -> list[Objective]:
    """Return the objectives that the network allows, the linear one first, or with `by_truth` that of true states.

    The linear form takes the spread of a random gain from the state's unconditional moments, for linear plants; its
    score has mean zero whatever the laws are. The conditional form takes it from the state's moments given the data,
    for channels without memory or delay. Without a random gain both are the same: only the linear one is returned.

    Raises:
        ValueError: a network whose likelihood no filter here knows.
    """
    if by_truth:
        find_sole_filter(network.start)
        return [_reuse_equal_objective(Objective(network, "truth"))]
    return [_reuse_equal_objective(Objective(network, form)) for form in list_forms(network)]


@lru_cache
def _reuse_equal_objective(objective: Objective) -> Objective:
    """Return the first objective that equals this one, from the cache; this one itself if it is the first.

    Compiled programs are found by their objective. To compare two objectives that are not the same object takes long,
    as it builds their networks. `lru_cache` does it here once, and from then on all use one object.
    """
    return objective


def choose_typical_network(description: Description) -> Network:
    """Return the network at its start, or near it if a gain is random there but not at the start itself.

    A gain is random only near the start if its variance is free and starts at 0: for instance a gain that is one of two
    free values which start equal. `near_start` is the network a little away from the start.
    """
    start = description.start
    if _has_random_gain(start) or not _has_random_gain(description.near_start):
        return start
    return description.near_start


def _has_random_gain(network: Network) -> bool:
    """Return whether the channel from sensor to all nodes together has a gain with a variance, at its first step.

    Channels with a memory, and gains that the receiver knows, do not count: no average over gains is needed there.
    """
    _, _, channel = join_all_nodes(network)
    link = first(channel)
    return not (link.remembers or link.past or link.has_known_gain) and has_random_gain(link, second_order(link))


def list_forms(description: Description) -> list[Form]:
    """Return the forms of the likelihood that a network allows, "linear" before "conditional".

    The linear form uses the unconditional moments of the state, the conditional form those given the data. Models that
    are not linear, or have angles (`circular`), have only the conditional form; packets may then not be late
    (`link.past`: by how many steps). `is_linear`: plant and sensor are linear. A random gain is one with a variance
    that the receiver does not know.
    """
    plant, sensor, channel = join_all_nodes(description.start)
    link = first(channel)  # the channel of the first step, if it varies; its kind is the same at all
    if not is_linear(plant, sensor) or first(plant).circular or first(sensor).circular:
        if link.past:
            raise fail("network to be learned", "a linear plant and sensor behind links that are late", "others")
        return ["conditional"]
    # Without a random gain both forms are the same. With memory or delay there is no conditional form.
    return ["linear", "conditional"] if _has_random_gain(choose_typical_network(description)) else ["linear"]


def make_filter_of_form(network: Network, form: Form) -> AbstractFilter:
    """Return the filter of all that a network receives whose likelihood has this form, or its own for "truth".

    "linear" filters by the moments of the gains before any data, "conditional" by those given the data;
    `likelihood_filter` makes either for the joined channel of all nodes.
    """
    if form == "truth":
        return find_sole_filter(network)
    plant, sensor, channel = join_all_nodes(network)
    return likelihood_filter(plant, sensor, channel, form == "linear")


def find_sole_filter(network: Network) -> AbstractFilter:
    """Return the only filter of a network, which receives all that arrives and estimates all states.

    Raises:
        ValueError: no filter, several, one of only some of the states, or one that claims no covariance.
    """
    nodes = list(network.nodes.values())
    filters = nodes[0].filters if len(nodes) == 1 and isinstance(nodes[0], Node) else {}
    central = [fusion for fusion in network.fused.values() if isinstance(fusion, AbstractFilter)]
    every = [*filters.values(), *central]
    if len(every) != 1 or every[0].states != network.states:
        expected = "one filter, of all that arrives, whose estimates are compared with them"
        raise fail("network to be learned by its true states", expected, len(every) or "none")
    if every[0].claim == "none":
        raise fail("filter to be learned by true states", "one that claims a covariance", "one that claims none")
    return every[0]
