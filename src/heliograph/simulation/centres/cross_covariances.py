"""Moments of a network of linear filters before any data: cross-covariances of errors, and fused covariances."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.linear.precomputed_filter import LinearStep
from heliograph.fusion.cross_covariance import ErrorSources, SourceFactors, make_initial_factors
from heliograph.fusion.joint_covariance_fusion import MatrixWeights
from heliograph.fusion.joint_covariance_weights import matrix_weights, solve_factored_weights
from heliograph.fusion.network_fusion import Fusion
from heliograph.numerics.check import check_horizon, fail, instance
from heliograph.numerics.float64 import quickly_compiled, to_numpy
from heliograph.numerics.module import readable
from heliograph.numerics.types import ArrayLike, Float, PyTree
from heliograph.simulation.arguments import read_plant_inputs
from heliograph.simulation.centres.observation_model import SharedObservation
from heliograph.simulation.network import Network
from heliograph.simulation.network_filters import AllFilters
from heliograph.simulation.precomputed_filters import precompute_filters

REGULAR = 1e-6  # least eigenvalue of the independent part of an error, relative to the error: then U has an inverse


@readable
@dataclass(frozen=True)
class CrossCovariances:
    """Joint moments of the plant's state x and of the errors e_i = x - xhat_i of filters at `nodes`, after some steps.

    x = mean + state s and e_i = bias_i + shared_i s + a_i, with s white of covariance I (the initial state of the plant
    and its noise at each step) and a_i independent between nodes, of covariance independent_i. Biases are zero where
    the filters' model is the world.

    Args:
        nodes: names of the nodes.
        states: names of the plant's states.
        mean: E x (n,).
        state: deviation of x by sources (n, sources).
        bias: E e_i (node, n).
        shared: part of e_i by sources (node, n, sources).
        independent: covariance of the rest of e_i (node, n, n).
    """

    nodes: tuple[str, ...]
    states: tuple[str, ...]
    mean: Float[np.ndarray, " n"]
    state: Float[np.ndarray, "n sources"]
    bias: Float[np.ndarray, "node n"]
    shared: Float[np.ndarray, "node n sources"]
    independent: Float[np.ndarray, "node n n"]

    @property
    def joint(self) -> Float[np.ndarray, "node n node n"]:
        """Covariance Cov(e_i, e_j) of all pairs of nodes' errors."""
        return np.asarray(self._error_sources.joint())

    @property
    def of_state(self) -> Float[np.ndarray, "node n n"]:
        """Cross-covariance Cov(e_i, x) of each node's error with the state."""
        return np.asarray(self.shared @ self.state.T)

    @property
    def state_covariance(self) -> Float[np.ndarray, "n n"]:
        """Covariance of the plant's state, Cov x."""
        return np.asarray(self.state @ self.state.T)

    def matrix_weights(self) -> tuple[Float[np.ndarray, "n node n"], Float[np.ndarray, "n n"]]:
        """Return the best unbiased weights W of the nodes' estimates, and the covariance W P W' of the fused error.

        P is the joint covariance of the nodes' errors. The time is linear in the number of nodes if the covariance of
        each error's independent part is regular.
        """
        weights = _choose_weights(self._error_sources)
        # The fused error is B s + a with Cov s = I: a factor B of the shared sources s, and Cov a of the rest.
        factor, independent = self._error_sources.weigh(weights)
        return weights, np.asarray(factor @ factor.T + independent)

    @property
    def _error_sources(self) -> ErrorSources:
        """The errors by their sources: the shared part, and the covariance of the independent part."""
        return ErrorSources(self.shared, self.independent)

    def fused(self, relays: Mapping[str, Sequence[str]]) -> "CrossCovariances":
        """Return the moments at relays that forward the matrix-weighted estimate of their nodes.

        The nodes' errors are e_i = shared_i s + a_i, with sources s of covariance I that all have in common and a_i
        independent, of covariance independent_i. A relay fuses the estimates of its nodes with weights W, so its error
        W e has the sources W shared and the independent covariance W independent W', as long as no two relays receive
        the same node. Known means of the errors are subtracted. Apply it level by level for a deeper tree of relays;
        its root is `matrix_weights` of the last level.

        Args:
            relays: names of the nodes that each relay receives, by name of the relay.

        Raises:
            ValueError: no relays, a relay without nodes, unknown nodes, a node that two relays receive.
        """
        self._check_relays(relays)
        # Weights of each relay's nodes, and the moments of its error.
        index = {name: i for i, name in enumerate(self.nodes)}
        relayed = []
        for names in relays.values():
            rows = [index[name] for name in names]
            received = ErrorSources(self.shared[rows], self.independent[rows])
            relayed.append(received.weigh(_choose_weights(received)))
        shared, independent = (np.stack(leaves) for leaves in zip(*relayed, strict=True))
        return CrossCovariances(
            nodes=tuple(relays),
            states=self.states,
            mean=self.mean,
            state=self.state,
            bias=np.zeros((len(relays), len(self.mean))),
            shared=shared,
            independent=independent,
        )

    def _check_relays(self, relays: Mapping[str, Sequence[str]]) -> None:
        """Raise ValueError unless each relay receives some of the nodes, and no node has two relays.

        `relays`: names of the nodes that each relay receives. A node with two relays would make their errors dependent
        in a way that the factors do not hold.
        """
        received_nodes = [name for names in relays.values() for name in names]
        unknown = sorted(set(received_nodes) - set(self.nodes))
        if not relays or unknown or not all(relays.values()):
            raise fail("relays", "each with some of the nodes", f"unknown ones {unknown}" if unknown else "none")
        if len(set(received_nodes)) < len(received_nodes):
            repeated = sorted({name for name in received_nodes if received_nodes.count(name) > 1})
            raise fail("nodes", "one relay for each", f"several for {repeated}")


def _choose_weights(errors: ErrorSources) -> Float[np.ndarray, "n node n"]:
    """Return the weights (n, node, n) of least error variance for the nodes' estimates with these errors.

    If the independent part of every error is regular enough (above REGULAR), the weights come from factors, at a cost
    linear in the number of nodes. Otherwise they come from the joint covariance of all errors.
    """
    # Scale each component by its whole deviation, so that eigenvalues of the independent parts can be compared.
    deviation = np.sqrt(np.einsum("iaa->ia", errors.covariances()))
    deviation = np.where(deviation > 0, deviation, 1.0)
    scaled = errors.independent / (deviation[:, :, None] * deviation[:, None])
    is_regular = np.linalg.eigvalsh(scaled)[:, 0].min() > REGULAR
    return np.asarray(solve_factored_weights(*errors) if is_regular else matrix_weights(errors.joint()))


def cross_covariances(
    network: Network, filter: str, horizon: int, inputs: Float[ArrayLike, "horizon inputs"] | None = None
) -> CrossCovariances:
    """Compute how the errors of the filters of this name are correlated after `horizon` steps of complete data.

    Errors of two nodes are correlated since both follow the same plant: with the plant's A and Q, the gain K_i and the
    output matrix H_i of node i, and S_ij the covariance of two nodes' noises, P_ij+ = F_i (A P_ij A' + Q) F_j' +
    K_i S_ij K_j', F_i = I - K_i H_i. It holds for any gains K_i, and where a filter's model is wrong, the error that
    this causes is in P_ij too. The result holds the covariances of all pairs as factors.

    Args:
        network: a network of linear filters.
        filter: name of the filter, at every node that has it.
        horizon: number of steps.
        inputs: inputs of the plant (horizon, inputs); by default a plant without inputs is assumed.

    Raises:
        ValueError: a network that is not linear, filters whose gains depend on data, channels with memory, senders that
            decide when to transmit.

    Source: Bar-Shalom, On the track-to-track correlation problem (1981), with the second moments of random gains.
    """
    instance("network", network, Network, "a Network")
    # A centre that fuses with matrix weights propagates the joint covariance of the nodes' errors: make one for the
    # filters of this name, in a network without other fusions.
    fusion = Fusion(filter, MatrixWeights())
    alone = Network(network.plant, network.nodes, {"all": fusion}, network.relays, network.common)
    filters, u = _plan_network_filters(alone, horizon, inputs)
    with jax.enable_x64(True):
        factors: SourceFactors = to_numpy(_compute_joint_error_factors(filters, u))
    return CrossCovariances(
        nodes=tuple(network.nodes_with(filter)),
        states=network.states,
        mean=np.asarray(factors.mean[0]),  # row 0 is the plant's, the others the nodes' errors'
        state=np.asarray(factors.state),
        bias=np.asarray(factors.mean[1:]),
        shared=np.asarray(factors.errors.shared),
        independent=np.asarray(factors.errors.independent),
    )


def fused_covariances(
    network: Network, horizon: int, inputs: Float[ArrayLike, "horizon inputs"] | None = None
) -> dict[str, Float[np.ndarray, "time n n"]]:
    """Return the covariances (time, n, n) of the errors of the network's informed fusions, by name, for complete data.

    An informed fusion is one by a rule that needs the joint covariance of its estimates' errors, as `MatrixWeights`.

    Args:
        network: a network with informed fusions of linear filters.
        horizon: number of steps.
        inputs: inputs of the plant (horizon, inputs); by default a plant without inputs is assumed.

    Raises:
        ValueError: a network without an informed fusion.
    """
    instance("network", network, Network, "a Network")
    filters, u = _plan_network_filters(network, horizon, inputs)
    with jax.enable_x64(True):
        results: dict[str, np.ndarray] = to_numpy(_compute_fused_covariances(filters, u))
    return results


def _plan_network_filters(network: Network, horizon: int, inputs: ArrayLike | None) -> tuple[AllFilters, np.ndarray]:
    """Return the network's filters, planned for the inputs, and the inputs (horizon, inputs).

    An informed fusion is one by a rule that needs the joint covariance of the nodes' errors. Everything that depends on
    no data, such as gains, is computed ahead.

    Raises:
        ValueError: no informed fusion, senders that decide when to transmit, or filters whose gains depend on data.
    """
    network.check_horizon(check_horizon(horizon))
    network.check_sends_each_step("covariances before data")
    network.check_sends_numbers("covariances before data")
    u = read_plant_inputs(network, inputs, horizon)
    filters = AllFilters(network)
    if not filters.centres:
        raise fail("fused covariances", "a fusion that knows the errors' joint covariance", "none in the network")
    if len(filters.linear_centres) < len(filters.centres):
        raise fail("covariances before data", "filters whose gains depend on no data", "some whose gains do")
    return precompute_filters(filters, u), u


@quickly_compiled
def _compute_joint_error_factors(filters: AllFilters, u: np.ndarray) -> SourceFactors:
    """Return the joint covariance of all nodes' errors after the steps of u, as roots times independent sources.

    `filters` has one fusion by the errors' joint covariance, whose centre has the models of the errors' recursion.
    """
    (centre,) = filters.linear_centres
    filter_states, _, _, (centre_state,), *_ = filters.init()  # of the nodes' filters, and of the one centre
    nodes, n = centre_state.errors.bias.shape  # mean errors (node, n)
    # Each step adds sources: n of the plant's noise and, where nodes share their measurement noises, as many as all
    # nodes receive numbers.
    are_shared = isinstance(centre.observation_model, SharedObservation)
    sources_per_step = n + (nodes * centre.size if are_shared else 0)
    start = filter_states, make_initial_factors(centre_state.errors, sources_per_step * len(u))

    def compute_matrices(states: PyTree, u_k: jax.Array, k: jax.Array) -> LinearStep:
        """Return the matrices of all nodes' filters in step k, from their states before it."""
        return centre.gather_matrices(filters.list_step_matrices(centre, states, u_k, k))

    return centre.propagate_error_factors(start, compute_matrices, filters.step_without_data, u)


@quickly_compiled
def _compute_fused_covariances(filters: AllFilters, u: np.ndarray) -> PyTree:
    """Return the covariances (time, n, n) of all fused estimates, by name, over the steps of u.

    Gains depend on no data, so that covariances are propagated alone: those of the nodes' filters, whose gains they
    give, and with these gains the joint covariance of all errors in each fusion centre.
    """

    def step(carry: tuple[PyTree, PyTree], row: tuple[jax.Array, jax.Array]) -> tuple[PyTree, PyTree]:
        """Step all covariances: of the nodes' filters, and of the centres by these filters' matrices.

        Covariances do not depend on data, so means are taken as 0. `centre.sources`: (stack, number in it) of each
        filter that a centre fuses; a stack has filters that differ in numbers alone.
        """
        states, centre_states = carry
        k, u_k = row
        covariances: dict[str, jax.Array] = {}
        next_centre_states = []
        for centre, state in zip(filters.linear_centres, centre_states, strict=True):
            means = [jnp.zeros((filters.stacks[stack].nodes, filters.n)) for stack, _ in centre.sources]
            matrices = filters.list_step_matrices(centre, states, u_k, k)
            after, estimates = centre.step(state, matrices, means, u_k, k)
            next_centre_states.append(after)
            covariances |= {name: jnp.asarray(estimate.covariance) for name, estimate in estimates.items()}
        return (filters.step_without_data(states, u_k, k), tuple(next_centre_states)), covariances

    states, _, _, centre_states, *_ = filters.init()  # of the nodes' filters by stack, and of the centres
    _, covariances = jax.lax.scan(step, (states, centre_states), (jnp.arange(len(u)), jnp.asarray(u)))
    return covariances
