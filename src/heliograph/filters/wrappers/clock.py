"""Filter of a plant and its nodes' clocks that estimates a clock only while the data make it observable."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp

from heliograph.engine.choice import compile_on_call
from heliograph.factors.factored_gaussian import Gaussian, correct_by_gain
from heliograph.factors.pivots import spoil_derivatives, unit_of
from heliograph.filters.base import Step, corrects, make_sizes, predicts
from heliograph.filters.gaussian.factories import make_base_gaussian_filter
from heliograph.filters.gaussian.gaussian import GaussianFilter
from heliograph.filters.gaussian.gaussian_prediction import second_moments_at_start
from heliograph.filters.gaussian.moment_transforms import KNOWN, SMALLEST, AbstractTransform, PolynomialMoments
from heliograph.filters.gaussian.signal_moments import (
    find_signal_moments,
    innovation_covariance,
    make_received_noise,
)
from heliograph.filters.gaussian.uncertain_channel_updates import Polytope
from heliograph.filters.innovation import gaussian_innovation
from heliograph.filters.wrappers.wrapper import AbstractWrapper
from heliograph.model.assumed.assumed_model import believes
from heliograph.model.channel import Channel
from heliograph.model.estimate import Innovation
from heliograph.model.over_time import at
from heliograph.model.plant import AnyPlant, read_first_plant
from heliograph.model.sensor import AnySensor
from heliograph.numerics.angles.angle import wrap_near
from heliograph.numerics.check import fail, items
from heliograph.numerics.lapack import eigh
from heliograph.numerics.linalg import diagonal
from heliograph.numerics.trace_settings import writes_for_derivatives
from heliograph.numerics.types import ArrayLike, Bool, Float, Int
from heliograph.random_affine.moments.second_moments import SecondOrder

Observe = Callable[[jax.Array], jax.Array]
SIGNIFICANT = 9.0  # squared deviations: a speed within three deviations of zero gives no information on time
SHARE = 1e-3  # an offset is unobservable if other states explain all but this share of the outputs' derivatives by it
RANK = 1e-12  # share of the largest eigenvalue: directions of smaller eigenvalues are unobservable


class ClockBelief(NamedTuple):
    """Plant and clocks given the data, the last input, and which clocks the last data made observable.

    Shapes: plant and clocks (n,), inputs (inputs,), silence (received,), observed (clocks,).
    `silence` counts the steps since each component of z last arrived.
    """

    gaussian: Gaussian
    inputs: Float[jax.Array, " inputs"]
    silence: Int[jax.Array, " received"]
    observed: Bool[jax.Array, " clocks"]


class ClockFilter(AbstractWrapper):
    """A Gaussian filter of a plant with clocks, in which a clock that cannot be observed is considered, not estimated.

    An offset o enters as y - o dy/dt. It is observable against another clock on the same plant, and while the plant
    moves: with one node alone, shifting everything in time by o gives the same data, and a plant at rest gives no
    information on time. The filter linearises at estimates that differ from step to step, and would claim information
    that the data do not hold. So at each step it tests, for each clock,

    - whether dy/dt is more than three standard deviations from 0 in some output,
    - whether, over as many steps as there are states, along the motion without noise, the derivatives by o of what is
      received are linearly independent of those by all other states; a common shift in time is not. Components that
      have not arrived for as many steps do not count, nor do those that carry noise only.

    If not, offset and drift keep mean and covariance, and the other states are corrected without knowledge of them
    (Schmidt): K = 0 there, P+ = P - K C - C' K' + K S K', C = Cov(z, x).

    Args:
        base: the joint filter of plant and clocks.
        offsets: index of each clock's offset in the state; its drift is the next state.

    Source: Schmidt (1966) for states that are considered; the observability matrix along a trajectory.
    """

    base: GaussianFilter
    offsets: tuple[int, ...] = eqx.field(static=True)

    def within(self, state: ClockBelief) -> Gaussian:
        """Return the Gaussian of plant and clocks, without the counters of this filter."""
        return state.gaussian

    @compile_on_call
    def init(self) -> ClockBelief:
        """Return the law of plant and clocks before any data, in which no clock is observable yet."""
        start = self.base.init()
        # A component that has not arrived for n steps, the number of states, does not count; none has arrived yet.
        silence = jnp.full(self.received, len(self.states))
        observed = jnp.zeros(len(self.offsets), dtype=bool)
        return ClockBelief(gaussian=start, inputs=jnp.zeros(len(self.inputs)), silence=silence, observed=observed)

    @predicts
    def predict(self, state: ClockBelief, u: ArrayLike = (), k: Step = 0) -> ClockBelief:
        """Predict plant and clocks over step k.

        The inputs are kept, since the test of observability in `correct` goes on along the motion under them. `silence`
        counts the steps since each component of z last arrived, and grows by 1.
        """
        predicted = self.base.predict(state.gaussian, u, k)
        return ClockBelief(
            gaussian=predicted, inputs=jnp.asarray(u, dtype=float), silence=state.silence + 1, observed=state.observed
        )

    @corrects
    def correct(self, state: ClockBelief, z: ArrayLike, k: Step = 0) -> tuple[ClockBelief, Innovation]:
        """Correct with what arrived of z, leaving clocks that cannot be observed as they are.

        The state has the plant's states, and offset and drift of each node's clock. A filter linearised at changing
        estimates would claim information on offsets that the data do not hold. So offset and drift of a clock that is
        not observable get the gain 0: they keep mean and covariance, and the others are corrected in spite of them.
        """
        base = self.base
        # Moments of the signal y = h(x) + v, and the expected measurement E[z] = M E[y] + b.
        channel: SecondOrder = at(base.channel, k)
        sensor, prior = at(base.sensor, k), state.gaussian
        signal = find_signal_moments(
            at(base.plant, k), sensor, base.transform, prior, second_moments_at_start(base.plant, base)
        )
        expected = jnp.asarray(channel.mean_gain @ signal.mean + channel.offset)
        z = wrap_near(jnp.asarray(z), expected, base.observed_angles)
        # Innovation covariance S, for all components.
        present = ~jnp.isnan(z)
        total = jnp.asarray(innovation_covariance(signal, channel))
        # Observability is tested over n steps, as many as there are states: components that have not arrived for n
        # steps would not have been in these data, and do not count.
        silence = jnp.where(present, 0, state.silence)
        is_recent = silence < len(self.states)
        recent_gain = jnp.where(is_recent[:, None], jnp.asarray(channel.mean_gain), 0.0)
        observed = self._test_observable(state, lambda x: recent_gain @ sensor.measure(x), k) & jnp.any(present)
        # The Kalman gain, with zero rows for offset and drift of a clock that is not observable (Schmidt's filter).
        kalman_gain, _ = base.rule.correct(prior.covariance, signal, channel, present)
        gain = kalman_gain * self._mask_estimated(observed)[:, None]
        if writes_for_derivatives():  # by this gain they are not those of the covariances where a state is known
            spread = prior.mean**2 + diagonal(prior.covariance)
            known = prior.variances <= jnp.maximum((KNOWN * unit_of(spread)) ** 2 * spread, SMALLEST)
            gain = spoil_derivatives(gain, jnp.any(known))
        slopes = jnp.asarray(channel.mean_gain) @ signal.slopes
        noise = make_received_noise(signal, channel)
        after = correct_by_gain(prior, slopes, noise, gain, jnp.where(present, z - expected, 0.0))
        belief = ClockBelief(gaussian=after, inputs=state.inputs, silence=silence, observed=observed)
        return belief, gaussian_innovation(z, expected, total)

    def _mask_estimated(self, observed: jax.Array) -> jax.Array:
        """Return a mask (n,) that is 0 for offset and drift of unobserved clocks, and 1 for all other states.

        `self.offsets` holds the index of each clock's offset in the state. Its drift is the next state.
        """
        mask = jnp.ones(len(self.states))
        for i, offset in enumerate(self.offsets):
            offset_and_drift = slice(offset, offset + 2)
            mask = mask.at[offset_and_drift].set(jnp.where(observed[i], 1.0, 0.0))
        return mask

    def _test_observable(self, state: ClockBelief, observe: Observe, k: Step) -> jax.Array:
        """Return whether each clock is observable (clocks,).

        A clock with the offset o is observable on two conditions. The square of dy/do must be above SIGNIFICANT (9)
        times its variance by the uncertainty of the state. And the derivatives by o must have at least the share SHARE,
        1e-3, that is linearly independent of those by the other states.
        """
        jacobian = jax.jacfwd(observe)
        slopes = jacobian(state.gaussian.mean)
        curvature = jax.jacfwd(jacobian)(state.gaussian.mean)
        independent_share = self._independent_shares(state, observe, k)
        observable = []
        for i, offset in enumerate(self.offsets):
            # dy/do of each received component is linear in the state to first order, which gives its variance.
            gradient = curvature[:, offset]
            variance = jnp.einsum("ri,ij,rj->r", gradient, state.gaussian.covariance, gradient)
            is_significant = jnp.any(slopes[:, offset] ** 2 > SIGNIFICANT * variance)
            observable.append(is_significant & (independent_share[i] > SHARE))
        return jnp.stack(observable)

    def _independent_shares(self, state: ClockBelief, observe: Observe, k: Step) -> jax.Array:
        """Return for each clock the share of its column in the observability matrix O that other states do not explain.

        The offset of a node's clock is a state of the filter; it can be estimated only if it is observable.
        The rows of O = (C; C F; C F F; ...) are the derivatives of the outputs at the next n steps by the present
        state, along the motion without noise: C is that of the outputs and F that of a step. Column o belongs to the
        offset o. The share is 1 - r^2, with r^2 the squared length of its projection on the other columns over that of
        the column; if it is 0, other states can imitate the offset. `observe` returns the outputs of a state.
        """
        plant, n = at(self.base.plant, k), len(self.states)

        def move_and_give_gramian_part(
            carry: tuple[jax.Array, jax.Array], _: None
        ) -> tuple[tuple[jax.Array, jax.Array], jax.Array]:
            """Move one step on, and return the term of the present step in O'O = sum (C F^i)' (C F^i).

            `carry` holds the state at a later step, and its derivatives by the present state, F^i. The inputs are
            assumed to stay at `state.inputs`.
            """
            x, slopes_by_present = carry
            rows = jax.jacfwd(observe)(x) @ slopes_by_present
            transition_slopes = jax.jacfwd(lambda x: plant.transition(x, state.inputs))(x)
            return (plant.transition(x, state.inputs), transition_slopes @ slopes_by_present), rows.T @ rows

        _, squares = jax.lax.scan(move_and_give_gramian_part, (state.gaussian.mean, jnp.eye(n)), None, length=n)
        return jnp.stack([_compute_unexplained_share(jnp.sum(squares, axis=0), offset) for offset in self.offsets])


def _compute_unexplained_share(gramian: jax.Array, column: int) -> jax.Array:
    """Return 1 - r' R^+ r, the squared share of a column of O that the other columns do not explain.

    `gramian` is O'O. R are the cosines between the other columns of O, and r those of this column with them.
    Eigenvalues of R below the share RANK, 1e-12, of the largest count as zero. For a column of zeros the result is 0.
    """
    lengths = jnp.sqrt(jnp.diagonal(gramian))
    scale = jnp.where(lengths > 0, 1 / jnp.where(lengths > 0, lengths, 1.0), 0.0)
    correlations = scale[:, None] * gramian * scale
    others = jnp.array([i for i in range(gramian.shape[0]) if i != column])
    R = correlations[jnp.ix_(others, others)]
    r = correlations[others, column]
    values, vectors = eigh(R)
    is_used = values > RANK * values[-1]
    explained = jnp.sum(jnp.where(is_used, (vectors.T @ r) ** 2 / jnp.where(is_used, values, 1.0), 0.0))
    return jnp.where(lengths[column] > 0, 1 - explained, 0.0)


@believes
def clock_filter(
    plant: AnyPlant,
    sensor: AnySensor,
    channel: Channel,
    clocks: Sequence[str],
    transform: AbstractTransform | None = None,
) -> ClockFilter:
    """Return the filter of plant and clocks, as `with_clocks` makes them, that detects when a clock cannot be observed.

    Each clock of a node has an unknown offset, a state, by which its measurements are dated wrongly; how well that
    shows depends on the trajectory. While its last steps leave an offset unobservable, the offset is not corrected,
    only considered: its variance counts in every update (Schmidt). Correcting it would make the variance too small.

    Args:
        plant: the plant with its clocks' offsets and drifts among the states.
        sensor: the sensor of all nodes together (`joint_sensor`), m outputs.
        channel: the channel of all nodes together.
        clocks: names of the nodes that have a clock.
        transform: moments of h; `PolynomialMoments(2)` by default, those of a product of Gaussians, which are exact
            where h is linear in the plant's states.

    Claim (what the covariance is said to be): "nominal".

    Raises:
        ValueError: names that are no clocks of the plant, uncertain probabilities, parts that do not fit.

    Source: Schmidt (1966) for states that are considered; the observability matrix along a trajectory.
    """
    states = read_first_plant(plant).states
    names = [f"{name}_offset" for name in items("clocks", clocks, "names of nodes")]
    if not names or any(name not in states for name in names):
        raise fail("clocks", f"some whose offsets are among the states {list(states)}", list(clocks))
    # The joint Gaussian filter, to which the test of observability is added.
    chosen = PolynomialMoments(2) if transform is None else transform
    base = make_base_gaussian_filter("clock filter", plant, sensor, channel, chosen, Polytope())
    # Schmidt's update needs the moments of the channel themselves, not bounds.
    described = jax.tree.leaves(base.channel, is_leaf=lambda leaf: isinstance(leaf, SecondOrder))
    if any(isinstance(leaf, SecondOrder) and leaf.uncertain for leaf in described):
        raise fail("channel of a clock filter", "known probabilities", "uncertain ones")
    return ClockFilter(
        base=base,
        offsets=tuple(states.index(name) for name in names),
        **make_sizes("nominal", base, base.received),
    )
