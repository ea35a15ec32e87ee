"""The published example as the library describes it, for tests of H-infinity designs."""

import numpy as np

import heliograph as hg
from tests.oracles import h_infinity_fusion as paper


def channel(beta=paper.beta):
    """Relay path and direct path with their dropouts; the noises as unit disturbances times C."""
    noise = np.diag(paper.C) ** 2
    hops = [hg.hop(hg.random_affine.bernoulli(beta[j]), noise[j], paper.E[j]) for j in range(3)]
    return hg.model.with_direct_link(hg.amplify_and_forward(hops[:2]), hops[2])


def node(i, growth=paper.A, beta=paper.beta, steps=paper.T + 1):
    return hg.h_infinity.growth_system(
        steps, paper.B, [[paper.D[i]]], paper.M, channel(beta), growth, paper.b[i], initial_weight=paper.W
    )


def linear_system(steps=20, arrival=1.0):
    """A rotation with known matrices and no growth at all, behind one hop."""
    turn = 0.95 * np.array([[np.cos(0.4), np.sin(0.4)], [-np.sin(0.4), np.cos(0.4)]])
    return hg.h_infinity.growth_system(
        steps,
        [[0.2, 0.0], [0.0, 0.1]],
        [[0.0, 0.3]],
        np.eye(2),
        hg.hop(hg.random_affine.bernoulli(arrival), 0.04),
        0.0,
        transition=turn,
        output=[[1.0, 0.5]],
        initial_weight=5.0,
    )
