"""A filter that knows the full finite-support laws: every combination of gains and noises, then one Gaussian again."""

from collections.abc import Callable
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from scipy.linalg import block_diag

from heliograph.filters.base import AbstractFilter, Step, corrects, predicts
from heliograph.filters.gaussian import Belief
from heliograph.model.channel import Channel, check_link
from heliograph.model.estimate import Claim, Estimate, Innovation
from heliograph.model.over_time import OverTime, at, first, over_time, unstack
from heliograph.model.plant import AnyPlant
from heliograph.model.sensor import AnySensor, LinearSensor, is_linear
from heliograph.numerics.check import fail, scalar
from heliograph.numerics.float64 import in_float64
from heliograph.numerics.linalg import cholesky, psd_solve, symmetrize
from heliograph.numerics.types import ArrayLike
from heliograph.random_affine.atoms import GainAndNoise
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.combine import Mixture, Series, Stack
from heliograph.random_affine.law import AbstractLaw, Constant, Discrete
from heliograph.random_affine.noise import AbstractNoise, FiniteSupport, Gaussian, Independent, Shaped

COMPONENT_LIMIT = 4096  # combinations of atoms held for one step


class Component(NamedTuple):
    """One combination of atoms: with `weight`, z = gain x + offset + N(0, noise)."""

    weight: float
    gain: np.ndarray
    offset: np.ndarray
    noise: np.ndarray


class Components(eqx.Module):
    """All combinations of one step. Shapes: weight (a,), gain (a, m, n), offset (a, m), noise (a, m, m)."""

    weight: np.ndarray
    gain: np.ndarray
    offset: np.ndarray
    noise: np.ndarray


class MixtureFilter(AbstractFilter):
    """One Gaussian for the state; at each step every combination of the measurement's atoms, then moments matched.

    With z = G_a x + c_a + N(0, R_a) and probability p_a, the posterior is a mixture of as many Gaussians with weights
    p_a N(z; G_a m + c_a, G_a P G_a' + R_a); its mean and covariance are kept (GPB1). Nominal: after the first step the
    prior is not Gaussian, and process noise enters by its covariance only. The log-likelihood is that of the mixture,
    log sum_a p_a N(z; ...); the innovation's covariance is the mixture's too.

    Source: Ackerson and Fu, On state estimation in switching environments (1970), with random gains as modes.
    """

    plant: AnyPlant
    components: Components | OverTime
    claim: Claim = eqx.field(static=True)
    states: tuple[str, ...] = eqx.field(static=True)
    inputs: tuple[str, ...] = eqx.field(static=True)
    received: int = eqx.field(static=True)

    @in_float64
    def init(self) -> Belief:
        """The prior."""
        start = at(self.plant, 0)
        return Belief(jnp.asarray(start.initial_mean), jnp.asarray(start.initial_covariance))

    @predicts
    def predict(self, state: Belief, u: ArrayLike = (), k: Step = 0) -> Belief:
        """A m + B u + E w and A P A' + Q."""
        plant, u = at(self.plant, k), jnp.asarray(u)
        spread = plant.matrix @ state.covariance @ plant.matrix.T + plant.noise_covariance(u)
        return Belief(plant.transition(state.mean, u) + plant.noise_mean(), spread)

    @corrects
    def correct(self, state: Belief, z: ArrayLike, k: Step = 0) -> tuple[Belief, Innovation]:
        """Weigh the combinations by what arrived of z."""
        c, z, (mean, spread) = at(self.components, k), jnp.asarray(z), state
        present = ~jnp.isnan(z)
        both = present[:, None] & present

        def condition(gain: jax.Array, offset: jax.Array, noise: jax.Array) -> tuple[jax.Array, ...]:
            cross = jnp.where(present[:, None], gain @ spread, 0.0)
            total = jnp.where(both, gain @ spread @ gain.T + noise, 0.0) + jnp.diag(jnp.where(present, 0.0, 1.0))
            value = z - gain @ mean - offset
            heard = jnp.where(present, value, 0.0)
            solved = psd_solve(total, jnp.concatenate([cross, heard[:, None]], axis=1))
            likelihood = -heard @ solved[:, -1] / 2 - jnp.sum(jnp.log(jnp.diagonal(cholesky(total))))
            return likelihood, cross.T @ solved[:, -1], cross.T @ solved[:, :-1], value, total

        likelihood, moved, known, value, total = jax.vmap(condition)(c.gain, c.offset, c.noise)
        weighed = likelihood + jnp.log(c.weight)
        weight = jax.nn.softmax(weighed)
        shift = weight @ moved
        apart = moved - shift
        after = spread - jnp.einsum("a,aij->ij", weight, known) + jnp.einsum("a,ai,aj->ij", weight, apart, apart)
        density = jax.nn.logsumexp(weighed) - jnp.sum(present) * np.log(2 * np.pi) / 2
        heard = _mixed(jnp.asarray(c.weight), value, jnp.where(both, total, jnp.nan), density)
        return Belief(mean + shift, symmetrize(after)), heard

    @in_float64
    def estimate(self, state: Belief) -> Estimate:
        """The belief."""
        return Estimate(state.mean, state.covariance, self.claim)


def _mixed(weight: jax.Array, value: jax.Array, total: jax.Array, density: jax.Array) -> Innovation:
    """Mean and covariance of the innovation over the prior weights: those of the parts, and what is between them."""
    mean = weight @ value
    apart = value - mean
    covariance = jnp.einsum("a,aij->ij", weight, total) + jnp.einsum("a,ai,aj->ij", weight, apart, apart)
    return Innovation(mean, covariance, density)


def mixture_filter(plant: AnyPlant, sensor: AnySensor, channel: Channel, resolution: float = 0.0) -> MixtureFilter:
    """The near limit of what the measurements hold, for gains and noises of finitely many values.

    Gains may be constant or discrete, noises of finite support (used atom by atom) or Gaussian. `resolution` is a
    standard deviation added to z: needed where some combination of atoms leaves z without any randomness, as a link
    that is off does.

    Claim: "nominal".

    Raises:
        ValueError: a plant or sensor that is not linear, parts that do not fit, a law with no atoms, more than
            COMPONENT_LIMIT combinations, or a combination whose z is certain and no resolution.
    Source: Ackerson and Fu (1970), first-order generalised pseudo-Bayes.
    """
    if not is_linear(plant, sensor):
        got = f"{type(first(plant)).__name__} and {type(first(sensor)).__name__}"
        raise fail("mixture filter", "a LinearPlant and a LinearSensor", got)
    check_link(first(sensor), first(channel), len(first(plant).states))
    floor, start = float(scalar("resolution", resolution, 0.0, 1e100)) ** 2, first(plant)
    if not isinstance(sensor, OverTime) and not isinstance(channel, OverTime):
        components: Components | OverTime = _components(sensor, channel, floor)
    else:
        steps = min(item.steps for item in (sensor, channel) if isinstance(item, OverTime))
        sensors, channels = (unstack(i)[:steps] if isinstance(i, OverTime) else [i] * steps for i in (sensor, channel))
        components = over_time([_components(s, c, floor) for s, c in zip(sensors, channels, strict=True)])
    return MixtureFilter(
        plant=plant,
        components=components,
        claim="nominal",
        states=start.states,
        inputs=start.inputs,
        received=first(channel).outputs,
    )


def _components(sensor: AnySensor, channel: AbstractRandomAffine, floor: float) -> Components:
    assert isinstance(sensor, LinearSensor)  # checked before
    route = Series([GainAndNoise(Constant(1.0), sensor.matrix, sensor.noise), channel])
    found = [c for c in atoms_of(route) if c.weight > 0]
    weight, gain, offset, noise = (np.array(column) for column in zip(*found, strict=True))
    noise = noise + floor * np.eye(noise.shape[-1])
    for g, r in zip(gain, noise, strict=True):
        if np.linalg.matrix_rank(g @ g.T + r) < len(r):  # a positive definite P is all that would be left
            expected = "measurements that are random for every combination of atoms, or a resolution above 0"
            raise fail("mixture filter", expected, f"gain {g.tolist()} without Gaussian noise")
    return Components(weight, gain, offset, noise)


def atoms_of(item: AbstractRandomAffine) -> list[Component]:
    """All combinations of the atoms of a map's gains and noises.

    Raises:
        ValueError: a gain that is not discrete, a noise that is neither finite nor Gaussian, or a map of unknown kind;
            more than COMPONENT_LIMIT combinations.
    """
    match item:
        case GainAndNoise():
            gains, noises = _gain_atoms(item.law), _noise_atoms(item.noise)
            result = [Component(p * q, g * np.asarray(item.matrix), c, r) for p, g in gains for q, c, r in noises]
        case Series():
            result = atoms_of(item.maps[0])
            for part in item.maps[1:]:
                result = _combine(result, atoms_of(part), _after)
        case Stack():
            result = atoms_of(item.maps[0])
            for part in item.maps[1:]:
                result = _combine(result, atoms_of(part), _beside)
        case Mixture():
            weighted = zip(item.choice.probabilities, item.maps, strict=True)
            result = [c._replace(weight=p * c.weight) for p, part in weighted for c in atoms_of(part)]
        case _:
            raise fail("mixture filter", "maps made of hops, series, stacks and mixtures", type(item).__name__)
    return result


def _combine(
    a: list[Component], b: list[Component], join: Callable[[Component, Component], Component]
) -> list[Component]:
    if len(a) * len(b) > COMPONENT_LIMIT:
        raise fail("mixture filter", f"at most {COMPONENT_LIMIT:,} combinations of atoms", f"{len(a) * len(b):,}")
    return [join(x, y) for x in a for y in b]


def _after(x: Component, y: Component) -> Component:
    """y hears x: G_y (G_x s + c_x + n_x) + c_y + n_y."""
    noise = y.gain @ x.noise @ y.gain.T + y.noise
    return Component(x.weight * y.weight, y.gain @ x.gain, y.gain @ x.offset + y.offset, noise)


def _beside(x: Component, y: Component) -> Component:
    """Both heard, one above the other."""
    gain, offset = np.concatenate([x.gain, y.gain]), np.concatenate([x.offset, y.offset])
    return Component(x.weight * y.weight, gain, offset, np.asarray(block_diag(x.noise, y.noise)))


def _gain_atoms(law: AbstractLaw) -> list[tuple[float, float]]:
    match law:
        case Constant():
            return [(1.0, float(law.value))]
        case Discrete():
            return [(float(p), float(v)) for p, v in zip(law.probabilities, law.values, strict=True)]
        case _:
            raise fail("mixture filter", "gains of finitely many values", type(law).__name__)


NoiseAtom = tuple[float, np.ndarray, np.ndarray]  # probability, value, Gaussian covariance


def _joint(a: NoiseAtom, b: NoiseAtom) -> NoiseAtom:
    return a[0] * b[0], np.concatenate([a[1], b[1]]), np.asarray(block_diag(a[2], b[2]))


def _noise_atoms(noise: AbstractNoise) -> list[NoiseAtom]:
    """All combinations of the atoms of a noise's parts."""
    match noise:
        case Gaussian():
            return [(1.0, np.asarray(noise.mean), np.asarray(noise.covariance))]
        case FiniteSupport():
            none = np.zeros((noise.dimension, noise.dimension))
            return [(float(p), v, none) for p, v in zip(noise.probabilities, noise.atoms, strict=True)]
        case Shaped():
            b = np.asarray(noise.matrix)
            return [(p, b @ c, b @ r @ b.T) for p, c, r in _noise_atoms(noise.source)]
        case Independent():
            result = [(1.0, np.zeros(0), np.zeros((0, 0)))]
            for part in noise.parts:
                more = _noise_atoms(part)
                if len(result) * len(more) > COMPONENT_LIMIT:
                    got = f"{len(result) * len(more):,}"
                    raise fail("mixture filter", f"at most {COMPONENT_LIMIT:,} combinations of atoms", got)
                result = [_joint(a, b) for a in result for b in more]
            return result
        case _:
            raise fail("mixture filter", "noises of finite support or Gaussian", type(noise).__name__)
