"""Models that a wrapper reads, accepted by the functions that make filters: limits, sensors of inputs, told numbers.

A decorator for each: where a model has what the wrapper is for, the function makes the wrapper of what it makes. The
wrappers are loaded when the first of them is made.
"""

import inspect
from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar, cast

from heliograph.filters.base import AbstractFilter
from heliograph.model.channel_side_information import separate_told_numbers
from heliograph.model.over_time import first
from heliograph.model.plant import AbstractPlant
from heliograph.model.sensor import AbstractSensor, AnySensor
from heliograph.random_affine.base import AbstractRandomAffine

F = TypeVar("F", bound=AbstractFilter)
P = ParamSpec("P")


def accept_limits(make: Callable[P, F]) -> Callable[P, F]:
    """Decorate a function that makes a filter, so that it accepts plants whose states have limits.

    The filter is made for the plant without limits, and a wrapper keeps its estimates within the limits.

    Args:
        make: a function of `plant` and other arguments, whose filter keeps Gaussians or particles.
    """
    parameters = inspect.signature(make)

    @wraps(make)
    def build_limited(*args: P.args, **kwargs: P.kwargs) -> F:
        """Make the filter of the plant without limits, and wrap it in the plant's limits if there are some.

        `make` is the function that makes the filter, and `parameters` its signature.
        """
        # Without limits, or without a plant (the function itself refuses that), nothing is changed.
        bound = parameters.bind(*args, **kwargs)
        plant = bound.arguments.get("plant")
        start = first(plant)
        if not isinstance(start, AbstractPlant) or not start.limits:
            return make(*args, **kwargs)
        # Imported only where there are limits.
        from heliograph.filters.wrappers.state_limits import build_limited_filter, without_limits

        bound.arguments["plant"] = without_limits(cast(Any, plant))
        return cast(F, build_limited_filter(make(*bound.args, **bound.kwargs), cast(Any, plant)))

    return build_limited


def accept_sensor_inputs(make: Callable[P, F]) -> Callable[P, F]:
    """Decorate a function that makes a filter, so that it accepts sensors y = h(x, u) + v that depend on inputs u.

    Most filters know only sensors without inputs. For a sensor y = h(x, u) a filter is made for typical inputs, and a
    wrapper gives it the sensor of the present inputs at each step.

    Args:
        make: a function of a plant, a sensor, mostly a channel, and more.

    Returns:
        A function with the same parameters.
    """
    parameters = inspect.signature(make)

    @wraps(make)
    def build_with_inputs(*args: P.args, **kwargs: P.kwargs) -> F:
        """Call `make`; if the sensor depends on inputs, wrap what it makes in a `FilterOfInputs`."""
        given = parameters.bind(*args, **kwargs).arguments
        sensor = first(given.get("sensor"))
        # What is no sensor has no inputs, and is for `make` to refuse.
        depends_on_inputs = isinstance(sensor, AbstractSensor) and bool(sensor.inputs)
        if not depends_on_inputs:
            return make(*args, **kwargs)
        from heliograph.filters.wrappers.sensor_inputs import build_filter_of_inputs

        plant, sensor = given.pop("plant"), given.pop("sensor")

        make_any: Callable[..., AbstractFilter] = make  # called by names of its parameters, two of which are taken out

        def make_for(typical: AnySensor) -> AbstractFilter:
            """Make the filter of this sensor and of all other arguments."""
            return make_any(plant=plant, sensor=typical, **given)

        return cast(F, build_filter_of_inputs(plant, sensor, given.get("channel"), make_for))

    return build_with_inputs


def accept_told_numbers(make: Callable[P, F]) -> Callable[P, F]:
    """Decorate a function that makes a filter, so that it accepts channels that report numbers with each message.

    Such numbers ("told" numbers, channel side information), as the present gain or noise variance, are components of
    z. The decorated function then makes a `ToldFilter`, which reads the numbers and corrects by a filter of the law
    that they give. Behind any other channel the function is unchanged.

    Args:
        make: a function of a plant, a sensor, a channel, and more.
    """
    parameters = inspect.signature(make)

    @wraps(make)
    def build_with_told_numbers(*args: P.args, **kwargs: P.kwargs) -> F:
        """Make the filter, wrapped in a `ToldFilter` if the channel reports numbers, such as its gain, with each z.

        `make` is the function that makes the filter, and `parameters` its signature.
        """
        arguments = parameters.bind(*args, **kwargs).arguments
        # Does the channel report numbers? An argument that is no channel reports nothing, and `make` refuses it.
        channel = arguments.get("channel")
        is_channel = isinstance(first(channel), AbstractRandomAffine)
        reports_numbers = is_channel and len(separate_told_numbers(first(channel)).numbers) > 0
        if not reports_numbers:
            return make(*args, **kwargs)
        from heliograph.filters.wrappers.told_link_law import FilterMaker, build_told_filter

        # `make` is called later, with the channel of the law that the numbers give.
        plant, sensor, link = (arguments.pop(name) for name in ("plant", "sensor", "channel"))
        return cast(F, build_told_filter(plant, sensor, link, FilterMaker(make, arguments)))

    return build_with_told_numbers
