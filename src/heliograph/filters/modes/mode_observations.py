"""Measurement updates by mode: each belief corrected in its mode, each mode weighted by its likelihood."""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.gaussian.belief import Belief
from heliograph.filters.gaussian.correction import Signal
from heliograph.filters.gaussian.gaussian import corrected
from heliograph.filters.gaussian.update import Polytope
from heliograph.filters.innovation import mixed_innovation
from heliograph.filters.modes.side_information import SideInformation, by_pattern, pattern_of
from heliograph.model.channel import Channel
from heliograph.model.estimate import Innovation
from heliograph.model.over_time import OverTime, over_time, unstack
from heliograph.numerics.angle import Angles, nearest
from heliograph.numerics.check import fail
from heliograph.numerics.types import Array, Float
from heliograph.random_affine.modes import joint_modes
from heliograph.random_affine.moments.second_moments import QuadraticMap, SecondOrder


def receive(
    belief: Belief,
    signal: Signal,
    channel: SideInformation,
    mode: jax.Array,
    weight: jax.Array,
    z: jax.Array,
    size: jax.Array,
    angles: Angles = (),
) -> tuple[Belief, jax.Array, Innovation]:
    """Correct each belief in its mode; return the beliefs, their posterior weights, and the mixture's innovation.

    `size`: E[x_i^2] at the start, (n,).
    weight+ ~ weight P(what arrives | mode) N(z; ...): the likelihood of the innovation is that of z given what arrives.
    """
    # Channel moments by mode, given which components arrived.
    kind = pattern_of(channel, ~jnp.isnan(z)) if len(channel.present) > 1 else 0
    mean, spread = jnp.asarray(channel.mean)[mode, kind], jnp.asarray(channel.spread)[mode, kind]
    # Prior weights given which components arrived.
    chance = weight * jnp.asarray(channel.chance)[mode, kind]
    prior = chance / jnp.sum(chance)

    def single(separate: Belief, sent: Signal, mean: jax.Array, spread: jax.Array) -> tuple[Belief, Innovation]:
        law = QuadraticMap(spread, jnp.zeros_like(spread))
        none = QuadraticMap(jnp.zeros_like(spread), jnp.zeros_like(spread))
        link = SecondOrder(mean[:, :-1], mean[:, -1], law, none, none, law, False)
        return corrected(separate, sent, link, Polytope(), z, size, angles)

    result, received = jax.vmap(single)(belief, signal, mean, spread)
    # Posterior weights, log w + log N(z; ...).
    possible = prior > 0  # a mode in which this cannot arrive has no map for it
    after = Belief(
        jnp.where(possible[:, None], result.mean, belief.mean),
        jnp.where(possible[:, None, None], result.covariance, belief.covariance),
    )
    weighed = jnp.where(possible, jnp.log(prior) + received.log_likelihood, -jnp.inf)
    value = nearest(jnp.asarray(received.value), received.value[jnp.argmax(prior)], angles)
    mixed = mixed_innovation(prior, value, received.covariance, jax.nn.logsumexp(weighed))
    return after, jax.nn.softmax(weighed), mixed


def describe_modes(channel: Channel, nodes: int) -> tuple[Float[Array, " M"], SideInformation | OverTime]:
    """Return the initial law of the modes, and the channel by mode and pattern of arrivals, at each step if it varies.

    Raises:
        ValueError: too many modes, maps whose moments are unknown, a mode whose output is certain among others: a
            probability cannot be weighed against densities.
    """
    steps = [joint_modes(c, nodes) for c in (unstack(channel) if isinstance(channel, OverTime) else [channel])]
    no_flags = np.ones((len(steps[0].initial), 1))
    parts = by_pattern(steps, no_flags)
    for part in parts if len(no_flags) > 1 else []:
        _check_random(part)
    return steps[0].initial, over_time(parts) if isinstance(channel, OverTime) else parts[0]


def _check_random(channel: SideInformation) -> None:
    """Check that z has a density in every combination of mode and pattern, for an x that has one."""
    for j, a in np.argwhere(np.asarray(channel.chance) > 0):
        rows, gain = np.flatnonzero(channel.present[a]), np.asarray(channel.mean[j, a])[:, :-1]
        random = (gain @ gain.T + np.einsum("ilaa->il", np.asarray(channel.spread[j, a])))[np.ix_(rows, rows)]
        if np.linalg.matrix_rank(random) < len(rows):
            raise fail("filter of modes", "outputs that are random in every mode (give the links noise)", f"mode {j}")
