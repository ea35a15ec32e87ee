"""Atoms of a random affine map: all combinations of its gains and noises, where these are finitely many."""

from collections.abc import Callable
from functools import reduce
from typing import Any, NamedTuple, TypeAlias

import jax
import numpy as np

from heliograph.numerics.check import fail
from heliograph.numerics.traced import block_diagonal, library, plain
from heliograph.numerics.types import Array
from heliograph.random_affine.base import AbstractRandomAffine, fold
from heliograph.random_affine.combine import Series, Stack
from heliograph.random_affine.hop import GainAndNoise
from heliograph.random_affine.law import AbstractLaw, Constant, Discrete
from heliograph.random_affine.mixture import Mixture
from heliograph.random_affine.noise import AbstractNoise, FiniteSupport, Independent, Shaped
from heliograph.random_affine.noise import Gaussian as GaussianNoise
from heliograph.random_affine.superposed import Superposed

COMPONENT_LIMIT = 4096  # combinations of atoms held for one step
Number: TypeAlias = float | jax.Array


class Component(NamedTuple):
    """One combination of atoms: with probability `weight`, z = gain x + offset + N(0, noise).

    Shapes: gain (m, n), offset (m,), noise (m, m).
    """

    weight: Number
    gain: Array
    offset: Array
    noise: Array


Atoms = list[list[Component]]  # of each of the maps inside


def list_atoms(channel: AbstractRandomAffine) -> list[Component]:
    """List all combinations of the atoms of a map's gains and noises."""
    return fold(channel, {
        GainAndNoise: _atoms_of_hop,
        Series: _reduce_parts(_compose_maps),
        Stack: _reduce_parts(_stack_maps),
        Superposed: lambda channel, _: list_atoms(channel.as_stack),
        # One of several maps, drawn: p(i) times the atoms of map i.
        Mixture: lambda mixture, parts: [c._replace(weight=p * c.weight) for p, atoms in
                                         zip(mixture.choice.probabilities, parts, strict=True) for c in atoms],
    }, "mixture filter", "maps made of hops, series, stacks, sums and mixtures")  # fmt: skip


def _atoms_of_hop(hop: GainAndNoise, _: object) -> list[Component]:
    """Combine every gain with every noise of z = g H y + n."""
    gains, noises = _gain_atoms(hop.law), _noise_atoms(hop.noise)
    return [Component(p * q, g * hop.matrix, c, r) for p, g in gains for q, c, r in noises]


def _reduce_parts(join: Callable[[Component, Component], Component]) -> Callable[[object, Atoms], list[Component]]:
    def pairs(a: list[Component], b: list[Component]) -> list[Component]:
        if len(a) * len(b) > COMPONENT_LIMIT:
            raise fail("mixture filter", f"at most {COMPONENT_LIMIT:,} combinations of atoms", f"{len(a) * len(b):,}")
        return [join(x, y) for x in a for y in b]

    return lambda _, parts: reduce(pairs, parts)


def _compose_maps(x: Component, y: Component) -> Component:
    """Compose maps, y after x: G_y (G_x s + c_x + n_x) + c_y + n_y."""
    noise = y.gain @ x.noise @ y.gain.T + y.noise
    return Component(x.weight * y.weight, y.gain @ x.gain, y.gain @ x.offset + y.offset, noise)


def _stack_maps(x: Component, y: Component) -> Component:
    """Stack both maps, one above the other."""
    gain, offset = _join_ends(x.gain, y.gain), _join_ends(x.offset, y.offset)
    return Component(x.weight * y.weight, gain, offset, block_diagonal([x.noise, y.noise]))


def _join_ends(a: Array, b: Array) -> Any:
    return library(a, b).concatenate([a, b])


def _gain_atoms(law: AbstractLaw) -> list[tuple[Number, Number]]:
    """List probability and value of each atom of a gain; refuse a law without atoms."""
    match law:
        case Constant():
            return [(1.0, plain(law.value))]
        case Discrete():
            return [(plain(p), plain(v)) for p, v in zip(law.probabilities, law.values, strict=True)]
        case _:
            raise fail("mixture filter", "gains of finitely many values", type(law).__name__)


NoiseAtom = tuple[Number, Array, Array]  # probability, value, Gaussian covariance


def _joint(a: NoiseAtom, b: NoiseAtom) -> NoiseAtom:
    return a[0] * b[0], _join_ends(a[1], b[1]), block_diagonal([a[2], b[2]])


def _noise_atoms(noise: AbstractNoise) -> list[NoiseAtom]:
    """List all combinations of the atoms of a noise's components."""
    match noise:
        # One atom, its mean, with the covariance about it.
        case GaussianNoise():
            return [(1.0, noise.mean, noise.covariance)]
        case FiniteSupport():
            none = np.zeros((noise.dimension, noise.dimension))
            return [(plain(p), v, none) for p, v in zip(noise.probabilities, noise.atoms, strict=True)]
        # B n: every atom mapped, B c and B R B'.
        case Shaped():
            b = noise.matrix
            return [(p, b @ c, b @ r @ b.T) for p, c, r in _noise_atoms(noise.source)]
        # Independent components: the product of their laws.
        case Independent():
            atoms: list[NoiseAtom] = [(1.0, np.zeros(0), np.zeros((0, 0)))]
            for component in noise.parts:
                more = _noise_atoms(component)
                if len(atoms) * len(more) > COMPONENT_LIMIT:
                    got = f"{len(atoms) * len(more):,}"
                    raise fail("mixture filter", f"at most {COMPONENT_LIMIT:,} combinations of atoms", got)
                atoms = [_joint(a, b) for a in atoms for b in more]
            return atoms
        case _:
            raise fail("mixture filter", "noises of finite support or Gaussian", type(noise).__name__)
