"""Channels whose gains and noises take finitely many values: all combinations, each with its probability."""

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from scipy.linalg import block_diag

from heliograph.numerics.check import fail
from heliograph.random_affine.atoms import GainAndNoise
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.combine import Mixture, Series, Stack
from heliograph.random_affine.law import AbstractLaw, Constant, Discrete
from heliograph.random_affine.noise import AbstractNoise, FiniteSupport, Gaussian, Independent, Shaped

COMPONENT_LIMIT = 4096  # combinations of atoms held for one step


class Component(NamedTuple):
    """One combination of atoms: with probability `weight`, z = gain x + offset + N(0, noise).

    Shapes: gain (m, n), offset (m,), noise (m, m).
    """

    weight: float
    gain: np.ndarray
    offset: np.ndarray
    noise: np.ndarray


def atoms_of(item: AbstractRandomAffine) -> list[Component]:
    """All combinations of the atoms of a map's gains and noises.

    Raises:
        ValueError: a gain that is not discrete, a noise that is neither finite nor Gaussian, or a map of unknown kind;
            more than COMPONENT_LIMIT combinations.
    """
    match item:
        # z = g H y + n: every gain with every noise.
        case GainAndNoise():
            gains, noises = _gain_atoms(item.law), _noise_atoms(item.noise)
            result = [Component(p * q, g * np.asarray(item.matrix), c, r) for p, g in gains for q, c, r in noises]
        # One map after another: G_2 (G_1 y + n_1) + n_2.
        case Series():
            result = atoms_of(item.maps[0])
            for part in item.maps[1:]:
                result = _combine(result, atoms_of(part), _after)
        # Maps of the same signal, stacked.
        case Stack():
            result = atoms_of(item.maps[0])
            for part in item.maps[1:]:
                result = _combine(result, atoms_of(part), _others)
        # One of several maps, drawn: p(i) times the atoms of map i.
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
    """Compose maps, y after x: G_y (G_x s + c_x + n_x) + c_y + n_y."""
    noise = y.gain @ x.noise @ y.gain.T + y.noise
    return Component(x.weight * y.weight, y.gain @ x.gain, y.gain @ x.offset + y.offset, noise)


def _others(x: Component, y: Component) -> Component:
    """Stack both maps, one above the other."""
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
    """All combinations of the atoms of a noise's components."""
    match noise:
        # One atom, its mean, with the covariance about it.
        case Gaussian():
            return [(1.0, np.asarray(noise.mean), np.asarray(noise.covariance))]
        case FiniteSupport():
            none = np.zeros((noise.dimension, noise.dimension))
            return [(float(p), v, none) for p, v in zip(noise.probabilities, noise.atoms, strict=True)]
        # B n: every atom mapped, B c and B R B'.
        case Shaped():
            b = np.asarray(noise.matrix)
            return [(p, b @ c, b @ r @ b.T) for p, c, r in _noise_atoms(noise.source)]
        # Independent components: the product of their laws.
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
