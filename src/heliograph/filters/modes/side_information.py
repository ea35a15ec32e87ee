"""Filters with side information on the modes: which packets arrived, a flag with each packet, or the mode itself."""

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.engine.choice import compile_on_call
from heliograph.factors.covariance_factors import (
    WeightedColumns,
    below_diagonal,
    join_columns,
    rounding_of,
    side_by_side,
    triangularise,
    unit_lower,
)
from heliograph.factors.factored_gaussian import Innovations, from_covariance
from heliograph.factors.pivots import reciprocal_or_zero, square_root, unit_of
from heliograph.filters.base import AbstractSizedFilter, Step, corrects, estimates, make_sizes, predicts
from heliograph.filters.gaussian.gaussian_prediction import second_moments_at_start
from heliograph.filters.gaussian.signal_moments import bound_signal_power_at_start, factor_spread
from heliograph.filters.modes.arrival_patterns import ChannelByPattern, append_flag, describe_by_pattern, pattern_of
from heliograph.filters.modes.gram_schmidt import orthogonalise_first_rows, spoil_where_known
from heliograph.filters.modes.jump_linear_filter import (
    concatenate_modes,
    kron,
    make_mode_sum_matrix,
    predict_by_mode,
    subtract_mean_output,
)
from heliograph.filters.modes.linear_by_mode import centred_measurement, centred_transition, noise_in_mode
from heliograph.model.channel import Channel, check_link
from heliograph.model.estimate import Estimate, Innovation, lower_claim_by_noise
from heliograph.model.fading import uncertain_chain, with_flag
from heliograph.model.over_time import OverTime, at, at_each_step, first, unstack, vary_over_steps
from heliograph.model.plant import AnyPlant
from heliograph.model.premises.premise import Premise, with_premise
from heliograph.model.sensor import AnySensor, LinearSensor, check_linear
from heliograph.numerics.caching import cache_by_object
from heliograph.numerics.check import array, probabilities
from heliograph.numerics.linalg import outer
from heliograph.numerics.types import Array, ArrayLike, Bool, Float
from heliograph.random_affine.memories_of_channels import memories
from heliograph.random_affine.modes import joint_modes


class SideInformationBelief(NamedTuple):
    """s, the estimate of zeta, and factors of E[q q' 1{mode} | side information] of q = (e, x~), of each mode.

    x~ = (x - c, 1) with c = E[x] before any data, zeta holds x~ 1{mode}, mode after mode, and e = zeta - s is the
    error: in a mode, s follows from e and x~.

    Shapes: with N = M (n + 1) and q = N + n + 1: mean (N,), lower (M, q (q - 1) / 2), variances (M, q), centre c (n,).
    """

    mean: Float[jax.Array, " N"]
    lower: Float[jax.Array, "M entries"]
    variances: Float[jax.Array, "M q"]
    centre: Float[jax.Array, " n"]
    moved: Bool[jax.Array, ""]

    @property
    def moments(self) -> WeightedColumns:
        """E[q q' 1{mode}] of each mode as columns (M, q, q)."""
        return WeightedColumns(unit_lower(self.lower), self.variances)

    @property
    def errors(self) -> WeightedColumns:
        """E[e e' | side information] as columns (N, M q): e the error of the estimate, q columns of each of M modes."""
        of_errors = WeightedColumns(self.moments.matrix[:, : len(self.mean)], self.moments.weights)
        return side_by_side(of_errors, np.ones(len(self.lower)))

    @property
    def covariance(self) -> Float[jax.Array, "N N"]:
        """Second moment E[e e' | side information] of the error."""
        return self.errors.covariance


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
        """Return the prior, in which state and mode are independent; x~ = (x - c, 1), and p is the law of the modes."""
        start, law = at(self.plant, k=0), jnp.asarray(self.initial)
        prior = from_covariance(start.initial_mean, start.initial_covariance)
        unit = np.eye(len(self.states) + 1)[:, -1:]
        # Columns of q = (e, x~) in each mode j. e is the error of (x~ 1{mode 1}, ...): e = 1_j (x) x~ - p (x) (0, 1).
        x = jnp.concatenate([jnp.pad(prior.root, ((0, 1), (0, 0))), unit], axis=1)
        constant = jnp.zeros_like(x).at[:, -1:].set(unit)
        errors = [kron(indicator[:, None], x) - kron(law[:, None], constant) for indicator in jnp.eye(len(law))]
        weights = outer(law, jnp.append(prior.variances, 1.0))
        moments = WeightedColumns(jnp.stack([jnp.concatenate([e, x]) for e in errors]), weights)
        factors, mean = jax.vmap(triangularise)(moments), jnp.kron(law, unit[:, 0])
        return _make_belief(mean, factors, centre=jnp.asarray(start.initial_mean), moved=jnp.asarray(False))

    @predicts
    def predict(self, state: SideInformationBelief, u: ArrayLike = (), k: Step = 0) -> SideInformationBelief:
        """Predict s+ = F s, and the moments of q = (e, x~) in each mode.

        s estimates zeta = x~ 1{mode}, mode after mode, e = zeta - s, x~ = (x - c, 1). Where the mode goes from i to j,
        e+ = F e + (1_j - p_i) x A~ x~ + 1_j x w~: 1_j is the unit vector of mode j, p_i row i of the transition matrix,
        A~ the plant about the centre c, w~ its noise; `x` between two of them is the Kronecker product.
        """
        plant, channel = at(self.plant, k), at(self.channel, k)
        move, _, centre = centred_transition(plant, u, state.centre)
        modes, (errors, x, weights) = len(self.initial), _split_columns(state)
        rows = jnp.where(state.moved, jnp.asarray(channel.transition), jnp.eye(modes))
        law = _mode_probabilities(x, weights) @ rows
        # F e and A~ x~ of each mode, then e+ and x~+ of each transition.
        errors = jax.vmap(lambda e: predict_by_mode(e, move, rows))(errors)
        x = jax.vmap(lambda x: move @ x)(x)

        def move_columns(change: jax.Array, e: jax.Array, x: jax.Array) -> jax.Array:
            """Return q+ = (e+, x~+) of one transition i -> j, without noise; `change`: 1_j - p_i."""
            return jnp.concatenate([e + kron(change[:, None], x), x])

        # From all modes to each: their columns side by side, and the process noise.
        noise = noise_in_mode(plant, u, second_moments_at_start(self.plant))

        def collect_into(one_j: jax.Array, chances: jax.Array, probability: jax.Array) -> WeightedColumns:
            """Return E[q+ q+' 1{next mode j}], from the indicator 1_j, P(j | i) by mode i (`chances`), and P(j).

            `errors` and `x` hold columns of e and x~ in each mode i, with `weights`. `rows` is the modes' transition
            matrix, and `noise` holds columns of the process noise. `move_columns` maps (e, x~) to (e+, x~+).
            """
            moved = WeightedColumns(jax.vmap(move_columns)(one_j - rows, errors, x), weights)
            process = WeightedColumns(kron(jnp.append(one_j, 1.0)[:, None], noise.matrix), probability * noise.weights)
            return triangularise(join_columns(side_by_side(moved, chances), process))

        moments = jax.vmap(collect_into)(jnp.eye(modes), rows.T, law)
        mean = predict_by_mode(state.mean[:, None], move, rows)[:, 0]
        return _make_belief(mean, moments, centre, jnp.asarray(True))

    @corrects
    def correct(
        self, state: SideInformationBelief, z: ArrayLike, k: Step = 0
    ) -> tuple[SideInformationBelief, Innovation]:
        """Weight the modes by the flag and by the pattern of arrivals, then project zeta on (1, s, z).

        z: what the channel delivers (m,), NaN for what did not arrive, and then the number of the flag, where
        `flagged`.
        """
        sensor, channel, observed = at(self.sensor, k), at(self.channel, k), jnp.asarray(z)
        z, flag = (observed[:-1], observed[-1]) if self.flagged else (observed, jnp.asarray(0.0))
        # P(flag, pattern | mode).
        flag_arrived, arrived = ~jnp.isnan(flag), ~jnp.isnan(z)
        number = jnp.clip(jnp.where(flag_arrived, flag, 0.0).astype(int), 0, channel.flags.shape[1] - 1)
        flag_chance = jnp.where(flag_arrived, jnp.asarray(channel.flags)[:, number], 1.0)
        pattern = pattern_of(channel, arrived)
        weight = jnp.asarray(channel.chance)[:, pattern] * flag_chance
        # Moments given the side information: those of each mode are multiplied by weight = P(mode | side information)
        # / P(mode); `excess` is what is added to them by it.
        _, x, weights = _split_columns(state)
        weight = weight / (weight @ _mode_probabilities(x, weights))
        prior = state._replace(variances=jnp.asarray(weight)[:, None] * state.variances)
        excess = jnp.asarray(weight - 1)[:, None] * state.variances
        links = jax.tree.map(
            lambda part: jnp.asarray(part)[:, pattern], (channel.mean, channel.gain_spread, channel.noise)
        )
        power = second_moments_at_start(self.plant)
        size = bound_signal_power_at_start(sensor, power)
        received = _make_measurement_model(prior, sensor, size, *links)
        prior = prior._replace(variances=spoil_where_known(prior.variances, power, (x, weights), received.noise))
        # What z says of zeta, then the innovation as it is reported: NaN for what did not arrive.
        after, innovations, innovation = _project_on_data(prior, excess, received, z)
        likelihood = innovations.log_density(arrived, jnp.abs(z) + jnp.abs(innovation.mean))
        value = jnp.where(arrived, innovation.mean, jnp.nan)
        covariance = jnp.where(arrived[:, None] & arrived, innovation.covariance, jnp.nan)
        if self.flagged:
            flag_innovation, covariance = append_flag(covariance, flag)
            value = jnp.append(value, flag_innovation)
        return after, Innovation(value, covariance, likelihood)

    @estimates
    def estimate(self, state: SideInformationBelief) -> Estimate:
        """Return the estimate c + sum_j zeta_j, zeta_j that of (x - c) 1{mode j}, and its error's covariance."""
        projection = make_mode_sum_matrix(len(self.states), len(self.initial))
        covariance = state.errors.through(projection).covariance
        return Estimate(state.centre + projection @ state.mean, covariance, self.claim)


class StackedMeasurementModel(NamedTuple):
    """Model of what arrives: z = common + output zeta + noise, its noise in each mode times the mode's probability.

    Shapes: output (m, N), common (m,), noise (M, m, m) columns.
    """

    output: jax.Array
    common: jax.Array
    noise: WeightedColumns


class PredictedInnovation(NamedTuple):
    """Innovation z - E[z | 1, s] (m,) and its covariance (m, m)."""

    mean: jax.Array
    covariance: jax.Array


def _split_columns(state: SideInformationBelief) -> tuple[jax.Array, jax.Array, jax.Array]:
    """Split into columns of e (M, N, q) and of x~ (M, n + 1, q) in each mode, and their weights (M, q)."""
    root, count = jnp.asarray(state.moments.matrix), len(state.mean)
    return root[:, :count], root[:, count:], jnp.asarray(state.variances)


def _make_belief(
    mean: jax.Array, moments: WeightedColumns, centre: jax.Array, moved: jax.Array
) -> SideInformationBelief:
    """Return the filter's state, with the triangular factors of each mode's moments (M, q, q)."""
    lower = jax.vmap(below_diagonal)(jnp.asarray(moments.matrix))  # what is below the unit diagonal
    return SideInformationBelief(
        mean=mean, lower=lower, variances=jnp.asarray(moments.weights), centre=centre, moved=moved
    )


def _mode_probabilities(x: jax.Array, weights: jax.Array) -> jax.Array:
    """Return the probabilities of the modes (M,), E[1^2 1{mode}]."""
    return jnp.einsum("jq,jq->j", x[:, -1] ** 2, weights)


def _make_measurement_model(
    state: SideInformationBelief,
    sensor: LinearSensor,
    size: jax.Array,
    gains: jax.Array,
    gain_spread: jax.Array,
    link: WeightedColumns,
) -> StackedMeasurementModel:
    """Return what is received of zeta = x~ 1{mode}: the output matrix, the mean output, and the noise in each mode.

    In mode j, z = H y~ + n with y~ = (y, 1) = C~ x~ + v~: the noise has the covariance T_j(E[y~ y~' 1{j}]) +
    P(j) (Hbar_j R~ Hbar_j' + Cov n_j), T_j(Y) = E[(H - Hbar_j) Y (H - Hbar_j)' | j], and the rounding of z.

    Args:
        state: estimate of zeta and moments of each mode.
        sensor: C~ and R~ = Cov v~.
        size: squares of the numbers that are summed in y, for rounding (p,).
        gains: Hbar_j (M, m, p + 1).
        gain_spread: the tensor of T_j (M, m, m, p + 1, p + 1).
        link: columns of Cov n_j (M, m, m).
    """
    measure, noise = centred_measurement(sensor, state.centre)  # C~ and R~
    _, x, weights = _split_columns(state)
    law = _mode_probabilities(x, weights)

    def describe_noise(
        gain: jax.Array, spread: jax.Array, link: WeightedColumns, x: WeightedColumns, p: jax.Array
    ) -> WeightedColumns:
        """Return the noise of z = G y + n in one mode of probability p: sensor, link, rounding and the gain's spread.

        `gain` and `spread` are the mean and covariance of (G, n), and `link` holds columns of Cov n. `x` holds columns
        of E[x~ x~' 1{mode}], x~ = (x, 1). (y, 1) = measure x~ + noise. `size` is E[x_i^2] at the start, for rounding.
        """
        signal_moments = x.through(measure).covariance + p * noise  # E[y~ y~' 1{mode}]
        known_noise = join_columns(sensor.noise.columns.through(gain[:, :-1]), link).times(p)
        rounding = rounding_of((jnp.abs(gain[:, :-1]) @ square_root(size)) ** 2).times(p)
        gain_noise = factor_spread(jnp.einsum("mlab,ab->ml", spread, signal_moments))
        return triangularise(join_columns(known_noise, rounding, gain_noise))

    # Output matrix of zeta less the mean output; modes of probability zero have none.
    output, common = subtract_mean_output(gains @ measure, law)
    output = concatenate_modes(jnp.where(law[:, None, None] > 0, output, 0.0))
    noises = jax.vmap(describe_noise)(gains, gain_spread, link, WeightedColumns(x, weights), law)
    return StackedMeasurementModel(output=output, common=common, noise=noises)


def _project_on_data(
    state: SideInformationBelief, excess: jax.Array, received: StackedMeasurementModel, z: jax.Array
) -> tuple[SideInformationBelief, Innovations, PredictedInnovation]:
    """Project zeta on (1, s, z): what these say of the error e = zeta - s goes from e to the estimate s.

    All random numbers are rows over common columns, those of all modes side by side, with weights: the second moment of
    two of them is the weighted product of their rows. Before the side information (1, s) said nothing of e; what they
    say now comes of the growth of the weights.

    Args:
        state: s, and moments of (e, x~) in each mode, given the side information.
        excess: by what the weights of the columns grew by it (M, q).
        received: z = common + output zeta + noise.
        z: measurement (m,), NaN for what did not arrive.

    Returns:
        The state after; the innovations of z, each given the components before it; z - E[z | 1, s] and its covariance.
    """
    errors, x, weights = _split_columns(state)
    m, count, modes, arrived = len(z), len(state.mean), len(weights), ~jnp.isnan(z)
    # Columns of the state and of the noise of z, in each mode.
    errors, x = (jnp.pad(part, ((0, 0), (0, 0), (0, m))) for part in (errors, x))
    noise = jnp.pad(jnp.asarray(received.noise.matrix), ((0, 0), (0, 0), (weights.shape[1], 0)))
    weights = jnp.concatenate([weights, received.noise.weights], axis=1).reshape(-1)
    excess = jnp.pad(excess, ((0, 0), (0, m))).reshape(-1)
    # Basis 1 and s = zeta - e; rows z, less what s says, and e: of all modes side by side, and their values.
    zeta = jax.vmap(lambda j, x: kron(j[:, None], x))(jnp.eye(modes), x)
    innovation_rows = jnp.where(arrived[:, None], jax.vmap(lambda e: received.output @ e)(errors) + noise, 0.0)
    basis, rows = _join_modes(x[:, -1:], zeta - errors), _join_modes(innovation_rows, errors)
    values = jnp.where(arrived, z - received.common - received.output @ state.mean, 0.0)
    # First 1 and s: e and z less what these say of them. Directions of s whose variance is rounding say nothing: eps of
    # the second moments of x~, and of s itself.
    size = jnp.tile(jnp.square(_join_modes(x)) @ weights, modes) + jnp.square(basis[1:]) @ weights
    smallest = jnp.append(0.0, np.sqrt(unit_of(weights)) * size)
    basis, basis_values, variances = orthogonalise_first_rows(basis, jnp.append(1.0, state.mean), weights, 1 + count)
    inverses = reciprocal_or_zero(jnp.where(variances > smallest, variances, 0.0))
    gains = (rows @ (excess * basis).T) * inverses
    rows, values = rows - gains @ basis, jnp.append(values, -state.mean) - gains @ basis_values
    expected = PredictedInnovation(values[:m], WeightedColumns(rows[:m], weights).covariance)
    # Then what z says of e.
    rows, values, variances = orthogonalise_first_rows(rows, values, weights, m)
    innovations = Innovations(values[:m], variances, jnp.diagonal(expected.covariance))
    # Factors of each mode.
    remaining = jnp.moveaxis(rows[m:].reshape(count, modes, -1), 1, 0)
    moments = jax.vmap(triangularise)(
        WeightedColumns(jnp.concatenate([remaining, x], axis=1), weights.reshape(modes, -1))
    )
    return _make_belief(-values[m:], moments, state.centre, state.moved), innovations, expected


def _join_modes(*parts: jax.Array) -> jax.Array:
    """Stack the rows of all parts, each (M, rows, columns), with the columns of all modes side by side."""
    rows = jnp.moveaxis(jnp.concatenate(parts, axis=1), 0, 1)
    return rows.reshape(len(rows), -1)


def side_information_filter(
    plant: AnyPlant, sensor: AnySensor, channel: Channel, flags: Float[ArrayLike, "modes flags"] | None = None
) -> SideInformationFilter:
    """Return the linear filter with side information on the modes: which packets arrived, and a flag with each.

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
    # What the filter is told is what `with_flag` delivers; flags of the joint mode of several chains no channel
    # delivers, so that nothing is known of what the claim is about.
    if flags is not None and len(memories(channel)) != 1:
        return filter
    received = channel if flags is None else at_each_step(lambda link: with_flag(link, chances), channel)
    return with_premise(filter, Premise(plant, sensor, received))


@cache_by_object
def _describe_channel_by_mode(channel: Channel) -> tuple[Float[Array, " M"], list[ChannelByPattern], bool]:
    """Return the modes' initial probabilities, the channel by mode at each step, and whether all laws are known."""
    steps = [joint_modes(step) for step in unstack(channel)]
    # All probabilities are known if every map has only one extreme law (corner).
    is_known = all(affine.corner_count() == 1 for step in steps for affine in step.maps)
    no_flag = np.ones((len(steps[0].initial), 1))
    return steps[0].initial, describe_by_pattern(steps, no_flag), is_known and not uncertain_chain(channel)
