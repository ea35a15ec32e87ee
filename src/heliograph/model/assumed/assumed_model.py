"""What a filter believes: the plant, sensor, channel and trigger that its claim is about."""

import inspect
from collections.abc import Callable, Mapping
from copy import copy
from functools import wraps
from typing import TYPE_CHECKING, Any, ParamSpec, Protocol, TypeVar

import numpy as np

from heliograph.model.channel import Channel, perfect
from heliograph.model.diffuse_start import TAKEN_BY, UnknownStart
from heliograph.model.over_time import first
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor
from heliograph.numerics.check import fail, show_value
from heliograph.numerics.module import readable

if TYPE_CHECKING:  # what few filters believe is loaded where it is made
    from heliograph.model.readings.reading_limits import ReadingLimits
    from heliograph.model.relays import RelayNetwork
    from heliograph.model.trigger import AbstractTrigger
    from heliograph.model.words.encoder import Words

WITHOUT_ATTITUDE = "no attitude (hg.extended_filter, unscented_filter and cubature_filter know them)"
RATES_TAKEN_BY = "transitions of its modes by steps here (imm_filter, gpb1_filter and gpb2_filter take rates)"
LIMITS_TAKEN_BY = "states without limits here (Gaussian, multiple model, mixture and particle filters take them)"
MEAN_AND_COVARIANCE = 2  # order of the moments that a linear filter's claim rests on


@readable
class AssumedModel:
    """What a filter believes of the world: its claim is about this plant, sensor, channel and trigger.

    In a network the claim holds as far as they are the node's own (`heliograph.model.assumed.agreement`). It is
    kept beside the filter's numbers and decides none of them: filters that differ in it alone have one structure.

    Args:
        plant: the plant.
        sensor: its sensor; None for a filter without measurements, like the channel.
        channel: from the sensor to the filter.
        trigger: rule of the sender; None for one that sends at each step.
        order: order of the moments of noises and gains on which the claim rests; None for one that rests on their laws.
        relays: relays whose sums of hops are received, in place of sensor and channel; None by default.
        gains: gains of these relays by name, (steps, n, received).
        range: limits of what a node uses, which refuses other numbers; None where all are used, as filters believe.
        encoder: of the words that the sender sends; None of one that sends numbers.
    """

    def __init__(
        self,
        plant: AnyPlant,
        sensor: AnySensor | None = None,
        channel: Channel | None = None,
        trigger: "AbstractTrigger | None" = None,
        order: int | None = MEAN_AND_COVARIANCE,
        relays: "RelayNetwork | None" = None,
        gains: Mapping[str, np.ndarray] | None = None,
        range: "ReadingLimits | None" = None,
        encoder: "Words | None" = None,
    ):
        """Hold the models for which a filter is made, and on which its claim (exact, upper or nominal) depends.

        `trigger`: the rule by which the sender sends or is silent. `order`: highest order of moments of noises and
        gains that the filter uses, None for their whole laws. `relays` with their `gains` by name stand for sensor and
        channel. `range`: limits beyond which the receiver refuses a number. `encoder`: rounds what is sent to
        codewords.
        """
        self.plant, self.sensor, self.channel = plant, sensor, channel
        self.trigger, self.order = trigger, order
        self.relays = relays
        self.gains = {} if gains is None else dict(gains)
        self.range, self.encoder = range, encoder

    def replaced(self, **parts: Any) -> "AssumedModel":
        """Return a copy of these models in which some are replaced, by the names of their attributes (plant=...)."""
        other = copy(self)
        other.__dict__.update(parts)
        return other


class StaticAssumedModel:
    """An assumed model as a static field of a filter, which is a tree of arrays.

    JAX compiles a program anew for another static field. All objects of this class count as equal, so that filters
    which differ in their assumed model alone share one program.

    lowered: whether the claim was lowered, since the filter runs in another world than its assumed model.
    """

    def __init__(self, assumed: AssumedModel | None, lowered: bool = False):
        """Hold an assumed model, None of a filter without one, and whether the filter's claim was lowered."""
        self.assumed, self.lowered = assumed, lowered

    def __eq__(self, other: object) -> bool:
        """Return True for any other object of this class, so that no assumed model decides what is compiled."""
        return isinstance(other, StaticAssumedModel)

    def __hash__(self) -> int:
        """Return the same hash for all assumed models, since they count as equal."""
        return hash(StaticAssumedModel)


NOTHING = StaticAssumedModel(None)


class HasAssumedModel(Protocol):
    """A filter, a schedule or a linear system, which keeps what it was made for."""

    @property
    def kept(self) -> StaticAssumedModel:
        """The models for which it was made, wrapped so that they do not decide what is compiled."""


B = TypeVar("B", bound=HasAssumedModel)
P = ParamSpec("P")


def with_assumed(made: B, assumed: AssumedModel | None) -> B:
    """Return a copy of a filter, schedule or system that keeps what it was made for, its assumed model.

    Later a network compares the assumed model with its own models, to decide whether the claim on the covariance holds.

    Args:
        made: the filter, schedule or system, whose numbers stay.
        assumed: the plant, sensor, channel and so on that it assumes; None if they are not known.

    Raises:
        ValueError: the plant has an unknown start, attitudes, limits or rates of its modes, and `made` is of a kind
            that has no formulas for them.
    """
    # Each property of a plant that needs formulas of its own; `made` says by a flag whether it has them.
    unknown = assumed is not None and isinstance(first(assumed.plant).initial_covariance, UnknownStart)
    if unknown and not getattr(made, "takes_unknown_start", False):
        raise fail("initial covariance", TAKEN_BY, "hg.diffuse")
    attitude = () if assumed is None else first(assumed.plant).attitude
    if attitude and not getattr(made, "attitude", ()):
        raise fail(f"plant of a {type(made).__name__}", WITHOUT_ATTITUDE, list(attitude))
    limits = () if assumed is None else first(assumed.plant).limits
    if limits and not getattr(made, "takes_limits", False):
        raise fail("plant", LIMITS_TAKEN_BY, f"limits of {[name for name, _ in limits]}")
    rates = None if assumed is None else getattr(first(assumed.plant), "rates", None)
    if rates is not None and not getattr(made, "takes_rates", False):
        raise fail("plant", RATES_TAKEN_BY, "rates of switches")
    with_its_assumed = copy(made)
    object.__setattr__(with_its_assumed, "kept", StaticAssumedModel(assumed))  # the fields of a module are frozen
    return with_its_assumed


def believes(make: Callable[P, B]) -> Callable[P, B]:
    """Let the filter that a function makes keep the models for which it is made: plant, sensor, channel and so on.

    A filter's claim says what its covariance is (exact, upper bound, nominal), for these models. In a network
    the claim holds where these are the node's own. Without a channel, the sensor's outputs are received as they are.

    Args:
        make: a function that makes a filter for a plant, a sensor and a channel.

    Raises:
        ValueError: no function, or one whose parameters nobody can know.
    """
    model_names = ("plant", "sensor", "channel", "trigger", "encoder")
    try:
        parameters = inspect.signature(make)
    except (TypeError, ValueError) as error:
        raise fail("what makes a filter", "a function of a plant, a sensor and a channel", show_value(make)) from error

    @wraps(make)
    def build(*args: P.args, **kwargs: P.kwargs) -> B:
        """Make the filter by the decorated function `make`, and store the models among the arguments.

        The models are the arguments of these names: plant, sensor, channel, trigger and encoder.
        """
        arguments = parameters.bind(*args, **kwargs).arguments
        assumed = AssumedModel(**{name: arguments[name] for name in model_names if name in arguments})
        if assumed.sensor is not None and assumed.channel is None:
            # Without a channel the sensor's outputs are received as they are.
            assumed.channel = perfect(len(first(assumed.sensor).outputs))
        return with_assumed(make(*args, **kwargs), assumed)

    return build
