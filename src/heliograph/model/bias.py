"""Plants driven by a dynamical bias."""

import numpy as np

from heliograph.model.plant import LinearPlant
from heliograph.numerics.check import array, fail, instance
from heliograph.numerics.traced import library
from heliograph.numerics.types import ArrayLike, Float
from heliograph.random_affine.noise import AbstractNoise, Gaussian, Independent


def with_bias(plant: LinearPlant, coupling: "Float[ArrayLike, 'n bias']", bias: LinearPlant) -> LinearPlant:
    """Return the plant driven by a dynamical bias, as one plant of X = [x; b]: x+ = A x + E b + B u + w, b+ = F b + xi.

    Every filter of the result estimates both. A name that the plant has too gets the prefix "bias_".

    Args:
        plant: the plant of x (n states).
        coupling: E (n, bias states).
        bias: the plant of b, without inputs, independent of the first.

    Raises:
        ValueError: shapes that do not fit, a bias with inputs, noise that depends on inputs.
    Source: quadratic filtering with dynamical bias, equations (1), (2) and (10).
    """
    for what, item in (("plant with bias", plant), ("bias", bias)):
        instance(what, item, LinearPlant, "a LinearPlant")
    n, extra = len(plant.states), len(bias.states)
    coupling = array("coupling of the bias", coupling, (n, extra))
    if bias.inputs:
        raise fail("bias", "a plant without inputs", list(bias.inputs))
    # (w, xi) and the two initial states are independent.
    noises = [p.noise for p in (plant, bias) if isinstance(p.noise, AbstractNoise)]
    if len(noises) < 2:
        raise fail("noise of a plant with bias", "a covariance or a noise law", "a function of the inputs")
    deviations = [p.deviation or Gaussian(p.initial_covariance) for p in (plant, bias)]
    centers = [p.initial_mean - d.mean for p, d in zip((plant, bias), deviations, strict=True)]
    xp = library(plant.matrix, coupling, bias.matrix, centers, plant.input_matrix)
    # [x; b]+ = [[A, E], [0, F]] [x; b] + [B; 0] u + [w; xi].
    renamed = {name: f"bias_{name}" if name in plant.states else name for name in bias.states}
    return LinearPlant(
        xp.block([[plant.matrix, coupling], [np.zeros((extra, n)), bias.matrix]]),
        Independent(noises),
        xp.concatenate(centers),
        Independent(deviations),
        xp.concatenate([plant.input_matrix, np.zeros((extra, len(plant.inputs)))]),
        states=(*plant.states, *renamed.values()),
        inputs=plant.inputs,
        circular=(*plant.circular, *(renamed[name] for name in bias.circular)),
    )
