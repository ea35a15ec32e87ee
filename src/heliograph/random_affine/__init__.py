"""The algebra of random affine maps z = G y + n: sampling and joint moments of one object.

Knows nothing of filters or networks. Start with `base`, then `atoms` and `combine`; filters read `second_order`.
"""

from heliograph.random_affine.atoms import GainAndNoise, known
from heliograph.random_affine.base import AbstractRandomAffine, Moments, apply, conditional_moments
from heliograph.random_affine.combine import Lift, Mixture, Series, Stack, square
from heliograph.random_affine.interval import moment_interval
from heliograph.random_affine.law import (
    AbstractLaw,
    Constant,
    Discrete,
    GivenMoments,
    LogNormal,
    Nakagami,
    Rayleigh,
    Rician,
    bernoulli,
)
from heliograph.random_affine.moment_noise import NoiseMoments, recorded_noise
from heliograph.random_affine.noise import (
    AbstractNoise,
    FiniteSupport,
    Gaussian,
    Independent,
    Shaped,
)
from heliograph.random_affine.push import push
from heliograph.random_affine.second_order import QuadraticMap, SecondOrder, second_order

__all__ = [
    "AbstractLaw", "AbstractNoise", "AbstractRandomAffine", "Constant", "Discrete", "FiniteSupport", "GainAndNoise",
    "Gaussian", "GivenMoments", "Independent", "Lift", "LogNormal", "Mixture", "Moments", "Nakagami",
    "NoiseMoments", "QuadraticMap", "Rayleigh", "Rician", "SecondOrder", "Series", "Shaped", "Stack", "apply",
    "bernoulli", "conditional_moments", "known", "moment_interval", "push", "recorded_noise", "second_order",
    "square",
]  # fmt: skip
