"""The example's own guarantee, broken: since a = 0.7 is false, so is what rests on it."""

import jax.numpy as jnp
import numpy as np

import heliograph as hg
from heliograph_studies.h_infinity_fusion import setting
from heliograph_studies.h_infinity_fusion.structured import relay_draws
from heliograph_studies.h_infinity_fusion.worst_disturbance import Draws, World, Worst, worst_disturbance

ENERGIES = (5e4, 1e5, 2e5)  # starts of some 60, where the cosine of f changes its sign
SEARCH_DRAWS, JUDGE_DRAWS = 4, 2_000


def violation(node: int, design: hg.h_infinity.HInfinityDesign) -> Worst:
    """The worst disturbance found for a node's filter; where its level is above the design's, the theorem is broken."""
    believed, sensor = setting.plant(False), setting.sensor(node, 0.0)
    item = hg.filters.h_infinity_filter(believed, sensor, setting.system(node), design)
    return worst_disturbance(item, world(node), draws(SEARCH_DRAWS, 1), draws(JUDGE_DRAWS, 2), ENERGIES, starts=16)


def draws(count: int, seed: int) -> Draws:
    """Arrivals of `count` runs as gains."""
    return relay_draws(setting.ARRIVAL, setting.NOISE_GAIN, setting.POWERS, setting.STEPS, count, seed)


def world(node: int) -> World:
    """The example for a search for the worst disturbance."""
    sensing = setting.SENSING[node]
    return World(
        lambda x, k: setting.dynamics(k)(x),
        lambda x: sensing * jnp.sum(x, keepdims=True),
        setting.DISTURBANCE,
        np.array([[setting.FEEDTHROUGH[node]]]),
        setting.WANTED,
        setting.WEIGHT * np.eye(4),
        setting.inputs(),
    )
