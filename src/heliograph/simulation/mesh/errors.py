"""Errors of nodes that estimate from their neighbours, before any data: given what arrives, and in the mean over it.

e_i+ = M_i e + F_i w - sum_l K_il v_l, with e the errors of all nodes, of joint covariance J; w the plant's noise, of
covariance Q; and v_l the noise of node l's measurement, of covariance R_l. N = nodes n, for n states of the plant.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import scipy

from heliograph.factors.square_root_update import covariance_of_root, observe_information, roots_of
from heliograph.fusion.mesh.joint_error_covariance import (
    blocks_of,
    error_transitions,
    measurement_weights,
    propagate_joint_covariance,
    scatter_blocks,
)
from heliograph.fusion.mesh.neighbour_rules import FrozenWeights
from heliograph.fusion.network_fusion import Fusion
from heliograph.linear.jump_system import propagate_by_mode
from heliograph.model.estimate import Claim
from heliograph.numerics.check import check_count, fail, instance, is_whole
from heliograph.numerics.float64 import quickly_compiled, to_numpy
from heliograph.numerics.module import readable
from heliograph.numerics.types import ArrayLike, Bool, Float, PyTree
from heliograph.simulation.arguments import make_run_key, read_plant_inputs
from heliograph.simulation.mesh.building import build_mesh
from heliograph.simulation.mesh.check import find_claim_of_errors
from heliograph.simulation.mesh.mesh import Mesh
from heliograph.simulation.mesh.neighbour_edges import MeshEdges
from heliograph.simulation.mesh.state_and_step import MeshStep
from heliograph.simulation.network import Network

SPARSE = 2000  # nodes whose joint covariance fits in memory


@readable
@dataclass(frozen=True)
class MeshErrors:
    """Covariances of the errors of all nodes of a fusion between neighbours, after each step.

    Args:
        nodes: names of the nodes.
        actual: E[e_i e_i'] (time, node, n, n), given what arrives or in the mean over it.
        claimed: what each node claims (time, node, n, n).
        joint: Cov(e_i, e_j) after the last step (node, n, node, n).
        claim: of `actual`: "exact"; "upper" where noises are known by bounds, "nominal" where laws are known up to a
            radius.
    """

    nodes: tuple[str, ...]
    actual: Float[np.ndarray, "time node n n"]
    claimed: Float[np.ndarray, "time node n n"]
    joint: Float[np.ndarray, "node n node n"]
    claim: Claim

    def mean_trace(self) -> Float[np.ndarray, " time"]:
        """Return the mean over the nodes of tr E[e e'] at each step."""
        return np.asarray(np.trace(self.actual, axis1=-2, axis2=-1).mean(axis=-1))


def mesh_arrivals(network: Network, fusion: str, horizon: int, key: int | jax.Array) -> Bool[np.ndarray, "..."]:
    """Draw what arrives between the neighbours of a fusion, as a run of this key does.

    Args:
        network: the network.
        fusion: name of its fusion between neighbours.
        horizon: number of steps.
        key: a seed or a JAX key.

    Returns:
        Flags (horizon, node, rounds, degree): a node's own message first, then its neighbours'.

    Raises:
        ValueError: no such fusion, no horizon.
    """
    mesh = find_mesh(network, fusion)
    steps = check_count("horizon", horizon)
    with jax.enable_x64(True):
        return np.asarray(_draw_arrivals(mesh.edges, make_run_key(key), np.arange(steps)))


@quickly_compiled
def _draw_arrivals(edges: MeshEdges, key: jax.Array, steps: np.ndarray) -> jax.Array:
    """Draw what arrives at these steps, as flags (step, node, rounds, degree).

    It depends on the edges alone, so that one compiled program serves all rules.
    """

    def draw_step(state: tuple[PyTree, ...], k: jax.Array) -> tuple[tuple[PyTree, ...], jax.Array]:
        """Draw what arrives at step k: next states of the channels, and flags (node, rounds, degree)."""
        return edges.draw(state, key, k)

    arrivals: jax.Array
    _, arrivals = jax.lax.scan(draw_step, edges.init(key), jnp.asarray(steps))
    return arrivals


def mesh_errors(
    network: Network,
    fusion: str,
    arrived: Bool[ArrayLike, "horizon node rounds degree"] | int,
    inputs: Float[ArrayLike, "horizon inputs"] | None = None,
) -> MeshErrors:
    """Compute the covariances of all nodes' errors for one pattern of arrivals, whatever the rule.

    Nodes exchange estimates with neighbours and mix them by M. J+ = M J M' + F Q F' + sum_l K_l R_l K_l' with the gains
    of these arrivals, by sparse M: up to 2,000 nodes. All measurements reach their own node.

    Args:
        network: the network.
        fusion: name of its fusion between neighbours.
        arrived: flags (horizon, node, rounds, degree), as `mesh_arrivals` draws them; or a number of lossless steps.
        inputs: inputs of the plant (horizon, inputs); by default a plant without inputs is assumed.

    Raises:
        ValueError: no such fusion, more than 2,000 nodes, flags of another shape.

    Source: Bar-Shalom, On the track-to-track correlation problem (1981), for all pairs of a graph.
    """
    mesh = find_mesh(network, fusion)
    if mesh.alpha is not None or mesh.quantizer is not None:
        got = "a quantizer" if mesh.alpha is None else f"alpha {mesh.alpha:g}, by which data decide what is sent"
        raise fail(f"errors of fusion {fusion!r} before any data", "estimates that are sent at every step, as they are",
                   got)  # fmt: skip
    flags = _read_arrivals(mesh, arrived)
    network.check_horizon(len(flags))
    u = read_plant_inputs(network, inputs, len(flags))
    # Step by step: J, the true covariances on its diagonal, and those that the nodes state.
    actual, claimed, last_joint = [], [], np.zeros(())
    for joint, covariances, claims in propagate_errors_over_time(mesh, flags, u):
        actual.append(covariances)
        claimed.append(claims)
        last_joint = joint
    count, n = len(mesh.nodes), actual[0].shape[-1]
    return MeshErrors(
        nodes=mesh.nodes,
        actual=np.stack(actual),
        claimed=np.stack(claimed),
        joint=last_joint.reshape(count, n, count, n),
        claim=find_claim_of_errors(fusion, network.meshes[fusion], network),
    )


def propagate_errors_over_time(
    mesh: Mesh, flags: np.ndarray, u: np.ndarray
) -> Iterator[tuple[np.ndarray, np.ndarray, np.ndarray]]:
    """Yield the errors' joint covariance (N = nodes n), its diagonal blocks (node, n, n), and what nodes say these are.

    Args:
        mesh: the fusion between neighbours.
        flags: what arrives at each step (step, node, rounds, degree).
        u: inputs of the plant (step, inputs).
    """
    with jax.enable_x64(True):
        start = to_numpy(mesh.init())
    # Before any data all nodes have the same error, x_0 - E x_0: every block of the joint covariance J is Cov x_0.
    # `moments`: mean and covariance of the plant's state x before any data; `covariance`: what rules weigh by.
    covariance, moments = start.covariance, start.plant
    _, initial_covariance = start.plant
    count, n = start.mean.shape
    joint = np.tile(initial_covariance, (count, count))
    needs_joint = mesh.needs_joint
    for k, (arrived, u_k) in enumerate(zip(flags, u, strict=True)):
        blocks = np.asarray(blocks_of(joint.reshape(count, n, count, n), mesh.senders)) if needs_joint else None
        with jax.enable_x64(True):
            step = to_numpy(
                _compute_step_when_all_is_measured(mesh, covariance, blocks, moments, arrived, u_k, np.asarray(k))
            )
        joint = _propagate_joint(mesh, joint, step, arrived)  # J+ = M J M' + F Q F' + sum_l W_l S_l W_l'
        covariance, moments = step.gains.covariance, step.plant
        diagonal_blocks = np.einsum("iaib->iab", joint.reshape(count, n, count, n)).copy()
        # Nodes that follow the joint covariance claim their part of it, the others the covariance of their rule.
        yield joint, diagonal_blocks, diagonal_blocks if needs_joint else covariance


@quickly_compiled
def _compute_step_when_all_is_measured(
    mesh: Mesh, covariance: np.ndarray, blocks: np.ndarray | None, moments: PyTree, arrived: np.ndarray,
    u: np.ndarray, k: np.ndarray,
) -> MeshStep:  # fmt: skip
    """Return what does not depend on the estimates in step k, such as gains, if no measurement is missing.

    `covariance` (node, n, n) weighs the nodes' estimates before the step, `blocks` (node, degree, n, degree, n) is the
    joint covariance of each node's and its neighbours' errors if the rule needs it, `moments` are the mean and
    covariance of the plant's state, and `arrived` (node, rounds, degree) says which messages arrive.
    """
    measured = np.ones((len(mesh.senders), mesh.observation_model.size), dtype=bool)
    return mesh.compute_step_without_estimates(covariance, blocks, moments, measured, arrived, u, k)


def _propagate_joint(mesh: Mesh, joint: np.ndarray, step: MeshStep, arrived: np.ndarray) -> np.ndarray:
    """Return the joint covariance J+ = M J M' + F Q F' + sum_l W_l S_l W_l' of all errors after a step, N = nodes n.

    Node i adds W_il H_l' R_l^-1 z_l of node l's measurement z_l, and S_l = H_l' R_l^-1 H_l. M mixes the errors of
    neighbours, F is what the corrections leave of the plant's noise of covariance Q. The matrices (N, N) are sparse.
    `joint` is J, and `arrived` (node, rounds, degree) says which messages arrive.
    """
    gains, present, senders = step.gains, mesh.edges.present, mesh.senders
    # Each round of exchange before the last only fuses: e_i + sum_j C_ij (e_j - e_i), so that C_ii = I - sum_j C_ij.
    for number, weights in enumerate(step.exchanges):
        c_if_all_arrive = weights.common_factor[:, None] @ weights.neighbour_factors
        c = np.where(arrived[:, number, :, None, None], c_if_all_arrive, 0.0)
        c[:, 0] = np.eye(c.shape[-1]) - c[:, 1:].sum(axis=1)
        joint = np.asarray(propagate_by_mode(scatter_blocks(c, senders, present), joint, 0.0))
    m = scatter_blocks(error_transitions(gains, step.motion.matrix), senders, present)
    # Whose measurements a node has: its neighbours' (node, degree), or after several rounds any node's (node, node).
    known = arrived[:, 0] & present
    if mesh.edges.rounds > 1:
        known = np.asarray(mesh.find_known_measurements(arrived))
        senders = np.broadcast_to(np.arange(len(known)), known.shape)
    weight_blocks = measurement_weights(gains.gain, known)  # W_il
    ws = scatter_blocks(weight_blocks @ step.data.information[senders], senders, known)
    w = scatter_blocks(weight_blocks, senders, known)
    return np.asarray(propagate_joint_covariance(joint, m, gains.correction_map, step.motion.noise, ws, w))


def best_possible(
    network: Network,
    fusion: str,
    arrived: Bool[ArrayLike, "horizon node rounds degree"] | int,
    inputs: Float[ArrayLike, "horizon inputs"] | None = None,
) -> Float[np.ndarray, "node n n"]:
    """Return a lower bound on the covariance of every node's error after the last step, which no linear rule can beat.

    Node j's measurement can be at node i only if messages carried it there since. A Riccati recursion from the plant's
    initial covariance uses all that can be there, oldest first. If all laws are Gaussian, no rule at all is better.

    Args:
        network: the network.
        fusion: name of its fusion between neighbours.
        arrived: which messages arrive (horizon, node, rounds, degree), or a number of steps at which all arrive.
        inputs: inputs of the plant (horizon, inputs); by default a plant without inputs is assumed.

    Raises:
        ValueError: no such fusion, flags of another shape.
    """
    mesh = find_mesh(network, fusion)
    flags = _read_arrivals(mesh, arrived)
    u = read_plant_inputs(network, inputs, len(flags))
    # Models of plant and measurements at each step.
    with jax.enable_x64(True):
        start = to_numpy(mesh.init())
        steps: list[MeshStep] = []
        moments = start.plant
        for k, u_k in enumerate(u):
            steps.append(to_numpy(compute_full_step(mesh, start.covariance, moments, u_k, np.asarray(k))))
            moments = steps[-1].plant
    # Riccati recursions of all nodes side by side, oldest measurement first, for P = root root': the columns (A root,
    # Q^1/2) are a root of P- = A P A' + Q, and P = (P-^-1 + S)^-1 with S = `information` of all that can be there.
    count = len(mesh.nodes)
    root = roots_of(np.asarray(start.covariance))
    for model, information in zip(steps, _sum_known_information(mesh, flags, steps), strict=True):
        a, process = np.asarray(model.motion.matrix), roots_of(np.asarray(model.motion.noise))
        process = np.broadcast_to(process, (count, *process.shape))
        root = observe_information(np.concatenate([a @ root, process], axis=-1), information).root
    return covariance_of_root(root)


def _sum_known_information(mesh: Mesh, flags: np.ndarray, steps: Sequence[MeshStep]) -> list[np.ndarray]:
    """Return for each step the sum of H_j' R_j^-1 H_j over the measurements that reach a node by the last step.

    A measurement reaches a node if messages carry it there at its own step or later. Each sum is (node, n, n).

    Args:
        mesh: the fusion between neighbours.
        flags: which messages arrive (step, node, rounds, degree).
        steps: models of all steps, with the information of each node's measurement.
    """
    count = len(mesh.nodes)
    # From the last step back: a measurement passes through the exchanges of its own step and of all later ones.
    # `reaches` is sparse (node, node), with a one where data of the column's node reach the row's node by the end.
    reaches: Any = scipy.sparse.csr_array(np.eye(count, dtype=np.int32))
    information: list[np.ndarray] = []
    for step, arrived in zip(reversed(steps), reversed(flags), strict=True):
        for round_number in reversed(range(mesh.edges.rounds)):
            reaches = _extend_known_data(reaches, mesh, arrived[:, round_number])
        information_of_nodes = np.asarray(step.data.information)
        information.append((reaches @ information_of_nodes.reshape(count, -1)).reshape(information_of_nodes.shape))
    return information[::-1]


@quickly_compiled
def compute_full_step(mesh: Mesh, covariance: np.ndarray, moments: PyTree, u: np.ndarray, k: np.ndarray) -> MeshStep:
    """Return step k as if everything arrived; callers use its models of plant and measurements, not its gains.

    Args:
        mesh: the fusion between neighbours.
        covariance: of the nodes' estimates (node, n, n); it only matters to the gains, so any regular one will do.
        moments: mean (n,) and covariance (n, n) of the plant's state before the step, before any data.
        u: inputs of the plant over the step.
        k: number of the step.
    """
    all_arrive = mesh.edges.lossless()
    measured = np.ones((len(mesh.senders), mesh.observation_model.size), dtype=bool)
    blocks = None
    if mesh.needs_joint:  # zeros will do, since the blocks matter to the gains alone
        degree, n = mesh.senders.shape[1], covariance.shape[-1]
        blocks = jnp.zeros((len(mesh.senders), degree, n, degree, n))
    return mesh.compute_step_without_estimates(covariance, blocks, moments, measured, all_arrive, u, k)


def _extend_known_data(known: Any, mesh: Mesh, present: np.ndarray) -> Any:
    """Return which nodes' data reach which node, with one more exchange between neighbours put before those counted.

    `known`: sparse (node, node), a one where data of the column's node reach the row's node. `present`: which messages
    arrive in the new exchange (node, degree).
    """
    receiver, neighbour_index = np.nonzero(present)
    ones = np.ones(len(receiver), dtype=np.int32)
    exchange = scipy.sparse.csr_array((ones, (receiver, mesh.senders[receiver, neighbour_index])), shape=known.shape)
    extended = known @ exchange  # `exchange`: a one where the row's node receives the column's
    extended.data = np.minimum(extended.data, 1)
    return extended


def freeze(
    network: Network,
    fusion: str,
    arrived: Bool[ArrayLike, "horizon node rounds degree"],
    last: int = 50,
    inputs: Float[ArrayLike, "horizon inputs"] | None = None,
) -> Network:
    """Return the network whose best weights between neighbours are those for the mean of drawn joint covariances.

    Best weights need the joint covariance J of all nodes' errors, which is costly to follow. So J is followed once,
    along these arrivals, and the mean over the last steps of its blocks (a node and its neighbours) is stored in the
    rule of fusion. The network then runs without J, on thousands of nodes; its claim is "nominal", neither exact nor a
    bound.

    Args:
        network: the network; its fusion may have more nodes than `Fusion` follows.
        fusion: name of its fusion between neighbours by best weights.
        arrived: True where a message arrives (horizon, node, rounds of exchange in a step, degree), such as
            `mesh_arrivals` draws; the axis `degree` has the node itself first, then its neighbours.
        last: number of last steps over which blocks are averaged, 50 by default.
        inputs: inputs of the plant (horizon, inputs); by default a plant without inputs is assumed.

    Raises:
        ValueError: no such fusion, one by another rule, more steps to average than there are.
    """
    mesh = find_mesh(network, fusion)
    old = network.meshes[fusion]
    if not old.rule.needs_joint:
        raise fail(f"fusion {fusion!r} to freeze", "best weights such as DiagonalWeights()", type(old.rule).__name__)
    flags = _read_arrivals(mesh, arrived)
    if check_count("last", last) > len(flags):
        raise fail("last", f"at most the {len(flags)} steps", last)
    u = read_plant_inputs(network, inputs, len(flags))
    # Sum over the last steps of each neighbourhood's block of J (node, degree, n, degree, n).
    total: np.ndarray | None = None
    by_nodes = (len(mesh.nodes), len(network.states)) * 2  # the shape of J as (node, n, node, n)
    for k, (joint, _, _) in enumerate(propagate_errors_over_time(mesh, flags, u)):
        if k >= len(flags) - last:
            blocks = np.asarray(blocks_of(joint.reshape(by_nodes), mesh.senders))
            total = blocks if total is None else total + blocks
    assert total is not None  # since 1 <= last <= steps
    frozen = Fusion(old.filter, FrozenWeights(old.rule, total / last), neighbours=old.neighbours, link=old.link)
    return Network(network.plant, network.nodes, {**network.fused, **network.meshes, fusion: frozen})


def find_mesh(network: Network, fusion: str) -> Mesh:
    """Return the fusion of this name between neighbours, ready to be stepped; raise ValueError if there is none.

    It also raises for more than SPARSE (2,000) nodes, whose joint covariance would not fit in memory.
    """
    what = "errors between neighbours before any data"
    instance("network", network, Network, "a Network").check_sends_each_step(what)
    network.check_sends_numbers(what)
    if not isinstance(fusion, str) or fusion not in network.meshes:
        raise fail("fusion", f"one between neighbours, of {list(network.meshes)}", repr(fusion))
    if len(network.mesh_nodes(fusion)) > SPARSE:
        raise fail(f"fusion {fusion!r}", f"at most {SPARSE} nodes, for the covariance of all their errors",
                   len(network.mesh_nodes(fusion)))  # fmt: skip
    return build_mesh(network, fusion)


def _read_arrivals(mesh: Mesh, arrived: Any) -> Bool[np.ndarray, "horizon node rounds degree"]:
    """Return flags of which messages arrive at each step; raise ValueError if `arrived` does not fit.

    `arrived`: flags of this shape, or a number of steps at which everything arrives. Late messages (a longest delay
    `mesh.edges.past` > 0) are refused, since flags say nothing of ages.
    """
    if mesh.edges.past:
        raise fail("errors between neighbours before any data", "messages that arrive at once or are lost", "late ones")
    shape = (len(mesh.senders), mesh.edges.rounds, mesh.senders.shape[1])
    if is_whole(arrived):
        return np.repeat(mesh.edges.lossless()[None], check_count("number of steps", arrived), axis=0)
    flags = np.asarray(arrived)
    if flags.dtype != bool or flags.ndim != 4 or flags.shape[1:] != shape or not len(flags):
        raise fail("arrivals", f"a number of steps, or flags of shape (steps, {', '.join(map(str, shape))})",
                   f"{flags.dtype} of shape {flags.shape}")  # fmt: skip
    arrivals: np.ndarray = flags & mesh.edges.present[:, None]  # nothing comes where there is no neighbour
    return arrivals
