"""Moments of what a channel delivers, given what was sent."""

import numpy as np

from heliograph.random_affine.moments import evaluate_monomials


def conditional_moments(channel, y, order):
    """E[mono_order(z) | y] for a given point y (inputs,)."""
    return channel.moments(order).expect(evaluate_monomials(np.asarray(y, dtype=float), order))
