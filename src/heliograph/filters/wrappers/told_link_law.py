"""Filters of links whose law is reported with each message: each message is used by the filter of the reported law.

The law of a link is that of its gain G and noise n in z = G y + n. Numbers that a message reports beside its values,
such as its gain, a reading of the gain or the noise variance, decide it: channel side information, "told numbers" in
names. A typical number is the value assumed for a number that was not reported.
"""

from collections.abc import Callable
from typing import ParamSpec, TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import (
    AbstractFilter,
    FilterAngles,
    Step,
    corrects,
    make_sizes,
)
from heliograph.filters.smoother_step import SmootherStep, StepTrace
from heliograph.filters.wrappers.wrapper import AbstractWrapper
from heliograph.model.assumed.assumed_model import with_assumed
from heliograph.model.channel import Channel
from heliograph.model.channel_side_information import separate_told_numbers
from heliograph.model.estimate import Innovation, weakest
from heliograph.model.over_time import at, at_each_step, first
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor
from heliograph.numerics.angles.angle import Angles
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.module import Module
from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.types import ArrayLike, PyTree
from heliograph.random_affine.channel_state_information import (
    condition_on_told_numbers,
    list_told_maps,
    list_told_numbers_of_outputs,
    make_laws_certain,
    numbers_give_law,
)
from heliograph.random_affine.moments.second_moments import second_order
from heliograph.random_affine.untold_law import believe_untold, draw_told, has_untold_law

ROUNDING = 1e-12  # share of squared gains: a spread below it is rounding

F = TypeVar("F", bound=AbstractFilter)
P = ParamSpec("P")


class FilterMaker(Module):
    """A function that makes a filter, with all of its arguments but plant, sensor and channel."""

    function: Callable[..., AbstractFilter] = eqx.field(static=True)
    arguments: dict[str, object]

    def __call__(self, plant: AnyPlant, sensor: AnySensor, channel: Channel) -> AbstractFilter:
        """Make the filter of this plant, sensor and channel."""
        return self.function(plant=plant, sensor=sensor, channel=channel, **self.arguments)


class ToldFilter(AbstractWrapper):
    """A filter that corrects with each message as if the link had the law that the message reports.

    For each message, `make` builds the filter of that law, which corrects the common state. Predictions do not depend
    on the link, and are those of `base`. A value is not used if a reported number that its own link needs is missing. A
    pilot's reading is not needed: without it the gain has its unconditional law.

    Args:
        base: the filter for typical numbers, assumed where none were reported; it predicts.
        plant: the plant.
        sensor: its sensor.
        link: the channel z = G y + n whose law depends on the reported numbers, without these numbers themselves.
        make: builds a filter from a plant, a sensor and a link of known law.
        values: indices of the measured values in a message z.
        numbers: indices of the reported numbers in a message z.
    """

    base: AbstractFilter
    plant: AnyPlant
    sensor: AnySensor
    link: Channel
    make: FilterMaker
    values: tuple[int, ...] = eqx.field(static=True)
    numbers: tuple[int, ...] = eqx.field(static=True)

    @corrects
    def correct(self, state: PyTree, z: ArrayLike, k: Step = 0) -> tuple[PyTree, Innovation]:
        """Correct by the filter of the law that the message z reports.

        z has measured `values`, and reported `numbers` such as the link's gain.
        """
        values, numbers = self._split_message(jnp.asarray(z))
        filter, is_valid_law = self._make_filter_given(numbers, k)
        after, innovation = filter.correct(state, values, k)
        # Numbers that give no law (a negative variance) make the state NaN, so that the caller refuses the message.
        is_message = ~jnp.all(jnp.isnan(values))
        after = _spoil_state(after, ~is_valid_law & is_message)
        return after, self._place_innovation(innovation)

    def expect(self, state: PyTree, k: Step = 0) -> Innovation:
        """Return the innovation -E z of a measurement of zeros at step k, and its covariance, before any message.

        No numbers are reported yet. If their law is known (`knows_law_of_numbers`), gain and noise of the link have
        their moments under that law; else the typical numbers are assumed.
        """
        filter = self.make(self.plant, at(self.sensor, k), believe_untold(at(self.link, k)))
        _, innovation = filter.correct(state, jnp.zeros(len(self.values)), k)
        return self._place_innovation(innovation)

    def draw_numbers(self, key: jax.Array, k: Step = 0) -> jax.Array:
        """Draw the numbers that a message reports at step k, by their laws; raise ValueError if one has no law."""
        return draw_told(at(self.link, k), key)

    def with_numbers(self, z: jax.Array, numbers: jax.Array) -> jax.Array:
        """Return the message z with its reported numbers replaced by these."""
        return z.at[np.array(self.numbers)].set(numbers)

    @property
    def knows_law_of_numbers(self) -> bool:
        """True if the law of the numbers that messages report (gains, noise variances) is known.

        Then `expect` averages over that law; else it assumes a typical value for each number. The link of the first
        step is asked, since links that vary over time have laws of one kind.
        """
        return has_untold_law(first(self.link))

    def _place_innovation(self, innovation: Innovation) -> Innovation:
        """Return the innovation of a whole message z, from that of its measured values.

        Reported numbers are not measured. They have the innovation NaN, like missing values, so that no test uses them.
        """
        received = len(self.values) + len(self.numbers)
        rows = np.array(self.values)
        value = jnp.full(received, jnp.nan).at[rows].set(innovation.value)
        covariance = jnp.full((received, received), jnp.nan)
        covariance = covariance.at[rows[:, None], rows].set(innovation.covariance)
        weight = innovation.weight
        if weight is not None:
            weight = jnp.full(received, jnp.nan).at[rows].set(weight)
        return Innovation(value, covariance, innovation.log_likelihood, weight)

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return the smoother step of the filter of the law that this step's message reports.

        A message has measured values, and numbers that give the law of the link's gain and noise.
        """
        values, numbers = self._split_message(jnp.asarray(step.z))
        filter, _ = self._make_filter_given(numbers, step.k)
        return filter.smoother_step(step._replace(z=values))

    @property
    def attitude(self) -> Angles:
        """Indices of attitudes among the states, those of the base filter."""
        return self.base.attitude

    def angles_used(self) -> FilterAngles | None:
        """Return the angles of the base filter, with their indices in a message; reported numbers are no angles."""
        angles = self.base.angles_used()
        return angles and angles._replace(received=tuple(self.values[i] for i in angles.received))

    @property
    def knows_gain(self) -> bool:
        """True if the reported numbers leave no gain random; then the innovations of Gaussian models are independent.

        It is tested with typical numbers, at the first step: all Cov(G_ij, G_kl) must be 0. Up to the share ROUNDING,
        1e-12, of the largest squared gain counts as rounding. A link with memory never has known gains.
        """
        link = believe_typical(first(self.link))
        if link.remembers:
            return False
        moments = second_order(link)
        largest_gain = np.max(np.abs(np.asarray(moments.mean_gain)), initial=0.0)
        gain_covariances = np.abs(np.asarray(moments.gain_covariance))
        return bool(np.all(gain_covariances <= ROUNDING * largest_gain**2))

    def with_models(self, plant: AnyPlant, sensor: AnySensor, link: Channel) -> "ToldFilter":
        """Return the same kind of filter for another plant, sensor and link, with the same claim.

        Its messages have the same form: measured values and reported numbers at the same indices of z.
        """
        # The base filter, for the law of typical numbers; each message is used by the filter of its own law.
        base = self.make(plant, sensor, at_each_step(believe_typical, link))
        sizes = make_sizes(self.claim, base, self.received)
        return ToldFilter(
            base=base,
            plant=plant,
            sensor=sensor,
            link=link,
            make=self.make,
            values=self.values,
            numbers=self.numbers,
            **sizes,
        )

    def _split_message(self, z: jax.Array) -> tuple[jax.Array, jax.Array]:
        """Return the measured values and the reported numbers of a message z.

        A value is NaN if a number that it needs is missing.
        """
        numbers = z[np.array(self.numbers)]
        is_known = ~jnp.isnan(numbers) | self._may_be_missing
        depends = list_told_numbers_of_outputs(first(self.link))  # (values, numbers): which value needs which number
        is_usable = jnp.all(is_known | ~depends, axis=1)
        return jnp.where(is_usable, z[np.array(self.values)], jnp.nan), numbers

    @property
    def _may_be_missing(self) -> jax.Array:
        """Flags (numbers,): True for a reported number without which a message can still be used.

        Such a number is a pilot's reading of the gain: without it the gain has its unconditional law.
        """
        maps = list_told_maps(first(self.link))  # parts of the link whose law depends on reported numbers
        # `memory.announced` is how many numbers are reported for a part.
        return jnp.concatenate([jnp.full(part.memory.announced, part.optional) for part in maps])

    def _make_filter_given(self, numbers: jax.Array, k: Step) -> tuple[AbstractFilter, jax.Array]:
        """Build the filter for the link z = G y + n with the law that one message's reported numbers give it.

        The numbers (numbers,) are, for example, the present gain and noise variance. They are NaN where the message
        lacks them. A number without which the law is not known is then replaced by its typical value (an example), so
        that the filter can be built; the measured values that need it are not used (`_split_message`).

        Returns the filter, and whether the numbers give a law: a negative variance, for example, gives none.
        """
        link = at(self.link, k)  # at step k
        # Typical numbers of all parts of the link with reported numbers ("told maps"), in the order of `numbers`.
        typical = jnp.concatenate([jnp.asarray(affine.typical) for affine in list_told_maps(link)])
        complete_numbers = jnp.where(jnp.isnan(numbers) & ~self._may_be_missing, typical, numbers)
        link_of_law = condition_on_told_numbers(link, complete_numbers)
        filter = self.make(self.plant, at(self.sensor, k), link_of_law)
        return filter, numbers_give_law(link, complete_numbers)


def _spoil_state(state: PyTree, is_refused: jax.Array) -> PyTree:
    """Return the state, with NaN for all its real numbers if it `is_refused`.

    So the caller sees that the message's numbers give no law of the link.
    """

    def spoil(leaf: jax.Array) -> jax.Array:
        """Return NaN in place of real numbers where the state is refused."""
        is_real = jnp.issubdtype(jnp.asarray(leaf).dtype, jnp.floating)
        return jnp.where(is_refused, jnp.nan, leaf) if is_real else leaf

    return jax.tree.map(spoil, state)


def build_told_filter(plant: AnyPlant, sensor: AnySensor, channel: Channel, make: FilterMaker) -> ToldFilter:
    """Return the filter behind a channel that delivers, beside z, numbers that give the law of its gain and noise.

    Such numbers, reported with each message, may be its gain or its noise variance. At each message the filter corrects
    with the link's law given its numbers.

    Args:
        plant: the plant.
        sensor: its sensor.
        channel: a channel that delivers numbers after z; it may vary over time.
        make: builds a filter from a plant, a sensor and a link of known law.

    Claim (what the covariance is said to be): that of the filter for typical numbers, the ones assumed where none came;
    "nominal" if the numbers depend on the state, or if they leave something random that is not drawn anew with each
    message.
    """
    # The link without the numbers that are reported beside it; and the filter for typical numbers. It predicts, as no
    # prediction depends on them.
    link = at_each_step(lambda channel: make_laws_certain(separate_told_numbers(channel).link), channel)
    base = make(plant, sensor, at_each_step(believe_typical, link))
    claim = base.claim
    if any(affine.reason_for_no_claim for affine in list_told_maps(first(link))):
        claim = weakest([claim, "nominal"])
    # Indices of the measured values and of the reported numbers in a message z.
    _, values, numbers = separate_told_numbers(first(channel))
    filter = ToldFilter(
        base=base,
        plant=plant,
        sensor=sensor,
        link=link,
        make=make,
        values=values,
        numbers=numbers,
        **make_sizes(claim, base, len(values) + len(numbers)),
    )
    # The assumed: the models under which the claim holds. Here they are the channel and sensor given.
    assumed = base.assumed
    return with_assumed(filter, assumed and assumed.replaced(sensor=sensor, channel=channel))


@in_float64
def believe_typical(link: PyTree) -> PyTree:
    """Return a link with the law that it has if its messages report the typical numbers.

    Each part of the link whose law depends on reported numbers, such as its gain, holds a typical value for each: the
    value that is assumed where none was reported.
    """
    typical = [part.typical for part in list_told_maps(link)]
    return condition_on_told_numbers(link, library(typical).concatenate(typical))
