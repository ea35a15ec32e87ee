"""Laws of gains as finitely many values: what a density needs where two moments are not enough."""

from functools import cache
from typing import TypeVar

import jax
import numpy as np
from scipy import stats
from scipy.special import ndtr

from heliograph.numerics.check import check_count
from heliograph.numerics.float64 import in_float64
from heliograph.random_affine.base import AbstractRandomAffine
from heliograph.random_affine.law import AbstractLaw, Constant, Discrete, LogNormal, Nakagami, Rayleigh, Rician

REACH = 5.5  # standard deviations of the normal score: 4e-8 of a law lie beyond
DRAWS = 2**14  # of a law that nobody knows but by its samples
Map = TypeVar("Map", bound=AbstractRandomAffine)


def law_nodes(law: AbstractLaw, count: int) -> Discrete:
    """Approximate a law by `count` gains with probabilities, far into its tails.

    int f(g) dF(g) = int f(F^-1(Phi(t))) phi(t) dt by the trapezoidal rule on |t| <= REACH, Phi the normal distribution
    function: its error falls as exp(-2 pi^2 / h^2) with the distance h of the nodes. A law of finitely many values is
    itself. Of a user's law, which has no F^-1, the nodes are quantiles of DRAWS samples.

    Raises:
        ValueError: fewer than 2 nodes, a law that cannot be sampled.
    """
    check_count("nodes of a law", count, 2)
    if isinstance(law, Discrete):
        return Discrete(law.values, law.probabilities)
    if isinstance(law, Constant):
        return Discrete([float(law.value)], [1.0])
    # F^-1(Phi(t)) at the nodes
    points, weights = _normal(count)
    match law:
        case Rayleigh():
            gains = stats.rayleigh.ppf(points, scale=float(law.scale))
        case LogNormal():
            gains = np.exp(float(law.log_mean) + float(law.log_deviation) * stats.norm.ppf(points))
        case Rician():
            gains = stats.rice.ppf(points, float(law.sight) / float(law.scale), scale=float(law.scale))
        case Nakagami():
            gains = np.sqrt(stats.gamma.ppf(points, float(law.shape)) * float(law.power) / float(law.shape))
        case _:
            gains = np.quantile(_drawn(law), points)
    return Discrete(gains, weights)


def with_nodes(channel: Map, count: int) -> Map:
    """Channel with each gain's law as finitely many values."""

    def is_law(item: object) -> bool:
        return isinstance(item, AbstractLaw)

    def chosen(item: object) -> object:
        return law_nodes(item, count) if isinstance(item, AbstractLaw) and not isinstance(item, Constant) else item

    result: Map = jax.tree.map(chosen, channel, is_leaf=is_law)
    return result


@cache
def _normal(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Values of Phi(t) at the nodes, and their weights."""
    t = np.linspace(-REACH, REACH, count)
    weights = np.exp(-(t**2) / 2)
    return np.asarray(ndtr(t)), weights / weights.sum()


@in_float64
def _drawn(law: AbstractLaw) -> np.ndarray:
    samples: np.ndarray = np.asarray(jax.vmap(law.sample)(jax.random.split(jax.random.key(0), DRAWS)))
    return samples
