"""Filters with side information on the modes: which packets arrived, a flag with each packet, or the mode itself."""

from collections.abc import Callable
from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.factors.covariance_factors import (
    WeightedColumns,
    join_columns,
    rounding_of,
    side_by_side,
    triangularise,
)
from heliograph.factors.factored_gaussian import Innovations, from_covariance
from heliograph.factors.pivots import reciprocal_or_zero, square_root, unit_of
from heliograph.filters.base import AbstractSizedFilter, Step, corrects, estimates, make_sizes, predicts
from heliograph.filters.gaussian.gaussian_prediction import second_moments_at_start
from heliograph.filters.gaussian.signal_moments import bound_signal_power_at_start, factor_covariance
from heliograph.filters.modes.arrival_patterns import ChannelByPattern, append_flag, describe_by_pattern, pattern_of
from heliograph.filters.modes.gram_schmidt import orthogonalise_first_rows, spoil_where_known
from heliograph.filters.modes.jump_linear_filter import concatenate_modes, make_mode_sum_matrix, subtract_mean_output
from heliograph.filters.modes.linear_by_mode import (
    centred_measurement,
    centred_transition,
    kron,
    multiply_by_transition,
    noise_in_mode,
)
from heliograph.filters.modes.side_information_state import (
    SideInformationBelief,
    make_belief,
    mode_probabilities,
    split_columns,
)
from heliograph.model.assumed.assumed_model import AssumedModel, with_assumed
from heliograph.model.channel import Channel, check_link
from heliograph.model.estimate import Estimate, Innovation, lower_claim_by_noise
from heliograph.model.fading import uncertain_chain, with_flag
from heliograph.model.over_time import OverTime, at, at_each_step, first, unstack, vary_over_steps
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor, LinearSensor, check_linear
from heliograph.numerics.caching import cache_by_object
from heliograph.numerics.check import array, probabilities
from heliograph.numerics.linalg import outer
from heliograph.numerics.types import Array, ArrayLike, Float
from heliograph.random_affine.memories_of_channels import memories
from heliograph.random_affine.modes import joint_modes


class SideInformationFilter(AbstractSizedFilter):
    """A linear filter that weights the modes by side information with each packet, and conditions its covariance on it.

    A flag (and whether a packet arrived) changes the law of the modes, and with it the accuracy of the estimate so far:
    s = E[zeta r'] E[r r']^+ r is recomputed from moments given the flags, with r = (1, s, z). Its covariance is exact
    given the side information; a filter of all past data could do a little better, since earlier gains were optimal
    under earlier laws.

    Its measurement is z and, where there are `flags`, the number of the flag after it; the likelihood is that of z
    given these. Losses that the channel does not model must not depend on the modes. Moments are those of x - E[x],
    and the error is a coordinate of its own: neither a mean far from zero nor a precise measurement costs digits.

    Source: the filter of Costa (1994) with moments conditional on the side information.
    """

    plant: AnyPlant
    sensor: AnySensor
    channel: ChannelByPattern | OverTime
    initial: Float[Array, " M"]
    flagged: bool = eqx.field(static=True)

    @compile_on_call
    def init(self) -> SideInformationBelief:
        """Return the prior, in which x~ = (x - c, 1) and the mode, of law p, are independent.

        The state holds E[q q' 1{mode = j}] for each mode j, q = (e, x~), where e = zeta - E zeta is the error of the
        products zeta = (x~ 1{mode = 1}, ...). In mode j zeta is u_j (x) x~ with the unit vector u_j (Kronecker's
        product), and E zeta = p (x) (0, 1).
        """
        start, law = at(self.plant, k=0), jnp.asarray(self.initial)
        prior = from_covariance(start.initial_mean, start.initial_covariance)
        mean_x = np.eye(len(self.states) + 1)[:, -1:]  # E x~ = (0, 1)
        # x~ and E x~ over common columns, those of Cov x and one for E x~, so that E[q q' 1{j}] is P(j) times a sum.
        x = jnp.concatenate([jnp.pad(prior.root, ((0, 1), (0, 0))), mean_x], axis=1)
        expected_x = jnp.zeros_like(x).at[:, -1:].set(mean_x)
        weights = outer(law, jnp.append(prior.variances, 1.0))
        errors = [kron(u_j[:, None], x) - kron(law[:, None], expected_x) for u_j in jnp.eye(len(law))]
        moments = WeightedColumns(jnp.stack([jnp.concatenate([e, x]) for e in errors]), weights)
        factors, mean = jax.vmap(triangularise)(moments), jnp.kron(law, mean_x[:, 0])
        return make_belief(mean, factors, centre=jnp.asarray(start.initial_mean), moved=jnp.asarray(False))

    def trace_log_likelihood(self, plain: Callable[..., jax.Array], z: Array, u: Array) -> jax.Array:
        """Return the log-likelihood of rows inside a trace, plain(self, z, u), which JAX differentiates.

        Of one mode, one state and one number, no combination of rows can be known to rounding: the filter's own steps
        have right derivatives, also where variances are zero. Else those are NaN where they cannot be had.
        """
        is_scalar = len(self.initial) == len(self.states) == self.received == 1
        return plain(self, z, u) if is_scalar else super().trace_log_likelihood(plain, z, u)

    @predicts
    def predict(self, state: SideInformationBelief, u: ArrayLike = (), k: Step = 0) -> SideInformationBelief:
        """Predict s+ = F s, and the moments of q = (e, x~) in each mode.

        x~ = (x - c, 1) is the plant's state about c = E[x] before any data, with a 1. zeta stacks x~ 1{mode = j} over
        the modes j of the link, s is its estimate, and e = zeta - s the error. F has the blocks F_ji = Pi_ij A~, with
        A~ the plant's matrix for x~. Where the mode goes from i to j, x~+ = A~ x~ + w~, zeta+ = u_j (x) x~+ and
        F zeta = Pi_i (x) A~ x~, so that

            e+ = F e + (u_j - Pi_i) (x) A~ x~ + u_j (x) w~

        with the unit vector u_j, row Pi_i of the transition matrix, and Kronecker's product (x).
        """
        plant, channel = at(self.plant, k), at(self.channel, k)
        A, _, next_centre = centred_transition(plant, u, state.centre)  # A~
        # E[q q' 1{mode = i}] = sum over columns of weight * column column'; a column has the parts of e and of x~.
        modes, (errors, x, weights) = len(self.initial), split_columns(state)
        transition = jnp.where(state.moved, jnp.asarray(channel.transition), jnp.eye(modes))  # Pi
        law = mode_probabilities(x, weights) @ transition  # P(next mode = j), (modes,)
        # Columns of F e and A~ x~ in each mode before the step, and of w~.
        moved_errors = jax.vmap(lambda e: multiply_by_transition(e, A, transition))(errors)
        moved_x = jax.vmap(lambda x: A @ x)(x)
        noise = noise_in_mode(plant, u, second_moments_at_start(self.plant))

        def move_columns(u_j_less_row: jax.Array, moved_error: jax.Array, moved_x: jax.Array) -> jax.Array:
            """Return the columns of (e+, x~+) after one transition i -> j, without noise; the first is u_j - Pi_i."""
            return jnp.concatenate([moved_error + kron(u_j_less_row[:, None], moved_x), moved_x])

        def collect_moments(u_j: jax.Array, column: jax.Array, probability: jax.Array) -> WeightedColumns:
            """Return columns of E[q+ q+' 1{next mode = j}], the sum over i of Pi_ij E[q+ q+' 1{mode = i}].

            `u_j`: unit vector of mode j; `column`: Pi_ij for all i; `probability`: P(next mode = j).
            """
            moved = WeightedColumns(jax.vmap(move_columns)(u_j - transition, moved_errors, moved_x), weights)
            process = WeightedColumns(kron(jnp.append(u_j, 1.0)[:, None], noise.matrix), probability * noise.weights)
            return triangularise(join_columns(side_by_side(moved, column), process))

        moments = jax.vmap(collect_moments)(jnp.eye(modes), transition.T, law)
        mean = multiply_by_transition(state.mean[:, None], A, transition)[:, 0]
        return make_belief(mean, moments, next_centre, jnp.asarray(True))

    @corrects
    def correct(
        self, state: SideInformationBelief, z: ArrayLike, k: Step = 0
    ) -> tuple[SideInformationBelief, Innovation]:
        """Weight the modes by the flag and by which components arrived, then project zeta on (1, s, z).

        A mode of the link decides its losses and noise; a flag, or which components arrived, tells of the mode (side
        information). zeta holds the products of (x - c, 1) and the modes' indicators, and s is its linear estimate
        before. z: what the channel delivers (m,), NaN for what did not arrive, and then the flag's number if `flagged`.
        """
        sensor, channel, observed = at(self.sensor, k), at(self.channel, k), jnp.asarray(z)
        z, flag = (observed[:-1], observed[-1]) if self.flagged else (observed, jnp.asarray(0.0))
        # P(flag, pattern | mode).
        flag_arrived, arrived = ~jnp.isnan(flag), ~jnp.isnan(z)
        number = jnp.clip(jnp.where(flag_arrived, flag, 0.0).astype(int), 0, channel.flags.shape[1] - 1)
        flag_chance = jnp.where(flag_arrived, jnp.asarray(channel.flags)[:, number], 1.0)
        pattern = pattern_of(channel, arrived)
        weight = jnp.asarray(channel.chance)[:, pattern] * flag_chance
        # Moments given the side information: moments of mode j times weight_j = P(j | side information) / P(j).
        # `excess`, the weights times weight_j - 1, is what this adds.
        _, x, weights = split_columns(state)
        weight = weight / (weight @ mode_probabilities(x, weights))
        prior = state._replace(variances=jnp.asarray(weight)[:, None] * state.variances)
        excess = jnp.asarray(weight - 1)[:, None] * state.variances
        links = jax.tree.map(
            lambda part: jnp.asarray(part)[:, pattern], (channel.mean, channel.gain_covariance, channel.noise)
        )
        power = second_moments_at_start(self.plant)
        size = bound_signal_power_at_start(sensor, power)
        received = _make_measurement_model(prior, sensor, size, *links)
        prior = prior._replace(variances=spoil_where_known(prior.variances, power, (x, weights), received.noise))
        # The projection, then the innovation as it is reported: NaN for what did not arrive.
        corrected, innovations, innovation = _project_on_data(prior, excess, received, z)
        likelihood = innovations.log_density(arrived, jnp.abs(z) + jnp.abs(innovation.mean))
        value = jnp.where(arrived, innovation.mean, jnp.nan)
        covariance = jnp.where(arrived[:, None] & arrived, innovation.covariance, jnp.nan)
        if self.flagged:
            flag_innovation, covariance = append_flag(covariance, flag)
            value = jnp.append(value, flag_innovation)
        return corrected, Innovation(value, covariance, likelihood)

    @estimates
    def estimate(self, state: SideInformationBelief) -> Estimate:
        """Return the estimate of x = c + sum_j (x - c) 1{mode = j}, and its error's covariance.

        The filter estimates the products (x - c, 1) 1{mode = j}, for c = E[x] before any data.
        """
        projection = make_mode_sum_matrix(len(self.states), len(self.initial))
        covariance = state.errors.through(projection).covariance
        return Estimate(state.centre + projection @ state.mean, covariance, self.claim)


class StackedMeasurementModel(NamedTuple):
    """Model of what arrives: z = common + output zeta + noise, with columns of E[noise noise' 1{mode}] in each mode.

    zeta holds the products of (x - c, 1) and the modes' indicators. Shapes: output (m, N), common (m,), noise columns
    (M, m, m).
    """

    output: jax.Array
    common: jax.Array
    noise: WeightedColumns


class PredictedInnovation(NamedTuple):
    """Innovation of z (m,), z less its projection on 1 and the estimate s, and its covariance (m, m)."""

    mean: jax.Array
    covariance: jax.Array


def _make_measurement_model(
    state: SideInformationBelief,
    sensor: LinearSensor,
    size: jax.Array,
    gains: jax.Array,
    gain_covariance: jax.Array,
    link: WeightedColumns,
) -> StackedMeasurementModel:
    """Return what is received of zeta = x~ 1{mode}: the output matrix, the mean output, and the noise in each mode.

    x~ = (x - c, 1) is the plant's state about its mean c before any data, with a 1, and zeta stacks x~ 1{mode = j} over
    the modes j of the link. In mode j, z = H y~ + n with y~ = (y, 1) = C~ x~ + v~; H is random with mean Hbar_j. The
    noise has the covariance T_j(E[y~ y~' 1{j}]) + P(j) (Hbar_j R~ Hbar_j' + Cov n_j), with
    T_j(Y) = E[(H - Hbar_j) Y (H - Hbar_j)' | j], and the rounding of z.

    Args:
        state: estimate of zeta and moments of each mode.
        sensor: the linear sensor, which gives C~ and R~ = Cov v~.
        size: squares of the numbers that are summed in y, for rounding (p,).
        gains: Hbar_j (M, m, p + 1).
        gain_covariance: the tensor of T_j (M, m, m, p + 1, p + 1).
        link: columns of Cov n_j (M, m, m).
    """
    measure, noise = centred_measurement(sensor, state.centre)  # C~ and R~
    _, x, weights = split_columns(state)
    law = mode_probabilities(x, weights)

    def describe_noise(
        gain: jax.Array, covariance: jax.Array, link: WeightedColumns, x: WeightedColumns, p: jax.Array
    ) -> WeightedColumns:
        """Return the noise of z = G y + n in one mode of probability p: sensor, link, rounding and random gain.

        `gain` and `covariance` are mean and covariance of (G, n), and `link` holds columns of Cov n. `x` holds columns
        of E[x~ x~' 1{mode}], x~ = (x, 1). (y, 1) = measure x~ + noise. `size` is E[x_i^2] at the start, for rounding.
        """
        signal_moments = x.through(measure).covariance + p * noise  # E[y~ y~' 1{mode}]
        known_noise = join_columns(sensor.noise.columns.through(gain[:, :-1]), link).times(p)
        rounding = rounding_of((jnp.abs(gain[:, :-1]) @ square_root(size)) ** 2).times(p)
        gain_noise = factor_covariance(jnp.einsum("mlab,ab->ml", covariance, signal_moments))
        return triangularise(join_columns(known_noise, rounding, gain_noise))

    # Output matrix of zeta less the mean output; modes of probability zero have none.
    output, common = subtract_mean_output(gains @ measure, law)
    output = concatenate_modes(jnp.where(law[:, None, None] > 0, output, 0.0))
    noises = jax.vmap(describe_noise)(gains, gain_covariance, link, WeightedColumns(x, weights), law)
    return StackedMeasurementModel(output=output, common=common, noise=noises)


def _project_on_data(
    state: SideInformationBelief, excess: jax.Array, received: StackedMeasurementModel, z: jax.Array
) -> tuple[SideInformationBelief, Innovations, PredictedInnovation]:
    """Project zeta on (1, s, z): subtract from the error e = zeta - s its projection, and add it to the estimate s.

    A random number a is a row over the columns of all modes side by side, so that E[a b] = a W b' with the diagonal
    matrix W of the columns' weights. Before the side information E[e (1, s)] was 0, as s is a projection. The side
    information changes W by `excess`, so that now E[e (1, s)] = e diag(excess) (1, s)'.

    Args:
        state: s, and moments of e and x~ = (x - c, 1) in each mode, given the side information.
        excess: change of the weights by the side information (M, q).
        received: z = common + output zeta + noise.
        z: measurement (m,), NaN for what did not arrive.

    Returns:
        The state after; the innovations of z, each given the components before it; z - E[z | 1, s] and its covariance.
    """
    errors, x, weights = split_columns(state)
    m, count, modes, arrived = len(z), len(state.mean), len(weights), ~jnp.isnan(z)
    # For each mode the columns of e, x~ and the noise of z: first those of the state, then those of the noise.
    errors, x = (jnp.pad(part, ((0, 0), (0, 0), (0, m))) for part in (errors, x))
    noise = jnp.pad(jnp.asarray(received.noise.matrix), ((0, 0), (0, 0), (weights.shape[1], 0)))
    weights = jnp.concatenate([weights, received.noise.weights], axis=1).reshape(-1)
    excess = jnp.pad(excess, ((0, 0), (0, m))).reshape(-1)
    # Rows over the columns of all modes: the basis (1, s) with s = zeta - e, then z - common - output s and e.
    zeta = jax.vmap(lambda j, x: kron(j[:, None], x))(jnp.eye(modes), x)
    innovation_rows = jnp.where(arrived[:, None], jax.vmap(lambda e: received.output @ e)(errors) + noise, 0.0)
    basis, rows = _join_modes(x[:, -1:], zeta - errors), _join_modes(innovation_rows, errors)
    values = jnp.where(arrived, z - received.common - received.output @ state.mean, 0.0)
    # First e and z less their projections on 1 and s, made orthogonal. A direction of s whose variance is rounding (eps
    # of the second moments of x~, and of s itself) is not used.
    size = jnp.tile(jnp.square(_join_modes(x)) @ weights, modes) + jnp.square(basis[1:]) @ weights
    smallest = jnp.append(0.0, np.sqrt(unit_of(weights)) * size)
    basis, basis_values, variances = orthogonalise_first_rows(basis, jnp.append(1.0, state.mean), weights, 1 + count)
    inverses = reciprocal_or_zero(jnp.where(variances > smallest, variances, 0.0))
    gains = (rows @ (excess * basis).T) * inverses
    rows, values = rows - gains @ basis, jnp.append(values, -state.mean) - gains @ basis_values
    expected = PredictedInnovation(values[:m], WeightedColumns(rows[:m], weights).covariance)
    # Then e less its projection on z.
    rows, values, variances = orthogonalise_first_rows(rows, values, weights, m)
    innovations = Innovations(values[:m], variances, jnp.diagonal(expected.covariance))
    # Triangular factors of the moments of (e, x~) in each mode.
    remaining = jnp.moveaxis(rows[m:].reshape(count, modes, -1), 1, 0)
    moments = jax.vmap(triangularise)(
        WeightedColumns(jnp.concatenate([remaining, x], axis=1), weights.reshape(modes, -1))
    )
    return make_belief(-values[m:], moments, state.centre, state.moved), innovations, expected


def _join_modes(*parts: jax.Array) -> jax.Array:
    """Return one matrix (rows of all parts, M columns) from parts (M, rows, columns).

    A row of it is one random number over the columns of all modes side by side.
    """
    rows = jnp.moveaxis(jnp.concatenate(parts, axis=1), 0, 1)
    return rows.reshape(len(rows), -1)


def side_information_filter(
    plant: AnyPlant, sensor: AnySensor, channel: Channel, flags: Float[ArrayLike, "modes flags"] | None = None
) -> SideInformationFilter:
    """Return the linear filter with side information on the modes: which packets arrived, and a flag with each.

    A channel's mode, such as good or bad, follows a Markov chain, and decides gain, noise and losses. The flag is a
    number that comes with z and whose probabilities depend on the mode, such as a signal strength in classes.

    Args:
        plant: a linear plant, n states.
        sensor: a linear sensor, m outputs.
        channel: from the sensor to the filter; it may lose data with probabilities that depend on the mode (`erasure`
            in its modes).
        flags: P(flag | mode), shape (modes, flags), the modes as in `joint_modes`; the measurement is then (z, flag),
            as `with_flag` delivers it. Flags that identify the mode make it the Kalman filter given the modes. None by
            default: no flags.

    Claim: "exact"; "upper" where noise is known by bounds, "nominal" where probabilities are uncertain.

    Raises:
        ValueError: a plant or sensor that is not linear, parts that do not fit, flags that are no probabilities.

    Source: the filter of Costa (1994) with moments conditional on the side information.
    """
    # Initial law of the modes, the channel by mode and pattern of arrivals at each step, and if all laws are known.
    check_linear("side-information filter", plant, sensor)
    check_link(first(sensor), first(channel), len(first(plant).states))
    initial, steps, is_known = _describe_channel_by_mode(channel)
    # P(flag | mode); one flag that is always the same where there are none.
    if flags is not None:
        chances = array("flags", flags, (len(initial), None))
        for i, row in enumerate(chances):
            probabilities(f"flags in mode {i}", row)
        steps = [replace(step, flags=chances) for step in steps]
    claim = lower_claim_by_noise("exact" if is_known else "nominal", plant, sensor, channel)
    filter = SideInformationFilter(
        plant=plant,
        sensor=sensor,
        channel=vary_over_steps(steps, channel),
        initial=initial,
        flagged=flags is not None,
        **make_sizes(claim, first(plant), first(channel).outputs + (flags is not None)),
    )
    # The filter's measurements are those of `with_flag`. But no channel delivers flags of the joint mode of several
    # chains, so that for these the filter cannot say under which models its claim holds.
    if flags is not None and len(memories(channel)) != 1:
        return filter
    received = channel if flags is None else at_each_step(lambda link: with_flag(link, chances), channel)
    return with_assumed(filter, AssumedModel(plant, sensor, received))


@cache_by_object
def _describe_channel_by_mode(channel: Channel) -> tuple[Float[Array, " M"], list[ChannelByPattern], bool]:
    """Return the modes' initial probabilities, the channel at each step, and whether all probabilities are known.

    The channel is given by mode and by pattern of components that arrive.
    """
    steps = [joint_modes(step) for step in unstack(channel)]
    # A law with uncertain probabilities has several extreme ones, the vertices of the set of possible laws.
    is_known = all(affine.corner_count() == 1 for step in steps for affine in step.maps)
    same_flag_in_all_modes = np.ones((len(steps[0].initial), 1))
    by_pattern = describe_by_pattern(steps, same_flag_in_all_modes)
    return steps[0].initial, by_pattern, is_known and not uncertain_chain(channel)
