"""Best linear filter behind a sum of links with memory: state times functions of the mode of each link.

The mean gain of a sum of links given their modes is a sum of functions of one link's mode each,
E[H | modes] = Hbar + sum_a D_a phi_a, with phi_a = 1{mode of a link = j} - P(j) for all its modes j but the first,
D_a = H_j - H_first and Hbar = E[H]. The phi_a follow a linear recursion of their own, link by link,
E[phi_j+ | modes] = sum_i (Pi_ij - Pi_first,j) phi_i, so that a Kalman filter of zeta = (x~, x~ phi_1, x~ phi_2, ...) is
the best linear filter of x: 1 + sum_i (m_i - 1) parts, where the joint modes of the links are prod_i m_i.

With Gamma = E[phi phi'] of (1, phi_1, ...), which independent links make block-diagonal, all covariances are sums of
products Gamma x E[x~ x~'], x~ = (x - c, 1) with c = E[x] before data.
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
from heliograph.filters.gaussian.signal_moments import factor_spread
from heliograph.filters.modes.channel_by_mode import ChannelByMode, channels_by_mode
from heliograph.filters.modes.jump_linear_filter import (
    AbstractModalFilter,
    MeasurementModel,
    claim_of_modes,
    concatenate_modes,
    condition_modes_on_received,
    covariance_of_mode,
    kron,
    predict_by_mode,
)
from heliograph.filters.modes.linear_by_mode import centred_measurement, centred_transition, pad_with_zeros
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

    It is the `ModalFilter` of all links' joint modes, of which a sum needs but one function for each mode of a link
    beside the first. The innovation covariance is exact; the innovation is not Gaussian, so its likelihood is nominal.

    Source: Costa, Linear minimum mean square error estimation for discrete-time Markovian jump linear systems (1994),
    of functions of the modes.
    """

    terms: Terms
    initial: tuple[Array, ...]

    @compile_on_call
    def init(self) -> AdditiveBelief:
        """Return the prior, independent of the modes: Cov(zeta) = Gamma x E[x~ x~'], less E[x~] E[x~]' of x~ itself."""
        start = at(self.plant, k=0)
        spread = pad_with_zeros(jnp.asarray(start.initial_covariance))
        laws = tuple(jnp.asarray(law) for law in self.initial)
        second = spread.at[-1, -1].set(1.0)
        parts = [spread, *(jnp.kron(_indicator_covariance(law), second) for law in laws if len(law) > 1)]
        centre = jnp.asarray(start.initial_mean)
        mean = self._embed_first_block(jnp.append(centre, 1.0))
        return AdditiveBelief(
            gaussian=from_covariance(mean, block_diag(*parts)),
            second=second,
            laws=laws,
            centre=centre,
            moved=jnp.asarray(False),
        )

    @predicts
    def predict(self, state: AdditiveBelief, u: ArrayLike = (), k: Step = 0) -> AdditiveBelief:
        """Move x~ by the plant and each mode by its chain; at the first prediction the modes have their initial law.

        x~ = (x - centre, 1); zeta: x~ times 1 and times each indicator of a mode, less its probability;
        `second_moment`: E[x~ x~'] before data.
        """
        matrix, noise, centre = centred_transition(at(self.plant, k), u, state.centre)
        transitions = self._transition_matrices(state, k)
        # F zeta about the moving centre.
        deviation = state.gaussian.mean - self._mean_from_centre(state.centre)
        predicted_deviation = predict_by_mode(deviation[:, None], matrix, _function_transition(transitions).T)[:, 0]
        mean = predicted_deviation + self._mean_from_centre(centre)
        root, noise_of_zeta = self._transition_factors(state, u, k)
        after = from_columns(mean, join_columns(WeightedColumns(root, state.gaussian.variances), noise_of_zeta))
        second_moment = matrix @ state.second @ matrix.T + noise
        return AdditiveBelief(
            gaussian=after,
            second=second_moment,
            laws=_next_laws(state.laws, transitions),
            centre=centre,
            moved=jnp.asarray(True),
        )

    @corrects
    def correct(self, state: AdditiveBelief, z: ArrayLike, k: Step = 0) -> tuple[AdditiveBelief, Innovation]:
        """Correct with the components of z that arrived.

        The estimate is that of zeta, the products of x~ = (x - centre, 1) and functions of the modes. Given zeta,
        Cov z = T(C~ E[x~ x~'] C~' + R~) + sum_ab Gamma_ab D_a R D_b' + Cov n. T is the mean spread of the gains given
        the modes, D_a is the gain by function a (D_0 = Hbar), and Gamma holds the functions' second moments.
        """
        output, x = self._measurement_model(state, k), state.gaussian
        deviation = x.mean - self._mean_from_centre(state.centre)
        after, innovation = condition_modes_on_received(x, deviation, output, z)
        return state._replace(gaussian=after), innovation

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return the smoother step of zeta+ = F zeta + noise, zeta the products of x~ and functions of the modes.

        x~ = (x - centre, 1). `slopes` is F L, with L the factor of Cov zeta. The projection maps zeta to the plant's
        state x.
        """
        slopes, noise = self._transition_factors(step.before, step.u, step.k)
        slopes_and_noise = slopes, triangularise(noise)
        return smoother_step_of(step, slopes_and_noise, self.claim, projection=self._projection_to_state())

    def _projection_to_state(self) -> Float[np.ndarray, "n N"]:
        """Return the matrix (n, N) that maps zeta to x."""
        return np.eye(len(self.states), (len(self.states) + 1) * self._function_count)

    @property
    def _function_count(self) -> int:
        """Number of functions of the modes, 1 + sum_i (m_i - 1)."""
        return 1 + sum(len(law) - 1 for law in self.initial)

    def _embed_first_block(self, first: jax.Array) -> jax.Array:
        """Embed a vector as the first block of zeta, with zeros for the blocks of the other functions."""
        return jnp.pad(first, (0, (self._function_count - 1) * len(first)))

    def _mean_from_centre(self, centre: jax.Array) -> jax.Array:
        """Return the part of E zeta that the centre c makes: (c, 0) in the first block."""
        return self._embed_first_block(jnp.append(centre, 0.0))

    def _transition_matrices(self, state: AdditiveBelief, k: Step) -> Laws:
        """Return the transition matrix of each term's chain; the identity before the first prediction."""
        chains = [jnp.asarray(term.transition) for term in at(self.terms, k)]
        return tuple(jnp.where(state.moved, chain, jnp.eye(len(chain))) for chain in chains)

    def _transition_factors(self, state: AdditiveBelief, u: ArrayLike, k: Step) -> tuple[jax.Array, WeightedColumns]:
        """Return F L of zeta = E zeta + L xi, and columns of Cov(zeta+ - F zeta).

        They are those of C x A~ E[x~ x~'] A~' + Gamma+ x Q~, with C = sum_i P(i) Cov(1{next} | i) of each chain.
        """
        move, rows = centred_transition(at(self.plant, k), u, state.centre)[0], self._transition_matrices(state, k)
        # C of each chain, and of all of them as columns.
        jump_covariances = [
            jnp.einsum("i,ijl->jl", law, covariance_of_mode(chain)[:, 1:, 1:])
            for law, chain in zip(state.laws, rows, strict=True)
        ]
        jumps = _block_diagonal_columns(np.zeros((1, 0)), jump_covariances)
        carried = factor_spread(move @ state.second @ move.T)
        by_jumps = WeightedColumns(
            kron(jumps.matrix, carried.matrix), outer(jumps.weights, carried.weights).reshape(-1)
        )
        next_gamma = _second_moment_of_functions(_next_laws(state.laws, rows))
        noise = join_columns(by_jumps, self.process_noise_by_mode(u, k, next_gamma))
        return predict_by_mode(state.gaussian.root, move, _function_transition(rows).T), noise

    def _measurement_model(self, state: AdditiveBelief, k: Step) -> MeasurementModel:
        """Return z = common + H zeta + v: H and `common` from Hbar and the D_a, and columns whose squares sum to Cov v.

        Hbar is the mean of the gains (G, n), D_a what function phi_a of a link's mode adds to it, Gamma = E[phi phi']
        of the functions (1, phi_1, ...), and y~ = (y, 1) what is sent. Letters of the subscripts: a, b functions, c
        columns of Gamma, m and l received numbers, p entries of y~, j modes of a link.
        """
        terms: tuple[ChannelByMode, ...] = at(self.terms, k)
        sensor = at(self.sensor, k)
        # H: the gain of each function, times C~ of the centred state.
        measure, noise = centred_measurement(sensor, state.centre)
        gains = _gains_by_function(terms, state.laws)
        matrix = gains @ measure
        common = matrix[0, :, -1]
        # E[y~ y~'] of what is sent (p + 1, p + 1), and Gamma.
        sent, gamma = measure @ state.second @ measure.T + noise, _second_moment_of_functions(state.laws)
        # Sensor noise through the gains, sum_ab Gamma_ab D_a R D_b': one gain for each column c of Gamma (c, m, p + 1).
        mean_gain_by_function = jnp.einsum("ac,amp->cmp", gamma.matrix, gains)
        sensor_columns = jnp.asarray(mean_gain_by_function[:, :, :-1] @ sensor.noise.columns.matrix)
        weights = jnp.broadcast_to(sensor.noise.columns.weights, (len(sensor_columns), sensor_columns.shape[-1]))
        known_noise = [side_by_side(WeightedColumns(sensor_columns, weights), gamma.weights)]
        # Noise of the links themselves, in the mean over the modes j of each.
        known_noise += [side_by_side(term.noise, law) for term, law in zip(terms, state.laws, strict=True)]
        # Spread of the gains given the mode, on what is sent, in the mean over the modes (m, m).
        gain_noise = sum(
            jnp.einsum("j,jmlab,ab->ml", law, jnp.asarray(term.gain_spread), sent)
            for term, law in zip(terms, state.laws, strict=True)
        )
        # Rounding of z, by its second moments (m,).
        rounding = rounding_of(
            jnp.einsum("c,cmp,pq,cmq->m", gamma.weights, mean_gain_by_function, sent, mean_gain_by_function)
        )
        noise_columns = join_columns(*known_noise, rounding, factor_spread(jnp.asarray(gain_noise)))
        return MeasurementModel(concatenate_modes(matrix.at[0, :, -1].set(0.0)), common, noise_columns)


def _gains_by_function(terms: Sequence[ChannelByMode], laws: Laws) -> jax.Array:
    """Return Hbar and all D_a, stacked: (1 + functions, m, p + 1).

    z is the sum of the terms' H y. Hbar is the mean of H over all modes. D_a belongs to a mode that is not the first of
    its term: it is the mean gain in this mode less that in the term's first mode.
    """
    means = [jnp.asarray(term.mean) for term in terms]
    total_mean = sum(jnp.einsum("j,jmp->mp", law, mean) for law, mean in zip(laws, means, strict=True))
    return jnp.concatenate([jnp.asarray(total_mean)[None], *(mean[1:] - mean[:1] for mean in means)])


def _next_laws(laws: Laws, rows: Laws) -> Laws:
    """Return the probabilities of each term's modes one step later."""
    return tuple(law @ chain for law, chain in zip(laws, rows, strict=True))


def _function_transition(transitions: Laws) -> jax.Array:
    """Return T of E[phi+ | phi] = T phi: block-diagonal of 1 and, chain by chain, Pi_ij - Pi_first,j.

    phi holds 1, and for each chain the indicators of all its modes but the first, less their probabilities. Pi is a
    chain's transition matrix.
    """
    blocks = [(pi[1:, 1:] - pi[:1, 1:]).T for pi in transitions if len(pi) > 1]
    matrix: jax.Array = block_diag(np.eye(1), *blocks)
    return matrix


def _indicator_covariance(law: jax.Array) -> jax.Array:
    """Return the covariance of the indicators of all modes but the first, diag(p) - p p'."""
    return jnp.diag(law[1:]) - jnp.outer(law[1:], law[1:])


def _second_moment_of_functions(laws: Laws) -> WeightedColumns:
    """Return Gamma = E[phi phi'] of (1, phi_1, ...) as columns."""
    return _block_diagonal_columns(np.eye(1), [_indicator_covariance(law) for law in laws])


def _block_diagonal_columns(first_factor: np.ndarray, covariances: Sequence[jax.Array]) -> WeightedColumns:
    """Return the columns of blkdiag(one one', C_1, C_2, ...) for covariances C_i.

    `first_factor` (1, columns) is the factor `one` of the first block. An empty C_i adds nothing.
    """
    factors = [factor_spread(covariance) for covariance in covariances if len(covariance)]
    weights = jnp.concatenate([jnp.ones(first_factor.shape[1]), *(factor.weights for factor in factors)])
    rows = sum(len(factor.matrix) for factor in factors)
    blocks: jax.Array = block_diag(*(factor.matrix for factor in factors)).reshape(rows, -1)
    # The first factor is one row. There are zeros to the right of it, and to the left of the other blocks.
    top = jnp.concatenate([jnp.asarray(first_factor), np.zeros((1, blocks.shape[1]))], axis=1)
    below = jnp.pad(blocks, ((0, 0), (first_factor.shape[1], 0)))
    return WeightedColumns(jnp.concatenate([top, below]), weights)


def additive_modal_filter(plant: AnyPlant, sensor: AnySensor, terms: Sequence[Channel]) -> AdditiveModalFilter:
    """Return the best linear filter behind a sum of links (`terms`) that share no memory; each term has all outputs."""
    laws, models = zip(*(channels_by_mode(term) for term in terms), strict=True)
    claim: Claim = "exact" if all(claim_of_modes(term) == "exact" for term in terms) else "nominal"
    sizes = make_sizes(claim, first(plant), first(terms[0]).outputs)
    return AdditiveModalFilter(plant=plant, sensor=sensor, terms=models, initial=laws, **sizes)


def independent_terms(channel: Channel) -> list[Channel]:
    """Return the terms of a sum of links that share no memory, or the channel itself if it cannot be split."""
    terms_by_step = [split_terms_without_common_memory(step) for step in unstack(channel)]
    # Steps that split differently have no terms in common.
    if len({len(terms) for terms in terms_by_step}) > 1 or len(terms_by_step[0]) == 1:
        return [channel]
    return [vary_over_steps(term_at_each_step, channel) for term_at_each_step in zip(*terms_by_step, strict=True)]
