"""A loss that the receiver knows of: the channel of complete packets, and every set of losses with its probability."""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.numerics.angles.angle import Angles
from heliograph.numerics.check import fail, scalar
from heliograph.numerics.numpy_or_jax import library, plain
from heliograph.numerics.types import ArrayLike, Float, PyTree
from heliograph.random_affine.base import AbstractRandomAffine, ArrivalOutcome, check_maps
from heliograph.random_affine.composite import DIRECT, AbstractMapWrapper, write_percentage
from heliograph.random_affine.hop import known
from heliograph.random_affine.moments.monomials import JointMoments
from heliograph.random_affine.moments.signal_path import ChannelPosition, SignalMoment, Visit


class Erasure(AbstractMapWrapper):
    """A map whose outputs are all lost with probability 1 - arrival, and the receiver knows: it reads NaN."""

    base: AbstractRandomAffine
    arrival: Float[jax.Array | np.ndarray, ""]

    def __init__(self, base: AbstractRandomAffine, arrival: ArrayLike):
        """Hold the map `base` and the probability `arrival` that its outputs are received."""
        (self.base,) = check_maps("erasure", [base])
        self.arrival = scalar("arrival probability", arrival, low=0.0, high=1.0)

    @property
    def erases(self) -> bool:
        """Always True: outputs may be lost, and are NaN then."""
        return True

    def _draw(self, state: PyTree[jax.Array], key: jax.Array) -> tuple[PyTree[jax.Array], jax.Array]:
        """Draw the map and whether its output arrives; its state moves in any case, and lost rows [G, n] are NaN."""
        arrival_key, base_key = jax.random.split(key)
        state, matrix = self.base.draw(state, base_key)
        is_lost = ~jax.random.bernoulli(arrival_key, self.arrival)
        return state, matrix.at[:-1].set(jnp.where(is_lost, jnp.nan, matrix[:-1]))

    def condition_on_arrival(self) -> AbstractRandomAffine:
        """Return the map inside, given that everything arrives."""
        return self.base.condition_on_arrival()

    def _outcomes(self) -> list[ArrivalOutcome]:
        """Return the outcomes of the map if its output arrives, and the outcome that nothing arrives.

        An outcome has its probability, the map given it, and which outputs arrive.
        """
        arrival = plain(self.arrival)
        none_arrives = np.zeros(self.outputs, dtype=bool)
        outcomes = [
            outcome._replace(probability=arrival * outcome.probability) for outcome in self.base.list_outcomes()
        ]
        zero_map = known(np.zeros((self.outputs, self.inputs)))
        return [*outcomes, ArrivalOutcome(1 - arrival, zero_map, none_arrives)]

    def carry_angles(self, sent: Angles) -> Angles:
        """Return the indices of the outputs of the map inside that are angles; a lost output is NaN in any case."""
        return self.base.carry_angles(sent)

    def in_words(self) -> str:
        """Return a text such as "Rician hop, 5% lost"."""
        return f"{self.base.in_words() or DIRECT}, {write_percentage(1 - self.arrival)} lost"

    def visit_hops(self, visit: Visit, position: ChannelPosition) -> tuple[AbstractRandomAffine, ChannelPosition]:
        """Return the erasure with visit(name, hop, signal) in place of each hop inside, and the position behind it.

        Hops send whether they are received or not, so that they receive the same signal as without the erasure.

        A hop is a transmitter with its link. `position` has the name and number of the next one, and the signal there.
        """
        base, position = self.base.visit_hops(visit, position)
        return self.rebuilt(base), position

    def carry_signal(self, signal: SignalMoment) -> SignalMoment:
        """Return E[(z, 1) (z, 1)'] given that z arrives, and the probability that it does.

        The loss is independent of z, so that the moment is that behind the map inside; the probability is multiplied by
        `arrival`.
        """
        signal_behind = self.base.carry_signal(signal)
        return signal_behind._replace(arrives=signal_behind.arrives * plain(self.arrival))

    def moments(self, order: int) -> JointMoments:
        """Refuse: a filter skips lost packets, and asks for the moments of the channel inside."""
        raise fail("moments of a channel", "one without erasures (give the filter what is inside)", "an erasure")


def second_moments(
    channel: AbstractRandomAffine,
) -> tuple[Float[np.ndarray, "m p+1"], Float[np.ndarray, "m m p+1 p+1"]]:
    """Return E[(G, n)] of z = G y + n, and the tensor T of E[z_i z_j | y] = sum_ab T[i, j, a, b] Y_a Y_b, Y = (y, 1).

    Both are those under the nominal law.
    """
    moments = channel.moments(2)
    xp = library(moments.mean, moments.second)
    return xp.asarray(moments.mean[:-1]), xp.asarray(moments.second)
