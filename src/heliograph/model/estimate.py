"""An estimate and what its covariance claims to be; an innovation and how likely the filter finds it."""

from typing import Literal

import equinox as eqx

from heliograph.numerics.check import fail, items, shown
from heliograph.numerics.module import Module
from heliograph.numerics.readable import readable
from heliograph.numerics.types import Array, Float

Claim = Literal["exact", "upper", "nominal", "none"]
STRENGTH: dict[Claim, int] = {"none": -1, "nominal": 0, "upper": 1, "exact": 2}


@readable
class Estimate(Module):
    """An estimate and the covariance claimed for its error.

    claim: "exact" if `covariance` is E[(x - mean)(x - mean)'], "upper" if it dominates it, "nominal" if it is only what
    the filter's approximations say, "none" if no covariance is claimed: then `covariance` is NaN.

    Shapes: mean (..., n), covariance (..., n, n).
    """

    mean: Float[Array, "... n"]
    covariance: Float[Array, "... n n"]
    claim: Claim = eqx.field(static=True)


@readable
class Innovation(Module):
    """What a measurement says that the filter did not expect, and how likely the filter finds it.

    value: z - E[z | what came before]; covariance: what the filter believes of it. Both are NaN in the components that
    did not arrive. log_likelihood: log p(components that arrived | what came before) as the filter sees it, 0 when
    nothing arrived; a Gaussian one, log N(value; 0, covariance), unless the filter says otherwise. A filter that claims
    no covariance has none: then all but the value is NaN. weight: how much each component counted, from 0 (left out) to
    1 (in full), of a filter that weighs them; None of all others.

    Shapes: value and weight (..., m), covariance (..., m, m), log_likelihood (...).
    """

    value: Float[Array, "... m"]
    covariance: Float[Array, "... m m"]
    log_likelihood: Float[Array, "..."]
    weight: Float[Array, "... m"] | None = None


def weakest(claims: list[Claim]) -> Claim:
    """The strongest claim that all of `claims` support: of exact, upper, nominal and none the last among them.

    Raises:
        ValueError: no claims, or something else among them.
    """
    if not items("claims", claims, "claims"):
        raise fail("claims", "at least one", "none")
    for claim in claims:
        if not isinstance(claim, str) or claim not in STRENGTH:
            raise fail("claim", f"one of {', '.join(STRENGTH)}", shown(claim))
    return min(claims, key=STRENGTH.__getitem__)
