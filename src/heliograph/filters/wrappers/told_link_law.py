"""Filters of links whose law is told with each message: for each the filter of the law that its numbers give.

Told numbers come with a message and say what the link did to it, such as its gain; a law is that of gain and noise.
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
from heliograph.model.channel import Channel
from heliograph.model.channel_side_information import separate_told_numbers
from heliograph.model.estimate import Innovation, weakest
from heliograph.model.over_time import at, at_each_step, first
from heliograph.model.plant import AnyPlant
from heliograph.model.premises.premise import with_premise
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
        """Make the filter of these three."""
        return self.function(plant=plant, sensor=sensor, channel=channel, **self.arguments)


class ToldFilter(AbstractWrapper):
    """The filter that `make` builds, for each message behind the link whose law its numbers give.

    Between messages all such filters are one: how a state moves depends on the plant, not on the link. A value is not
    used where a number is missing that tells of its own link, but for a pilot: without a reading the gain has its law.

    Args:
        base: the filter for typical numbers, which predicts.
        plant: the plant.
        sensor: its sensor.
        link: the channel without what is told.
        make: builds a filter of plant, sensor and a link.
        values: rows of z in which the link's values stand.
        numbers: rows in which what is told stands.
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
        """Correct by the filter of the law that the numbers of the message give.

        A message z has `values` that were measured, and `numbers` that tell of the link, such as its gain.
        """
        values, numbers = self._split_message(jnp.asarray(z))
        filter, is_law = self._make_filter_given(numbers, k)
        after, innovation = filter.correct(state, values, k)
        # Numbers that give no law make the state NaN, by which the caller knows that it must refuse the message.
        is_message = ~jnp.all(jnp.isnan(values))
        after = _spoil_state(after, ~is_law & is_message)
        return after, self._place_innovation(innovation)

    def expect(self, state: PyTree, k: Step = 0) -> Innovation:
        """Return minus the values that are expected at step k, with their covariance, before a message tells anything.

        The link is described by the law of its numbers, or by typical numbers if that law is unknown
        (`knows_law_of_numbers`).
        """
        # A measurement of zeros has the innovation 0 - E z.
        filter = self.make(self.plant, at(self.sensor, k), believe_untold(at(self.link, k)))
        _, innovation = filter.correct(state, jnp.zeros(len(self.values)), k)
        return self._place_innovation(innovation)

    def draw_numbers(self, key: jax.Array, k: Step = 0) -> jax.Array:
        """Draw the numbers that a message tells at step k by their laws; raise ValueError where one has none."""
        return draw_told(at(self.link, k), key)

    def with_numbers(self, z: jax.Array, numbers: jax.Array) -> jax.Array:
        """Return a message with these numbers in the place of its own."""
        return z.at[np.array(self.numbers)].set(numbers)

    @property
    def knows_law_of_numbers(self) -> bool:
        """True if `expect` is by the law of the numbers, not by typical ones."""
        return has_untold_law(first(self.link))

    def _place_innovation(self, innovation: Innovation) -> Innovation:
        """Return the innovation of the values at their rows of z.

        Told numbers are not measured. They have the innovation NaN, like missing values, so that no test uses them.
        """
        received, rows = len(self.values) + len(self.numbers), np.array(self.values)
        value = jnp.full(received, jnp.nan).at[rows].set(innovation.value)
        covariance = jnp.full((received, received), jnp.nan)
        covariance = covariance.at[rows[:, None], rows].set(innovation.covariance)
        weight = innovation.weight
        if weight is not None:
            weight = jnp.full(received, jnp.nan).at[rows].set(weight)
        return Innovation(value, covariance, innovation.log_likelihood, weight)

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return the smoother step of the filter that the told numbers give.

        A message has values that were measured, and numbers that tell the link's law.
        """
        values, numbers = self._split_message(jnp.asarray(step.z))
        filter, _ = self._make_filter_given(numbers, step.k)
        return filter.smoother_step(step._replace(z=values))

    @property
    def attitude(self) -> Angles:
        """Return the places of attitudes among the states of the filter within."""
        return self.base.attitude

    def angles_used(self) -> FilterAngles | None:
        """Return the angles of the filter within, at their rows; what is told is none."""
        angles = self.base.angles_used()
        return angles and angles._replace(received=tuple(self.values[i] for i in angles.received))

    @property
    def knows_gain(self) -> bool:
        """True if no gain is random given what is told, so that innovations of a Gaussian world are independent.

        It is decided with typical numbers. A spread up to the share ROUNDING, 1e-12, of squared gains is rounding.
        """
        link = believe_typical(first(self.link))
        if link.remembers:
            return False
        moments = second_order(link)
        largest_gain = np.max(np.abs(np.asarray(moments.mean_gain)), initial=0.0)
        return bool(np.all(np.abs(np.asarray(moments.gain_spread)) <= ROUNDING * largest_gain**2))

    def with_models(self, plant: AnyPlant, sensor: AnySensor, link: Channel) -> "ToldFilter":
        """Return the filter of another plant, sensor and link, told the same numbers; of the same claim.

        `values`, `numbers`: rows of z with what is measured, and with what is told of the link.
        """
        # The filter of a typical law: a message replaces it by its own.
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
        """Return the values and the numbers of a message; a value is NaN if a number that it needs is missing.

        Numbers tell the link's law. `list_told_numbers_of_outputs` (values, numbers) says on which numbers each value
        depends. `self._may_be_missing` is True for the numbers that are not needed.
        """
        numbers = z[np.array(self.numbers)]
        is_known = ~jnp.isnan(numbers) | self._may_be_missing
        is_usable = jnp.all(is_known | ~list_told_numbers_of_outputs(first(self.link)), axis=1)
        return jnp.where(is_usable, z[np.array(self.values)], jnp.nan), numbers

    @property
    def _may_be_missing(self) -> jax.Array:
        """True for the numbers that may be missing, of all that are told (numbers,)."""
        return jnp.concatenate([jnp.full(m.memory.announced, m.optional) for m in list_told_maps(first(self.link))])

    def _make_filter_given(self, numbers: jax.Array, k: Step) -> tuple[AbstractFilter, jax.Array]:
        """Build the filter of the link whose law these numbers give, and say whether they give one.

        A needed number that is missing is replaced by a typical one, so that the filter can be built.
        """
        link = at(self.link, k)
        typical = jnp.concatenate([jnp.asarray(affine.typical) for affine in list_told_maps(link)])
        complete = jnp.where(jnp.isnan(numbers) & ~self._may_be_missing, typical, numbers)
        filter = self.make(self.plant, at(self.sensor, k), condition_on_told_numbers(link, complete))
        return filter, numbers_give_law(link, complete)


def _spoil_state(state: PyTree, is_refused: jax.Array) -> PyTree:
    """Return the state, with NaN for all its real numbers if it `is_refused`.

    A state of NaN says that the message gave no law of the link.
    """

    def spoil(leaf: jax.Array) -> jax.Array:
        """Return NaN in place of real numbers where the state is refused."""
        is_real = jnp.issubdtype(jnp.asarray(leaf).dtype, jnp.floating)
        return jnp.where(is_refused, jnp.nan, leaf) if is_real else leaf

    return jax.tree.map(spoil, state)


def build_told_filter(plant: AnyPlant, sensor: AnySensor, channel: Channel, make: FilterMaker) -> ToldFilter:
    """Return the filter behind a channel that delivers with z the numbers that give its link's law (told numbers).

    Args:
        plant: the plant.
        sensor: its sensor.
        channel: a channel that delivers numbers after z; it may vary over time.
        make: builds a filter of plant, sensor and a link of known law.

    Claim: that of the filter for typical numbers; "nominal" where the numbers depend on the state, or leave open
    what is not drawn anew with each message.
    """
    # The link without the numbers that are reported beside it; and the filter for typical numbers. It predicts, as no
    # prediction depends on them.
    link = at_each_step(lambda channel: make_laws_certain(separate_told_numbers(channel).link), channel)
    base = make(plant, sensor, at_each_step(believe_typical, link))
    claim = base.claim
    if any(affine.reason_for_no_claim for affine in list_told_maps(first(link))):
        claim = weakest([claim, "nominal"])
    # Rows of z in which the link's values and the told numbers stand.
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
    premise = base.premise
    return with_premise(filter, premise and premise.replaced(sensor=sensor, channel=channel))


@in_float64
def believe_typical(link: PyTree) -> PyTree:
    """Return a link as it is for typical numbers."""
    typical = [affine.typical for affine in list_told_maps(link)]
    return condition_on_told_numbers(link, library(typical).concatenate(typical))
