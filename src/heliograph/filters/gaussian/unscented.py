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

    In this form a small alpha, which makes the weight of m large and negative, costs no digits but those of f itself,
    whose rounding is divided by alpha^2. These are Merwe's points. Julier's have alpha = 1 and beta = 0, and those of
    `Cubature` kappa = 0 besides. The covariance is positive semidefinite for every f if alpha^2 kappa + beta n >= 0 (by
    Cauchy and Schwarz, d d' is at most n / c times the sum), and else indefinite for some f.

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
        """Return the moments of f(x) from its values at the mean and the 2 n sigma points.

        The state is x = m + L xi with Var xi_j = v_j, and the points are m +- h_j L_j with h_j = sqrt(c v_j) and
        c = alpha^2 (n + kappa). Let f_j+ and f_j- be the values of f there, less f(m); a_j = (f_j+ - f_j-) / 2 is the
        odd part in xi_j, b_j = (f_j+ + f_j-) / 2 the even one, and b the mean of all b_j. The unscented transform, with
        weights 1 / (2 c) of the points, becomes

            mean = f(m) + s,  s = sum_j b_j / c = n b / c,
            covariance = sum_j a_j a_j' / c + sum_j (b_j - b)(b_j - b)' / c + (alpha^2 kappa / n + beta) s s',

        a sum of squares, since sum_j b_j b_j' / c = sum_j (b_j - b)(b_j - b)' / c + (c / n) s s'. It is returned as
        weighted columns W diag(w) W': in `explained` the a_j, which are correlated with x, in `curvature` the rest.
        """
        n = x.mean.shape[0]
        self.check(n)
        alpha, beta, kappa = jnp.asarray(self.alpha), jnp.asarray(self.beta), jnp.asarray(self.kappa)
        c = alpha**2 * (n + kappa)
        weights = jnp.full(n, 1 / (4 * c))
        weights_with_shift = jnp.append(weights, alpha**2 * kappa / n + beta)
        # The same moments in a form whose derivatives JAX can take where a variance v_j is 0.
        if writes_for_derivatives():
            parts = find_odd_and_even_parts(function, x, c)
            mean_even = jnp.sum(parts.even, axis=1) * (1 / n)
            shift = mean_even * (n / (2 * c))
            columns = jnp.concatenate([parts.even - mean_even[:, None], shift[:, None]], axis=1)
            return image_by_slopes(parts.here + shift, parts.slopes, x, WeightedColumns(columns, weights_with_shift))
        steps, value_at_mean = square_root(c * x.variances), function(x.mean)  # h_j and f(m)
        plus, minus = (values - value_at_mean[:, None] for values in evaluate_beside_mean(function, x, steps))
        # Columns 2 b_j and 2 a_j, so that their weights are 1 / (4 c); xi_j changes by 2 h_j along 2 a_j.
        twice_even, twice_odd = plus + minus, plus - minus
        twice_mean_even = jnp.sum(twice_even, axis=1) * (1 / n)
        shift = twice_mean_even * (n / (2 * c))  # s
        curvature = WeightedColumns(
            matrix=jnp.concatenate([twice_even - twice_mean_even[:, None], shift[:, None]], axis=1),
            weights=weights_with_shift,
        )
        explained = WeightedColumns(twice_odd, weights)
        return Image(value_at_mean + shift, explained, unit=2 * steps, curvature=curvature)


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

    By default the points, sqrt(n) deviations from the mean, are those of `cubature_filter`, and give the same means.
    Merwe's beta = 2 adds a term to the covariance, which makes it exact for a quadratic function of one Gaussian
    number, and never smaller than cubature's. Julier's points are alpha = 1, beta = 0.

    Other packages take alpha = 0.001. For a quadratic function of one number alpha changes nothing if kappa = 0: the
    variance of x^2 is 4 m^2 P + (alpha^2 kappa + beta) P^2. For all other functions such points only find the second
    derivative at the mean, not the function a deviation away. They divide the difference of nearly equal values by
    alpha^2, which costs six digits of f.

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
