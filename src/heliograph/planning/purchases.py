"""What one more relay or sensor buys, and what each sensor that is there is worth: the design, made again."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import numpy as np

from heliograph.model.channel import amplify_and_forward
from heliograph.numerics.check import instance
from heliograph.numerics.readable import readable
from heliograph.planning.outcome import NetworkDesign
from heliograph.planning.task import Task
from heliograph.planning.transmitters import Hop, names_of, walked
from heliograph.random_affine.atoms import GainAndNoise
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.law import GivenMoments
from heliograph.simulation.network import Network
from heliograph.simulation.node import Node

STARTS = 16  # of the descents for each; a purchase is compared, not built


@readable
class Purchase(NamedTuple):
    """A change, and the error (or, with a wanted error, the power) of the design made again: `value`, down by `saved`.

    name: what is bought ("one more a", "a relay halfway of a.hop1") or lost ("without a").
    """

    name: str
    value: float
    saved: float


def purchases_of(
    network: Network,
    task: Task,
    found: NetworkDesign,
    exponent: float | None = None,
    advance: Callable[[str], None] = lambda what: None,
) -> list[Purchase]:
    """Every sensor once more, with noise and hops of its own; each left out; and a relay halfway of each hop.

    A relay halfway makes two hops of one, each with 2^`exponent` times its power gain E g^2 and the same kappa and
    noise; without an exponent of the path loss, relays are not tried. A change that a design refuses, such as a last
    sensor left out, is not listed.
    """
    instance("network", network, Network, "a Network")
    instance("task", task, Task, "a Task")
    instance("design", found, NetworkDesign, "a NetworkDesign")
    again = replace(task, starts=min(task.starts, STARTS))
    result = []
    for name, (changed, asked) in _changes(network, again, exponent).items():
        advance(name)
        value = asked.solve(changed).certificate.value
        result.append(Purchase(name, value, found.certificate.value - value))
    return sorted(result, key=lambda one: -one.saved)


def _changes(network: Network, task: Task, exponent: float | None) -> dict[str, tuple[Network, Task]]:
    nodes = {name: node for name, node in network.nodes.items() if isinstance(node, Node)}
    bare = {name: Node(node.sensor, node.channel, {}) for name, node in nodes.items()}
    found: dict[str, tuple[Network, Task]] = {}
    for name, node in bare.items():
        twin = f"{name} again"
        found[f"one more {name}"] = Network(network.plant, {**bare, twin: node}), task.also(twin)
        if len(bare) > 1 and (task.free is None or not _only(task.free, name)):
            kept = None if task.free is None else tuple(one for one in task.free if one.partition(".")[0] != name)
            left = {other: one for other, one in bare.items() if other != name}
            if task.wanted is None:
                found[f"without {name}"] = Network(network.plant, left), replace(task, free=kept)
        if exponent is not None and isinstance(node.channel, AbstractRandomAffine):
            for hop in names_of(node.channel):
                nearer = Node(node.sensor, _halfway(node.channel, hop, exponent), {})
                found[f"a relay halfway of {name}.{hop}"] = Network(network.plant, {**bare, name: nearer}), _whole(task)
    return found


def _only(free: tuple[str, ...], name: str) -> bool:
    return all(one.partition(".")[0] == name for one in free)


def _whole(task: Task) -> Task:
    """Hops are counted anew behind a relay that is put between: nodes are free as a whole."""
    if task.free is None:
        return task
    return replace(task, free=tuple(dict.fromkeys(one.partition(".")[0] for one in task.free)))


def _halfway(channel: AbstractRandomAffine, name: str, exponent: float) -> AbstractRandomAffine:
    """The channel in which a relay stands halfway of one hop."""

    def act(own: str, hop: Hop) -> AbstractRandomAffine:
        if own != name or not isinstance(hop, GainAndNoise):
            return hop
        first, second = (float(hop.law.moment(k)) * 2 ** (exponent * k / 2) for k in (1, 2))
        law = GivenMoments([first, second])
        onward = GainAndNoise(law, np.eye(hop.outputs), hop.noise)
        return amplify_and_forward([GainAndNoise(law, hop.matrix, hop.noise), onward])

    return walked(channel, act)[0]
