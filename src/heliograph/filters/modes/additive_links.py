"""Best linear filter behind a sum of links with memory: state times functions of the mode of each link.

The mean gain of a sum of links given their modes is a sum of functions of one link's mode each,
E[H | modes] = Hbar + sum_a D_a phi_a, with phi_a = 1{mode of a link = j} - P(j) for all its modes j but the first,
D_a = H_j - H_first and Hbar = E[H]. The phi_a follow a linear recursion of their own, link by link,
E[phi_j+ | modes] = sum_i (Pi_ij - Pi_first,j) phi_i, so that a Kalman filter of zeta = (x~, x~ phi_1, x~ phi_2, ...) is
the best linear filter of x: 1 + sum_i (m_i - 1) blocks, where the joint modes of the links are prod_i m_i.

With Gamma = E[phi phi'] of phi = (1, phi_1, ...), which independent links make block-diagonal, all covariances are sums
of Kronecker products Gamma (x) E[x~ x~'], x~ = (x - c, 1) with c = E[x] before data.
"""

from collections.abc import Sequence
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import block_diag

from heliograph.engine.choice import compile_on_call
from heliograph.factors.covariance_factors import (
    WeightedColumns,
    join_columns,
    rounding_of,
    side_by_side,
    triangularise,
)
from heliograph.factors.factored_gaussian import Gaussian, from_columns, from_covariance
from heliograph.filters.base import Step, corrects, make_sizes, predicts
from heliograph.filters.gaussian.signal_moments import factor_covariance
from heliograph.filters.modes.channel_by_mode import ChannelByMode, channels_by_mode
from heliograph.filters.modes.jump_linear_filter import (
    AbstractModalFilter,
    MeasurementModel,
    claim_of_modes,
    concatenate_modes,
    condition_modes_on_received,
)
from heliograph.filters.modes.linear_by_mode import (
    centred_measurement,
    centred_transition,
    covariance_of_mode,
    kron,
    multiply_by_transition,
    pad_with_zeros,
)
from heliograph.filters.smoother_step import SmootherStep, StepTrace, smoother_step_of
from heliograph.model.channel import Channel
from heliograph.model.estimate import Claim, Innovation
from heliograph.model.over_time import OverTime, at, first, unstack, vary_over_steps
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor
from heliograph.numerics.linalg import outer
from heliograph.numerics.types import Array, ArrayLike, Bool, Float
from heliograph.random_affine.sum_of_maps import split_terms_without_common_memory

Terms = tuple[ChannelByMode | OverTime, ...]  # of a sum, each with modes of its own
Laws = tuple[jax.Array, ...]  # of the modes of each term


class AdditiveBelief(NamedTuple):
    """zeta given the data, and before any data E[x~ x~'] and the laws of the modes.

    centre c = E[x] before data. `moved` is true from the first prediction on.

    Shapes: zeta ((1 + functions) (n + 1),), second (n + 1, n + 1), centre (n,).
    """

    gaussian: Gaussian
    second: Float[jax.Array, "n1 n1"]
    laws: Laws
    centre: Float[jax.Array, " n"]
    moved: Bool[jax.Array, ""]


class AdditiveModalFilter(AbstractModalFilter):
    """The linear minimum-mean-square-error filter of a linear plant behind a sum of links with memory.

    It equals the filter of all links' joint modes. But for a sum of links it is enough to estimate the products of the
    state with one function for each mode of a link but the first. The innovation covariance is exact; the innovation is
    not Gaussian, so its likelihood is nominal.

    Source: Costa, Linear minimum mean square error estimation for discrete-time Markovian jump linear systems (1994),
    of functions of the modes.
    """

    terms: Terms
    initial: tuple[Array, ...]

    @compile_on_call
    def init(self) -> AdditiveBelief:
        """Return the prior of zeta = phi (x) x~, Kronecker's product, where x~ and the modes are independent.

        x~ = (x - c, 1) with c = E[x]. phi holds 1, and 1{mode = j} - P(j) for each link's modes j but the first. Since
        these have mean 0, Cov zeta is block-diagonal: Cov x~ for the function 1, Cov(indicators) (x) E[x~ x~'] for each
        link.
        """
        start = at(self.plant, k=0)
        covariance = pad_with_zeros(jnp.asarray(start.initial_covariance))  # Cov x~
        second_moment = covariance.at[-1, -1].set(1.0)  # E[x~ x~'], as E x~ = (0, 1)
        laws = tuple(jnp.asarray(law) for law in self.initial)
        blocks = [covariance, *(jnp.kron(_indicator_covariance(law), second_moment) for law in laws if len(law) > 1)]
        centre = jnp.asarray(start.initial_mean)
        mean = self._embed_first_block(jnp.append(centre, 1.0))
        return AdditiveBelief(
            gaussian=from_covariance(mean, block_diag(*blocks)),
            second=second_moment,
            laws=laws,
            centre=centre,
            moved=jnp.asarray(False),
        )

    @predicts
    def predict(self, state: AdditiveBelief, u: ArrayLike = (), k: Step = 0) -> AdditiveBelief:
        """Predict zeta+ = F zeta + noise, for zeta = phi (x) x~ and F = T (x) A~ (Kronecker's product).

        x~ = (x - c, 1) with the centre c = E[x] before any data. phi holds 1, and 1{mode = j} - P(j) for each link's
        modes j but the first, with E[phi+ | phi] = T phi. At the first prediction the modes keep their initial law.
        """
        A, Q, next_centre = centred_transition(at(self.plant, k), u, state.centre)  # A~ and Q~
        transitions = self._transition_matrices(state, k)
        # The mean of zeta counts x from 0: its first block is (c, 0) plus that of `deviation`, which F moves.
        deviation = state.gaussian.mean - self._mean_from_centre(state.centre)
        T = _function_transition(transitions)
        mean = multiply_by_transition(deviation[:, None], A, T.T)[:, 0] + self._mean_from_centre(next_centre)
        # Cov zeta = L diag(variances) L' becomes F L diag(variances) (F L)' + Cov noise.
        slopes, noise = self._transition_factors(state, u, k)
        predicted = from_columns(mean, join_columns(WeightedColumns(slopes, state.gaussian.variances), noise))
        return AdditiveBelief(
            gaussian=predicted,
            second=A @ state.second @ A.T + Q,  # E[x~+ x~+']
            laws=_next_laws(state.laws, transitions),
            centre=next_centre,
            moved=jnp.asarray(True),
        )

    @corrects
    def correct(self, state: AdditiveBelief, z: ArrayLike, k: Step = 0) -> tuple[AdditiveBelief, Innovation]:
        """Correct with the components of z that arrived: the Kalman update of z = common + H zeta + v.

        zeta holds the products of x~ = (x - centre, 1) and functions of the modes of the links.
        """
        model, zeta = self._measurement_model(state, k), state.gaussian
        # The mean of zeta counts x from 0, the model of z from the centre: `deviation` is the mean of products of x~.
        deviation = zeta.mean - self._mean_from_centre(state.centre)
        corrected, innovation = condition_modes_on_received(zeta, deviation, model, z)
        return state._replace(gaussian=corrected), innovation

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return the smoother step of zeta+ = F zeta + noise.

        zeta holds the products of x~ = (x - centre, 1) and functions of the modes, the first of which is 1. `slopes` is
        F L for zeta = E zeta + L xi. The projection to the first block of zeta returns the plant's state x.
        """
        slopes, noise = self._transition_factors(step.before, step.u, step.k)
        slopes_and_noise = slopes, triangularise(noise)
        return smoother_step_of(step, slopes_and_noise, self.claim, projection=self._projection_to_state())

    def _projection_to_state(self) -> Float[np.ndarray, "n N"]:
        """Return the matrix (n, N) that maps zeta, whose first block is (x, 1), to x: [I, 0, 0, ...]."""
        return np.eye(len(self.states), (len(self.states) + 1) * self._function_count)

    @property
    def _function_count(self) -> int:
        """Number of functions phi of the modes: the constant 1, and one for each mode of a link i but its first."""
        return 1 + sum(len(law) - 1 for law in self.initial)

    def _embed_first_block(self, first: jax.Array) -> jax.Array:
        """Return a vector as the first block of zeta, with zeros in all others.

        zeta has a block of length n + 1 for each function of the modes; the first function is 1.
        """
        return jnp.pad(first, (0, (self._function_count - 1) * len(first)))

    def _mean_from_centre(self, centre: jax.Array) -> jax.Array:
        """Return (c, 0) in the first block, and 0 in the others: what the mean of zeta gains if x counts from 0, not c.

        The first block is (x, 1). The others are its products with functions of the modes that have mean 0.
        """
        return self._embed_first_block(jnp.append(centre, 0.0))

    def _transition_matrices(self, state: AdditiveBelief, k: Step) -> Laws:
        """Return the transition matrix of the modes of each link in the sum, to step k.

        Before the first prediction modes keep their initial law, so that the matrices are identities.
        """
        chains = [jnp.asarray(term.transition) for term in at(self.terms, k)]
        return tuple(jnp.where(state.moved, chain, jnp.eye(len(chain))) for chain in chains)

    def _transition_factors(self, state: AdditiveBelief, u: ArrayLike, k: Step) -> tuple[jax.Array, WeightedColumns]:
        """Return F L, and columns of the noise's covariance, of zeta+ = F zeta + noise for zeta = E zeta + L xi.

        zeta = phi (x) x~ (Kronecker's product) for x~ = (x - c, 1) and functions phi = (1, phi_1, ...) of the modes,
        phi_j = 1{mode = j} - P(j). Now phi+ = T phi + e, e the draw of the next modes, and x~+ = A~ x~ + w~. So
        F = T (x) A~, and the noise is e (x) A~ x~ + phi+ (x) w~.
        """
        A, _, _ = centred_transition(at(self.plant, k), u, state.centre)  # A~
        transitions = self._transition_matrices(state, k)
        # Cov e of each chain: sum_i P(i) Cov(1{next mode} | mode = i) without the first mode; 0 for the function 1.
        draw_covariances = [
            jnp.einsum("i,ijl->jl", law, covariance_of_mode(transition)[:, 1:, 1:])
            for law, transition in zip(state.laws, transitions, strict=True)
        ]
        draw = _block_diagonal_columns(np.zeros((1, 0)), draw_covariances)
        # Cov(e (x) A~ x~) = Cov e (x) A~ E[x~ x~'] A~'
        moved_state = factor_covariance(A @ state.second @ A.T)
        noise_of_draw = WeightedColumns(
            kron(draw.matrix, moved_state.matrix), outer(draw.weights, moved_state.weights).reshape(-1)
        )
        # Cov(phi+ (x) w~) = E[phi+ phi+'] (x) Cov w~
        next_gamma = _second_moment_of_functions(_next_laws(state.laws, transitions))
        noise = join_columns(noise_of_draw, self.process_noise_by_mode(u, k, next_gamma))
        return multiply_by_transition(state.gaussian.root, A, _function_transition(transitions).T), noise

    def _measurement_model(self, state: AdditiveBelief, k: Step) -> MeasurementModel:
        """Return z = common + H zeta + v, with columns of Cov v, for the products zeta = (x~, x~ phi_1, ...).

        The filter estimates zeta, since links with memory make the gain depend on a hidden mode: x~ = (x - c, 1),
        c = E[x] before data, and phi_a = 1{a link is in mode j} - P(j). Received is z = G y~ + n, the sum of several
        links, of y~ = (y, 1) = C~ x~ + noise of the sensor with covariance R~. Given the modes the mean of (G, n) is
        sum_a D_a phi_a, with phi_0 = 1. `state` holds `second` = E[x~ x~'], `laws` = P(j) of each link's modes, and
        `centre` = c.
        """
        terms: tuple[ChannelByMode, ...] = at(self.terms, k)
        sensor = at(self.sensor, k)
        # Mean: E[z | zeta] = sum_a D_a C~ (x~ phi_a). The product of `1` in x~ with phi_0 is a constant, and goes to
        # `common`.
        C, R = centred_measurement(sensor, state.centre)  # C~ and R~
        gains = _gains_by_function(terms, state.laws)  # D_a
        output = gains @ C
        common = output[0, :, -1]
        # E[y~ y~'] = C~ E[x~ x~'] C~' + R~ (p + 1, p + 1); Gamma = E[phi phi'] = sum_c weight_c g_c g_c', g_c its
        # columns.
        signal_moment, gamma = C @ state.second @ C.T + R, _second_moment_of_functions(state.laws)
        # Noise of the sensor, sum_ab Gamma_ab D_a R D_b' = sum_c weight_c D_c R D_c' with D_c = sum_a g_ac D_a.
        gain_by_column = jnp.einsum("ac,amp->cmp", gamma.matrix, gains)
        sensor_columns = jnp.asarray(gain_by_column[:, :, :-1] @ sensor.noise.columns.matrix)
        weights = jnp.broadcast_to(sensor.noise.columns.weights, (len(sensor_columns), sensor_columns.shape[-1]))
        known_noise = [side_by_side(WeightedColumns(sensor_columns, weights), gamma.weights)]
        # Noise of each link, averaged over its modes j: sum_j P(j) Cov(n | j).
        known_noise += [side_by_side(term.noise, law) for term, law in zip(terms, state.laws, strict=True)]
        # Random gain about its mean in mode j: sum_j P(j) E[(G - E G) E[y~ y~'] (G - E G)' | j].
        gain_noise = sum(
            jnp.einsum("j,jmlab,ab->ml", law, jnp.asarray(term.gain_covariance), signal_moment)
            for term, law in zip(terms, state.laws, strict=True)
        )
        # Rounding errors of z, in proportion to its second moments (m,) sum_c weight_c (D_c E[y~ y~'] D_c')_mm.
        rounding = rounding_of(
            jnp.einsum("c,cmp,pq,cmq->m", gamma.weights, gain_by_column, signal_moment, gain_by_column)
        )
        noise = join_columns(*known_noise, rounding, factor_covariance(jnp.asarray(gain_noise)))
        # H is `output` by function without its constant, which is in `common`.
        return MeasurementModel(concatenate_modes(output.at[0, :, -1].set(0.0)), common, noise)


def _gains_by_function(terms: Sequence[ChannelByMode], laws: Laws) -> jax.Array:
    """Return Hbar and all D_a, stacked: (1 + functions, m, p + 1).

    z is the sum of the terms' H y. Hbar is the mean of H over all modes. D_a belongs to a mode that is not the first of
    its term: it is the mean gain in this mode less that in the term's first mode.
    """
    means = [jnp.asarray(term.mean) for term in terms]
    total_mean = sum(jnp.einsum("j,jmp->mp", law, mean) for law, mean in zip(laws, means, strict=True))
    return jnp.concatenate([jnp.asarray(total_mean)[None], *(mean[1:] - mean[:1] for mean in means)])


def _next_laws(laws: Laws, transitions: Laws) -> Laws:
    """Return the probabilities of the modes of each link in the sum one step later, p Pi."""
    return tuple(law @ transition for law, transition in zip(laws, transitions, strict=True))


def _function_transition(transitions: Laws) -> jax.Array:
    """Return T of E[phi+ | modes] = T phi: block-diagonal of 1 and, chain by chain, Pi_ij - Pi_first,j.

    phi holds 1, and for each chain of transition matrix Pi the indicators of all its modes but the first, less their
    probabilities. Since the indicators sum to 1, E[1{next = j} | mode] = sum_i Pi_ij 1{mode = i} is also
    Pi_first,j + sum_{i != first} (Pi_ij - Pi_first,j) 1{mode = i}. Less its mean, this is sum_i T_ji phi_i.
    """
    blocks = [(pi[1:, 1:] - pi[:1, 1:]).T for pi in transitions if len(pi) > 1]
    matrix: jax.Array = block_diag(np.eye(1), *blocks)
    return matrix


def _indicator_covariance(law: jax.Array) -> jax.Array:
    """Return Cov of the indicators 1{mode = j} of all modes but the first (M - 1, M - 1): diag(p) - p p'.

    p are their probabilities; `law` (M,) has those of all modes.
    """
    return jnp.diag(law[1:]) - jnp.outer(law[1:], law[1:])


def _second_moment_of_functions(laws: Laws) -> WeightedColumns:
    """Return columns of E[phi phi'], phi holding 1, and 1{mode = j} - P(j) for each link's modes j but the first.

    It is block-diagonal, as links are independent. `laws`: probabilities of each link's modes.
    """
    return _block_diagonal_columns(np.eye(1), [_indicator_covariance(law) for law in laws])


def _block_diagonal_columns(first_factor: np.ndarray, covariances: Sequence[jax.Array]) -> WeightedColumns:
    """Return the columns of blkdiag(one one', C_1, C_2, ...) for covariances C_i.

    `first_factor` (1, columns) is the factor `one` of the first block. An empty C_i adds nothing.
    """
    factors = [factor_covariance(covariance) for covariance in covariances if len(covariance)]
    weights = jnp.concatenate([jnp.ones(first_factor.shape[1]), *(factor.weights for factor in factors)])
    rows = sum(len(factor.matrix) for factor in factors)
    blocks: jax.Array = block_diag(*(factor.matrix for factor in factors)).reshape(rows, -1)
    # The first factor is one row. There are zeros to the right of it, and to the left of the other blocks.
    top = jnp.concatenate([jnp.asarray(first_factor), np.zeros((1, blocks.shape[1]))], axis=1)
    below = jnp.pad(blocks, ((0, 0), (first_factor.shape[1], 0)))
    return WeightedColumns(jnp.concatenate([top, below]), weights)


def additive_modal_filter(plant: AnyPlant, sensor: AnySensor, terms: Sequence[Channel]) -> AdditiveModalFilter:
    """Return the best linear filter behind a channel that is a sum of links, z = sum of all terms' z.

    The terms share no memory, so that their modes are independent. Each term has all outputs of the channel.
    """
    laws, models = zip(*(channels_by_mode(term) for term in terms), strict=True)
    claim: Claim = "exact" if all(claim_of_modes(term) == "exact" for term in terms) else "nominal"
    sizes = make_sizes(claim, first(plant), first(terms[0]).outputs)
    return AdditiveModalFilter(plant=plant, sensor=sensor, terms=models, initial=laws, **sizes)


def independent_terms(channel: Channel) -> list[Channel]:
    """Return the terms of a channel z = z_1 + z_2 + ... whose links share no memory, each as a channel of its own.

    Their modes are then independent, which a filter can use. A channel that cannot be split so is its own only term.
    """
    terms_by_step = [split_terms_without_common_memory(step) for step in unstack(channel)]
    # Steps that split differently have no terms in common.
    if len({len(terms) for terms in terms_by_step}) > 1 or len(terms_by_step[0]) == 1:
        return [channel]
    return [vary_over_steps(term_at_each_step, channel) for term_at_each_step in zip(*terms_by_step, strict=True)]
