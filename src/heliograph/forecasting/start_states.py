"""Where forecasts start: states and time of a result or live object, or of several of one model side by side."""

from collections.abc import Sequence
from dataclasses import replace
from typing import TypeAlias

import jax
import numpy as np

from heliograph.model.estimate import Estimate
from heliograph.model.forecast_origin import HasOrigin, Origin
from heliograph.numerics.check import fail
from heliograph.numerics.types import PyTree

Sources: TypeAlias = HasOrigin | Sequence[HasOrigin]


def find_origin(source: object) -> Origin:
    """Return where a forecast from a result or live object starts: its states, and the time of its last row.

    Raises:
        ValueError: something without an origin, or a record without its filters' states.
    """
    origin = getattr(source, "origin", None)
    if not isinstance(origin, Origin):
        got = type(source).__name__
        if hasattr(source, "origin"):
            got = f"a {got} without states, as files and simulations have"
        raise fail("forecast", "a result of filter.run or hg.run, a Stream or a Timeline", got)
    return origin


def find_common_origin(source: Sources) -> Origin:
    """Return where a forecast starts; a list of sources gives one origin with an axis over the sources.

    `source`: a result or a live object, or a list of these.

    Raises:
        ValueError: what `find_origin` refuses, an empty list, sources of other models or other steps.
    """
    if not isinstance(source, list | tuple) or hasattr(source, "origin"):
        return find_origin(source)
    if not source:
        raise fail("forecast", "at least one source", "an empty list")
    return _stack_origins([find_origin(one) for one in source])


def _stack_origins(origins: list[Origin]) -> Origin:
    """Return the origins of several sources of one model as one, whose arrays lead with an axis over the sources.

    Raises:
        ValueError: another model than the first, steps of another size.
    """
    head = origins[0]
    for number, origin in enumerate(origins):
        _check_like_first(f"forecast, source {number}", head, origin)
    estimates = {
        node: {name: _stack_estimates([origin.estimates[node][name] for origin in origins]) for name in filters}
        for node, filters in head.estimates.items()
    }
    return replace(
        head,
        state=_stack_trees([origin.state for origin in origins]),
        step=np.array([origin.step for origin in origins]),
        inputs=np.stack([origin.inputs for origin in origins]),
        time=np.array([origin.time for origin in origins]),
        estimates=estimates,
        several=True,
    )


def _check_like_first(name: str, head: Origin, origin: Origin) -> None:
    """Raise ValueError unless an origin has the model, the steps and the kind of times of the first origin, `head`.

    Args:
        name: name of the source, for messages.
        head: origin of the first source.
        origin: origin of this source.
    """
    if origin.model is not head.model:
        raise fail(name, "the filter or network of the source before it", "another one")
    if not np.array_equal([head.spacing, head.months], [origin.spacing, origin.months], equal_nan=True):
        raise fail(name, f"steps of {head.spacing:g}, as of the source before it", f"{origin.spacing:g}")
    if isinstance(origin.time, np.datetime64) != isinstance(head.time, np.datetime64):
        raise fail(name, "times as those of the source before it: dates, or numbers", str(origin.time))


def _stack_trees(trees: list[PyTree]) -> PyTree:
    """Return trees of arrays of one structure as one tree, whose arrays have a leading axis over the trees."""
    return jax.tree.map(lambda *leaves: np.stack([np.asarray(leaf) for leaf in leaves]), *trees)


def _stack_estimates(estimates: list[Estimate]) -> Estimate:
    """Return estimates of single plants as one estimate of several, with a leading axis over the plants.

    An estimate has one claim of its covariances ("exact", "upper", "nominal" or "none"): that of the first plant that
    claims anything. Covariances of plants with another claim are NaN.
    """
    model = next((estimate for estimate in estimates if estimate.claim != "none"), estimates[0])
    unknown = np.full(np.shape(model.covariance), np.nan)
    covariances = [
        np.asarray(estimate.covariance) if estimate.claim == model.claim else unknown for estimate in estimates
    ]
    means = np.stack([np.asarray(estimate.mean) for estimate in estimates])
    return Estimate(means, np.stack(covariances), model.claim, attitude=model.attitude)
