"""Filters whose state is a Gaussian: initial law, prediction and estimate, and the filter without measurements."""

from functools import reduce
from typing import Protocol

import jax
import jax.numpy as jnp

from heliograph.factors.covariance_factors import WeightedColumns, columns_of, join_columns, rounding_of, triangularise
from heliograph.factors.factored_gaussian import (
    Gaussian,
    Image,
    add_noise_to_image,
    from_covariance,
    predict_affine,
    sum_unexplained,
)
from heliograph.factors.gaussian_on_group import settle
from heliograph.filters.base import (
    AbstractSizedFilter,
    FilterAngles,
    Step,
    corrects,
    estimates,
    make_sizes,
    predicts,
)
from heliograph.filters.gaussian.moment_transforms import AbstractTransform, Cubature, linear_image
from heliograph.filters.innovation import no_innovation
from heliograph.filters.smoother_step import SmootherStep, StepTrace, gaussian_of, smoother_step_of
from heliograph.filters.wrappers.accepted_models import accept_limits
from heliograph.model.assumed.assumed_model import believes
from heliograph.model.diffuse_start import UnknownStart
from heliograph.model.estimate import Claim, Estimate, Innovation, lower_claim_by_noise
from heliograph.model.markov_jump_models import ModalPlant
from heliograph.model.over_time import at, first
from heliograph.model.plant import AbstractPlant, AnyPlant, LinearPlant, read_first_plant
from heliograph.numerics.angles.angle import Angles, wrap_angles
from heliograph.numerics.check import array, covariance
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.linalg import diagonal
from heliograph.numerics.trace_settings import keep_for_derivatives
from heliograph.numerics.types import Array, ArrayLike, Float
from heliograph.random_affine.noises.noise import AbstractNoise

MEAN_STEPS = 4  # to the mean of attitudes: of a deviation of 0.3 rad some 1e-9 are left


class AbstractGaussianStateFilter(AbstractSizedFilter):
    """A filter whose state is a Gaussian, predicted by a transform, or exactly where the plant is linear.

    Shapes: initial_mean (n,), initial_covariance (n, n).
    """

    plant: AnyPlant
    transform: AbstractTransform
    initial_mean: Array
    initial_covariance: Array

    def angles_used(self) -> FilterAngles:
        """Return the indices of states that are angles; z is taken to have none here."""
        return FilterAngles(first(self.plant).angles, ())

    @in_float64
    def init(self) -> Gaussian:
        """Return the Gaussian of x before any data: mean, and factors L diag(d) L' of the covariance."""
        return from_covariance(self.initial_mean, self.initial_covariance)

    @predicts
    def predict(self, state: Gaussian, u: ArrayLike = (), k: Step = 0) -> Gaussian:
        """Return the Gaussian of f(x, u) + w, with the moments of f by the filter's transform.

        E[x_i^2] at the start gives the size of the numbers that are rounded: their rounding is added to Cov w.
        """
        initial_power = second_moments_at_start(self.plant, self)
        return predict_gaussian(at(self.plant, k), self.transform, state, jnp.asarray(u), initial_power)

    @estimates
    def estimate(self, state: Gaussian) -> Estimate:
        """Return the mean and covariance of x given the data, with angles between -pi and pi."""
        mean = wrap_angles(state.mean, first(self.plant).angles)
        return Estimate(mean, state.covariance, self.claim, attitude=self.attitude)

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return what a Rauch-Tung-Striebel pass needs of a step: x after the update, and x before it given x+."""
        return smoother_step_by_transform(self, step, self)


class HasInitialMoments(Protocol):
    """What has a law of the first state: a plant, or a filter that starts from another law."""

    initial_mean: Array
    initial_covariance: Array


def second_moments_at_start(plant: AnyPlant, start: HasInitialMoments | None = None) -> Float[jax.Array, " n"]:
    """Return E[x_i^2] at the start plus Var w_i of a step, (n,), the size of the numbers that are rounded.

    `start` gives the law of the first state, by default the plant does. Of a law that is partly unknown only the known
    part counts. A noise that depends on inputs is left out here: it is counted where it is added.
    """
    first_step = at(plant, k=0)
    if isinstance(first_step, ModalPlant):  # the largest of the models
        return reduce(jnp.maximum, [second_moments_at_start(model, start) for model in first_step.models])
    start = first_step if start is None else start
    mean = jnp.asarray(start.initial_mean)
    initial_covariance = start.initial_covariance
    known_covariance = initial_covariance.known if isinstance(initial_covariance, UnknownStart) else initial_covariance
    second_moments = mean * mean + diagonal(known_covariance)
    if isinstance(first_step.noise, AbstractNoise):
        second_moments = second_moments + diagonal(first_step.noise.covariance)
    return jnp.asarray(second_moments)


def factor_process_noise(plant: AbstractPlant, u: jax.Array, initial_power: jax.Array) -> WeightedColumns:
    """Return factors L diag(d) L' of Cov w, to which the covariance of the state's rounding is added.

    A number of second moment s has a rounding with the variance of some eps^2 s; s is `initial_power` (n,), E[x_i^2] at
    the start, plus Var w_i. With it no covariance becomes singular by rounding.

    Args:
        plant: x+ = f(x, u) + w; Cov w may depend on u.
        u: input of the step.
        initial_power: E[x_i^2] before any data (n,).
    """
    noise = plant.noise.columns if isinstance(plant.noise, AbstractNoise) else columns_of(plant.noise_covariance(u))
    rounding = rounding_of(initial_power + diagonal(plant.noise_covariance(u)))
    joined = join_columns(noise, rounding)
    factors: WeightedColumns = keep_for_derivatives(triangularise(joined))
    return factors


def find_transition_moments(plant: AbstractPlant, transform: AbstractTransform, x: Gaussian, u: jax.Array) -> Image:
    """Return the moments of f(x, u), exactly where it is linear, else by the transform.

    An `Image` holds the mean of f, its slopes S in xi of x = m + L xi, and columns of the covariance of the rest,
    f - E f - S xi.
    """
    if isinstance(plant, LinearPlant):
        return linear_image(plant.transition_matrix(u), plant.transition(x.mean, u), x)
    _, image = transform_about_mean(plant, transform, x, u)
    return image


def predict_gaussian(
    plant: AbstractPlant, transform: AbstractTransform, x: Gaussian, u: jax.Array, initial_power: jax.Array
) -> Gaussian:
    """Return the Gaussian of f(x, u) + w from that of x.

    `initial_power` (n,) is E[x_i^2] before any data, the size of the numbers that are rounded. Where states are
    attitudes, the transform's moments are those of f = middle + change; `settle` makes of them a mean on the group of
    rotations, and a covariance of changes from it. Elsewhere `settle` returns its argument.
    """
    noise = factor_process_noise(plant, u, initial_power)
    if isinstance(plant, LinearPlant):
        return predict_affine(x, plant.transition_matrix(u), plant.shift(u), noise)
    middle, image = transform_about_mean(plant, transform, x, u)
    image = image._replace(mean=image.mean + plant.noise_mean())
    return settle(plant.manifold, middle, add_noise_to_image(image, noise))


def transform_about_mean(
    plant: AbstractPlant, transform: AbstractTransform, x: Gaussian, u: jax.Array
) -> tuple[jax.Array, Image]:
    """Return the state about which the moments of f(x, u) are taken, and these moments.

    Without attitudes the state is the mean of x. With attitudes it is their mean, from which changes have the mean 0.
    The search for it begins at middle_0 = f(mean of x, u), and middle_(i+1) = middle_i plus the mean change from
    middle_i. Each of MEAN_STEPS (4) steps multiplies the error by about the square of the attitudes' deviation.
    """
    # A transform that keeps the centre has no mean change, and stays at f(mean of x, u).
    middle = jnp.asarray(plant.transition(x.mean, u)) if plant.attitude else x.mean
    image = transform.image(plant.make_motion_about(u, x.mean, middle), x)
    for _ in range(MEAN_STEPS if plant.attitude and not transform.keeps_center else 0):
        middle = plant.manifold.settle(middle, image.mean)
        image = transform.image(plant.make_motion_about(u, x.mean, middle), x)
    return middle, image


class PredictsByTransform(Protocol):
    """A filter that predicts its plant by a transform."""

    plant: AnyPlant
    transform: AbstractTransform
    claim: Claim


def smoother_step_by_transform(filter: PredictsByTransform, step: StepTrace, start: HasInitialMoments) -> SmootherStep:
    """Return the smoother step of x+ = f(x, u) + w, with the moments of f by the filter's transform.

    The backward pass regresses x on x+ = E f + S xi + rest for x = m + L xi: it needs the slopes S, and columns of the
    covariance of the rest (`unexplained`), the curvature of f and w.

    Args:
        filter: with plant, transform and claim.
        step: the states before the step, after its prediction and after its update, with u and k.
        start: plant or filter whose initial law gives the size of the numbers that are rounded.
    """
    plant, u = at(filter.plant, step.k), jnp.asarray(step.u)
    image = find_transition_moments(plant, filter.transform, gaussian_of(step.before), u)
    noise = factor_process_noise(plant, u, second_moments_at_start(filter.plant, start))
    unexplained = sum_unexplained(image, noise)
    return smoother_step_of(step, (image.slopes, unexplained), filter.claim, plant.manifold)


def choose_initial_moments(
    plant: AbstractPlant, initial_mean: ArrayLike | None, initial_covariance: ArrayLike | None
) -> tuple[Array, Array, bool]:
    """Return the initial mean (n,) and covariance (n, n), and whether the user gave one of them.

    Where the user gave None, it is the plant's.
    """
    n = len(plant.states)
    mean = plant.initial_mean if initial_mean is None else array("filter's initial mean", initial_mean, (n,))
    initial = plant.initial_covariance
    if initial_covariance is not None:
        initial = covariance("filter's initial covariance", initial_covariance, n)
    is_given = initial_mean is not None or initial_covariance is not None
    return mean, initial, is_given


class OpenLoop(AbstractGaussianStateFilter):
    """Prediction without measurements: the baseline for any use of them."""

    @property
    def attitude(self) -> Angles:
        """Return the indices of states that are attitudes (rotations), so that the estimate reports them as such."""
        indices: Angles = first(self.plant).manifold.rotations
        return indices

    @corrects
    def correct(self, state: Gaussian, z: ArrayLike, k: Step = 0) -> tuple[Gaussian, Innovation]:
        """Return the predicted state as it is, and no innovation: this filter uses no measurement z."""
        return state, no_innovation()


@accept_limits
@believes
def open_loop_filter(
    plant: AnyPlant,
    initial_mean: Float[ArrayLike, " n"] | None = None,
    initial_covariance: Float[ArrayLike, "n n"] | None = None,
) -> OpenLoop:
    """Return the prediction by cubature points without any measurement.

    Args:
        plant: the plant, n states.
        initial_mean: mean (n,) of the first state; the plant's by default.
        initial_covariance: its covariance (n, n); the plant's by default.

    Claim: "exact" for a linear plant started from its initial law ("upper" where noise is known by bounds), else
        "nominal".

    Raises:
        ValueError: an initial mean or covariance of the wrong shape.

    Source: the prediction step of any of the filters, alone.
    """
    start = read_first_plant(plant)
    mean, covariance, prior_given = choose_initial_moments(start, initial_mean, initial_covariance)
    linear = isinstance(start, LinearPlant) and not prior_given and not start.circular
    claim = lower_claim_by_noise("exact" if linear else "nominal", plant)
    return OpenLoop(
        plant=plant,
        transform=Cubature(),
        initial_mean=mean,
        initial_covariance=covariance,
        **make_sizes(claim, start, 0),
    )
