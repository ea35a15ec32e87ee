"""Unscented transform and the filter that it makes: sigma points of Merwe and of Julier."""

import jax.numpy as jnp

from heliograph.factors.covariance_factors import WeightedColumns
from heliograph.factors.factored_gaussian import Gaussian, Image, image_by_slopes
from heliograph.factors.pivots import square_root
from heliograph.filters.gaussian.factories import gaussian_filter
from heliograph.filters.gaussian.gaussian import GaussianFilter
from heliograph.filters.gaussian.moment_transforms import AbstractTransform, Function, evaluate_beside_mean
from heliograph.filters.gaussian.moments_for_derivatives import find_odd_and_even_parts
from heliograph.filters.gaussian.uncertain_channel_updates import AbstractUpdate
from heliograph.filters.wrappers.accepted_models import accept_limits
from heliograph.model.channel import Channel
from heliograph.model.over_time import first
from heliograph.model.plant import AnyPlant, read_first_plant
from heliograph.model.sensor import AnySensor
from heliograph.numerics.check import TINY, fail, scalar
from heliograph.numerics.numpy_or_jax import is_traced
from heliograph.numerics.trace_settings import writes_for_derivatives
from heliograph.numerics.types import ArrayLike, Float, Scalar

ROUNDING = 1e-12  # relative, of a condition on parameters that holds with equality


class Unscented(AbstractTransform):
    """Scaled unscented transform: the mean m and 2 n points m +- sqrt(c) L e_j, with c = alpha^2 (n + kappa).

    With e_i = f(x_i) - f(m), each point weighted by 1 / (2 c), the weights sum to one and the sample moments are

        mean = f(m) + d,  covariance = sum_i e_i e_i' / (2 c) + (beta - alpha^2) d d',  d = sum_i e_i / (2 c),

    which, where alpha is small and the weight of m large and negative, loses no digits but those of f itself, whose
    rounding is divided by alpha^2. Merwe's points are these;
    Julier's are those with alpha = 1 and beta = 0, and `Cubature` has kappa = 0 besides. The covariance is positive
    semidefinite for every f where alpha^2 kappa + beta n >= 0 (by Cauchy and Schwarz, d d' is at most n / c times the
    sum), and indefinite for some f elsewhere.

    Args:
        alpha: spread of the points, above 0.
        beta: weight of the mean's curvature, 2 for a Gaussian state.
        kappa: second spread, above -n.

    Raises:
        ValueError: an alpha that is not positive, or (when applied) points without a spread or an indefinite
            covariance.

    Source: Wan and van der Merwe, The unscented Kalman filter (2001), equation (7.30); Julier and Uhlmann, Unscented
        filtering and nonlinear estimation (2004).
    """

    alpha: Scalar
    beta: Scalar
    kappa: Scalar

    def __init__(self, alpha: Scalar = 1.0, beta: Scalar = 2.0, kappa: Scalar = 0.0):
        """Hold the scaling parameters alpha, beta and kappa of the unscented transform."""
        self.alpha, self.beta = scalar("alpha", alpha, low=TINY), scalar("beta", beta)
        self.kappa = scalar("kappa", kappa)

    def check(self, n: int) -> None:
        """Raise ValueError if n states have no such sigma points, or if a covariance by them may be indefinite.

        The sigma points have the parameters alpha, beta and kappa. They exist if n + kappa > 0. No covariance is
        indefinite if alpha^2 kappa + beta n >= 0, which may fail by the rounding ROUNDING, 1e-12.
        """
        if is_traced(self.alpha, self.beta, self.kappa):
            return
        alpha, beta, kappa = float(self.alpha), float(self.beta), float(self.kappa)
        if n + kappa <= 0:
            raise fail("kappa", f"more than {-n} for {n} states", kappa)
        sum_of_terms = alpha**2 * abs(kappa) + abs(beta) * n
        if alpha**2 * kappa + beta * n < -ROUNDING * sum_of_terms:
            smallest_kappa = 0.0 - beta * n / alpha**2
            raise fail(
                "kappa", f"at least {smallest_kappa:g} for {n} states, so that no covariance is indefinite", kappa
            )

    def image(self, function: Function, x: Gaussian) -> Image:
        """Return the moments of f(x) from its values at the mean and the 2 n points.

        With a_j and b_j what is odd and even in xi_j at m +- sqrt(c d_j) L_j, b the mean of all b_j: slopes a_j, and
        sum_j (b_j - b)(b_j - b)' / c + (alpha^2 kappa / n + beta) d d', d = n b / c, which is a sum of squares.
        """
        n = x.mean.shape[0]
        self.check(n)
        alpha, beta, kappa = (jnp.asarray(number) for number in (self.alpha, self.beta, self.kappa))
        scale = alpha**2 * (n + kappa)
        weights = jnp.full(n, 1 / (4 * scale))
        with_shift = jnp.append(weights, alpha**2 * kappa / n + beta)
        if writes_for_derivatives():
            parts = find_odd_and_even_parts(function, x, scale)
            middle = jnp.sum(parts.even, axis=1) * (1 / n)
            shift = middle * (n / (2 * scale))
            columns = jnp.concatenate([parts.even - middle[:, None], shift[:, None]], axis=1)
            return image_by_slopes(parts.here + shift, parts.slopes, x, WeightedColumns(columns, with_shift))
        steps, here = square_root(scale * x.variances), function(x.mean)
        ahead, behind = (values - here[:, None] for values in evaluate_beside_mean(function, x, steps))
        # Sums and differences are twice a_j and b_j.
        even = ahead + behind
        middle = jnp.sum(even, axis=1) * (1 / n)
        shift = middle * (n / (2 * scale))
        curvature = WeightedColumns(jnp.concatenate([even - middle[:, None], shift[:, None]], axis=1), with_shift)
        return Image(here + shift, WeightedColumns(ahead - behind, weights), 2 * steps, curvature)


@accept_limits
def unscented_filter(
    plant: AnyPlant,
    sensor: AnySensor,
    channel: "Channel|None" = None,
    alpha: float = 1,
    beta: float = 2,
    kappa: float = 0,
    update: "AbstractUpdate|None" = None,
    initial_mean: "Float[ArrayLike, ' n'] | None" = None,
    initial_covariance: "Float[ArrayLike, 'n n'] | None" = None,
) -> "GaussianFilter":
    """Return the unscented Kalman filter (UKF) on its channel's second moments; points are redrawn after predictions.

    By default the points are those of `cubature_filter`, sqrt(n) deviations from the mean, and so are the means; the
    covariance has Merwe's beta = 2 besides, by which that of a quadratic function of one Gaussian number is exact, so
    that a step is never surer of itself than cubature's. Julier's points are alpha = 1, beta = 0.

    Other packages take alpha = 0.001. For quadratic functions of one number alpha changes nothing, as the variance is
    4 m^2 P + (alpha^2 kappa + beta) P^2. For all others such points make a second derivative at the mean, which says
    nothing of what lies a deviation away, and divide the difference of values so near each other by alpha^2: of the
    digits of f, six are lost.

    Args:
        plant: the plant, n states.
        sensor: its sensor, m outputs.
        channel: from the sensor to the filter; by default all arrives as it is. The memory of a channel is ignored.
        alpha: spread of the points, above 0 (default 1).
        beta: weight of the mean's curvature, 2 for a Gaussian state (default 2).
        kappa: second spread; alpha^2 kappa + beta n may not be negative (default 0).
        update: how an uncertain channel is bounded; `Polytope()` by default.
        initial_mean: mean (n,) of the first state; the plant's by default.
        initial_covariance: its covariance (n, n); the plant's by default.

    Claim: as `cubature_filter`.

    Raises:
        ValueError: parameters whose covariance may be indefinite; sensor, channel and plant that do not fit, or an
            initial covariance that is none.

    Source: Wan and van der Merwe, The unscented Kalman filter (2001).
    """
    transform = Unscented(scalar("alpha", alpha), scalar("beta", beta), scalar("kappa", kappa))
    read_first_plant(plant)
    transform.check(len(first(plant).states))
    return gaussian_filter(plant, sensor, channel, transform, update, initial_mean, initial_covariance)
