"""Polynomial filters: a linear filter of the monomials of the measurement, or of its products with an estimate."""

from dataclasses import replace
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

from heliograph.filters.base import AbstractFilter, AbstractSizedFilter, Step, corrects, estimates, predicts
from heliograph.filters.linear.scheduled_gains import LinearSystemFilter, ScheduledFilter
from heliograph.filters.linear.unconditional_mean import UnconditionalMean, centre_plant, find_unconditional_mean
from heliograph.filters.modes.jump_linear_filter import claim_of_modes
from heliograph.filters.smoother_step import SmootherStep, StepTrace
from heliograph.linear.lmmse_recursion import lmmse
from heliograph.linear.monomial_lifted_system import lifted_system
from heliograph.linear.plant_and_measurement_maps import check_model
from heliograph.linear.system import LinearSystem
from heliograph.model.assumed.assumed_model import AssumedModel, with_assumed
from heliograph.model.channel import Channel
from heliograph.model.estimate import Claim, Estimate, Innovation, lower_claim_by_noise
from heliograph.model.fading import uncertain_chain
from heliograph.model.over_time import at, first, steps_covered, unstack
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor
from heliograph.numerics.check import check_count, fail, instance
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.gaussian_density import log_density
from heliograph.numerics.numpy_or_jax import library
from heliograph.numerics.types import Array, ArrayLike, Float, PyTree
from heliograph.random_affine.moments.monomials import count_monomials, evaluate_monomials, position
from heliograph.random_affine.noises.outlier_noise import has_bounded_noise


class CentredState(NamedTuple):
    """State of the inner filter, which estimates x - E[x], and the unconditional mean E[x] (n,)."""

    inner: PyTree
    mean: Float[Array, " n"]


class PolynomialFilter(AbstractSizedFilter):
    """Filter of all monomials of z up to `degree`; a missing component makes each of its monomials missing.

    The innovation is that of z itself, among its monomials, with its exact covariance; the log-likelihood is Gaussian
    with it.

    Args:
        inner: a `LinearSystemFilter` or a `ScheduledFilter` of the lifted system.
        degree: of the monomials.
        endless: whether the last step's matrices hold for all later steps; False by default.
        centre: recursion of the unconditional mean E[x] for an inner filter of x - E[x]: E[z] is subtracted from z, and
            E[x] added to the estimate. None, the default, if the inner filter is of x itself.

    Raises:
        ValueError: an inner filter whose measurement is no such vector of monomials.
    """

    inner: AbstractFilter
    centre: UnconditionalMean | None
    degree: int = eqx.field(static=True)
    endless: bool = eqx.field(static=True)

    def __init__(
        self, inner: AbstractFilter, degree: int, endless: bool = False, centre: UnconditionalMean | None = None
    ):
        """Wrap `inner`, a filter whose measurement is the vector of monomials of z up to `degree`.

        `endless`: the inner filter's last matrices hold for all later steps. `centre`: recursion of the unconditional
        mean, which is subtracted before the inner filter; None if nothing is. The inner filter's claim (what its
        covariance is said to be: exact, upper bound or nominal) and the models it was made for are taken over.
        """
        instance("inner filter", inner, AbstractFilter, "a filter")
        check_count("degree of the filter", degree)
        self.inner, self.degree, self.endless, self.claim = inner, degree, endless, inner.claim
        self.centre, self.kept = centre, inner.kept
        self.states, self.inputs = inner.states, inner.inputs
        # The number m of received numbers, found by the number of their monomials without the constant.
        fitting = [m for m in range(1, inner.received + 1) if count_monomials(m + 1, degree) == inner.received + 1]
        if not fitting:
            raise fail(
                "inner filter", f"one that receives monomials up to degree {degree}", f"{inner.received} numbers"
            )
        self.received = fitting[0]

    @property
    def horizon(self) -> int | None:
        """Horizon of the inner filter; None where its last matrices hold for all later steps."""
        return None if self.endless else self.inner.horizon

    @in_float64
    def init(self) -> PyTree:
        """Return the initial state of the inner filter, which estimates x - E[x], and E[x_0]."""
        return CentredState(self.inner.init(), initial_mean(self.centre, len(self.states)))

    @predicts
    def predict(self, state: CentredState, u: ArrayLike = (), k: Step = 0) -> CentredState:
        """Predict x - E[x] by the inner filter, and the mean E[x], which is known before any data."""
        return CentredState(self.inner.predict(state.inner, u, k), predict_mean(self.centre, state.mean, k))

    @corrects
    def correct(self, state: CentredState, z: ArrayLike, k: Step = 0) -> tuple[CentredState, Innovation]:
        """Correct the inner filter, whose measurement is all monomials of z (or z - E[z]) up to `degree`.

        E[z] is subtracted where the inner filter is of x - E[x]. The innovation that is returned is that of z itself.
        """
        z = subtract_mean(self.centre, z, state.mean, k)
        monomials = evaluate_monomials(z, self.degree)[:-1]  # without the constant
        after, innovation = self.inner.correct(state.inner, monomials, k)
        return CentredState(after, state.mean), select_degree_one(innovation, z, self.degree)

    @estimates
    def estimate(self, state: CentredState) -> Estimate:
        """Return the estimate of x: that of x - E[x] by the inner filter, plus E[x]."""
        return add_mean(self.inner.estimate(state.inner), state.mean)

    def after_step(self, state: CentredState, k: Step) -> Estimate:
        """Return the estimate of x after step k: that of x - E[x] by the inner filter, plus E[x]."""
        return add_mean(self.inner.after_step(state.inner, k), state.mean)

    def smoother_step(self, step: StepTrace) -> SmootherStep:
        """Return the smoother step of the inner filter, whose state are monomials of x - E[x], with E[x] as offset.

        The inner filter measures the monomials of z - E[z], so they replace z in the trace of its step. The smoother
        step's projection picks x - E[x] among the monomials, and `offset` adds E[x].
        """
        z = subtract_mean(self.centre, step.z, step.prior.mean, step.k)
        monomials = evaluate_monomials(z, self.degree)[:-1]  # without the constant
        inner_step = step.map_states(lambda state: state.inner)._replace(z=monomials)
        return replace(self.inner.smoother_step(inner_step), offset=jnp.asarray(step.after.mean))

    def planned(self, inputs: Float[Array, "horizon inputs"]) -> AbstractFilter:
        """Return the same filter with the inner filter's gains and covariances computed in advance."""
        return PolynomialFilter(self.inner.planned(inputs), self.degree, self.endless, self.centre)

    def with_past(self, steps: SmootherStep) -> AbstractFilter:
        """Return the same filter, made able to smooth: its inner filter gets the smoother's gains of each step."""
        return PolynomialFilter(self.inner.with_past(steps), self.degree, self.endless, self.centre)


def initial_mean(centre: UnconditionalMean | None, n: int) -> jax.Array:
    """Return E[x_0] (n,), where the unconditional mean `centre` begins; zeros if `centre` is None."""
    start = np.zeros(n) if centre is None else centre.start
    mean: jax.Array = library(start).asarray(start)
    return mean


def predict_mean(centre: UnconditionalMean | None, mean: Array, k: Step) -> Array:
    """Return E[x+] = A E[x] + b over step k.

    `centre` has A and b of each step. If it is None, no mean is subtracted, and `mean` is returned as it is.
    """
    if centre is None:
        return mean
    step = at(centre, k)
    predicted: jax.Array = step.transition @ mean + step.drift
    return predicted


def subtract_mean(centre: UnconditionalMean | None, z: ArrayLike, mean: Array, k: Step) -> jax.Array:
    """Return z - E[z] = z - G C E[x] (m,), with E[x] = `mean` and the known gain G; z itself if `centre` is None.

    `centre.received` is G C at each step.
    """
    return jnp.asarray(z) if centre is None else jnp.asarray(z) - at(centre, k).received @ mean


def add_mean(estimate: Estimate, mean: Float[Array, " n"]) -> Estimate:
    """Return the estimate of x from one of x - E[x]: the mean E[x] (n,) is added, the covariance stays."""
    return Estimate(estimate.mean + mean, estimate.covariance, estimate.claim)


def select_degree_one(innovation: Innovation, z: Float[Array, " m"], degree: int) -> Innovation:
    """Return the innovation of z itself, selected from the innovation of all its monomials up to `degree`.

    Monomials up to `degree` of z (m,) are those of exactly that degree of (z, 1), each with m + 1 exponents.

    Args:
        innovation: of the vector of monomials.
        z: the measurement, whose size gives the rounding of the differences.
        degree: of the monomials.
    """
    # z_i is the monomial of exponent 1 in z_i and degree - 1 in the constant, the last factor.
    m, position_of = len(z), position(len(z) + 1, degree)
    exponents = [(*row, degree - 1) for row in np.eye(m, dtype=int).tolist()]
    indices = np.array([position_of[powers] for powers in exponents])
    value, covariance = innovation.value[indices], innovation.covariance[indices][:, indices]
    return Innovation(value, covariance, log_density(value, covariance, jnp.abs(z)))


def polynomial_filter(
    plant: AnyPlant, sensor: AnySensor, channel: Channel, horizon: int, degree: int = 2
) -> PolynomialFilter:
    """Return the best filter that is a polynomial of `degree` in each received z_k: 1 linear, 2 quadratic, 3 cubic.

    It takes linear plants and sensors behind any channel, and noises of any law with moments up to order 2 degree. The
    powers of state and measurement up to `degree` follow a linear system of their own (a lift), in which the best
    linear filter is the best polynomial one. It estimates the whole state, a bias with dynamics of its own included,
    and recomputes its covariance where z has gaps. For many complete runs `scheduled_polynomial_filter` does the same
    with saved gains. Behind a known gain moments are about the mean.

    Args:
        plant: a linear plant without inputs, n states.
        sensor: a linear sensor, m outputs.
        channel: from the sensor to the filter.
        horizon: number of steps; a stream may go on beyond them where nothing varies over time and the matrices have
            reached a steady state by then.
        degree: of the polynomial in z_k; 2 by default.

    Claim: "exact" where all laws are known. "nominal" where probabilities are uncertain (the nominal ones are used), or
    where noise is known by bounds (at degree 1: "upper"). "nominal" too, with a warning, where rounding is more than
    1e-6 of a claimed variance, as for states far from zero behind a random gain.

    Raises:
        ValueError: parts that do not fit, a plant with inputs, a lift of more than the stated memory.

    Source: quadratic filtering with dynamical bias, Theorems 1 and 2, as repaired for random powers.
    """
    # The linear system of the powers, about the state's mean or about 0; its filter; and around that the states alone.
    centre, system = lift_about_mean(plant, sensor, channel, degree, horizon)
    claim = lmmse(system, polynomial_claim(plant, sensor, channel, degree)).claim
    inner = LinearSystemFilter(system, claim, first(plant).states)
    filter = PolynomialFilter(inner, degree, endless=_is_steady(plant, sensor, channel, system), centre=centre)
    return with_assumed(filter, AssumedModel(plant, sensor, channel, order=2 * degree))


def lift_about_mean(
    plant: AnyPlant, sensor: AnySensor, channel: Channel, degree: int, horizon: int
) -> tuple[UnconditionalMean | None, LinearSystem]:
    """Return the linear system of all powers (monomials) of the state up to `degree`, and the mean that they are about.

    Powers of a linear system's state follow a linear system of their own. Where the channel's gain is known they are
    powers of x - E[x], so that a large mean costs no digits; the mean is None behind a random gain, or where it is 0.

    Args:
        plant: a linear plant.
        sensor: a linear sensor.
        channel: from the sensor to the filter.
        degree: of the powers.
        horizon: number of steps.
    """
    check_model(plant, sensor, channel)
    centre = find_unconditional_mean(plant, sensor, channel)
    centred_plant = plant if centre is None else centre_plant(plant)
    return centre, lifted_system(centred_plant, sensor, channel, degree, horizon)


def _is_steady(plant: AnyPlant, sensor: AnySensor, channel: Channel, system: LinearSystem) -> bool:
    """Return whether the matrices of a time-invariant model have reached a steady state, up to rounding.

    Then the filter may run beyond the horizon. `system.steps` holds an array (horizon, ...) of each matrix, of which
    the last two steps are compared. A model that varies over time is never steady (`steps_covered` is then the number
    of its steps, else None).
    """
    if steps_covered((plant, sensor, channel)) is not None or system.horizon < 2:
        return False
    return all(np.allclose(matrices[-1], matrices[-2], rtol=1e-12, atol=0) for matrices in system.steps)


def scheduled_polynomial_filter(
    plant: AnyPlant, sensor: AnySensor, channel: Channel, horizon: int, degree: int = 2
) -> PolynomialFilter:
    """Return the polynomial filter with saved gains: `polynomial_filter` for complete data, at a fraction of its cost.

    Args:
        plant: a linear plant without inputs, n states.
        sensor: a linear sensor, m outputs.
        channel: from the sensor to the filter.
        horizon: number of steps.
        degree: degree of the polynomial in z_k; 2 by default.

    Claim: as `polynomial_filter`.

    Raises:
        ValueError: what `polynomial_filter` refuses.

    Source: as `polynomial_filter`.
    """
    centre, system = lift_about_mean(plant, sensor, channel, degree, horizon)
    schedule = lmmse(system, polynomial_claim(plant, sensor, channel, degree))
    filter = PolynomialFilter(ScheduledFilter(schedule, first(plant).states), degree, centre=centre)
    return with_assumed(filter, AssumedModel(plant, sensor, channel, order=2 * degree))


def polynomial_claim(plant: AnyPlant, sensor: AnySensor, channel: Channel, degree: int) -> Claim:
    """Return "exact" if all laws are known, "nominal" if some probability is uncertain.

    Where a noise is known only by a bound of its covariance, the claim is "upper" at degree 1. At a higher degree it is
    "nominal", since higher moments have no bound.
    """
    if degree > 1 and has_bounded_noise(plant, sensor, channel):
        return "nominal"
    if first(channel).remembers:
        claim: Claim = "nominal" if uncertain_chain(channel) else claim_of_modes(channel)
    else:
        # `corner_count` is the number of extreme laws of uncertain probabilities, 1 if all probabilities are known.
        claim = "exact" if all(step.corner_count() == 1 for step in unstack(channel)) else "nominal"
    return lower_claim_by_noise(claim, plant, sensor, channel)
