"""Networks whose parts repeat with a period, written down for as many steps as a run may have."""

import jax
import numpy as np

from heliograph.model.over_time import OverTime
from heliograph.simulation.network import Network

COVERED = 100  # steps for which a design with a period is written down


def repeated(network: Network) -> Network:
    """The network with everything in it that is OverTime gone through again and again."""

    def again(leaf: object) -> object:
        if not isinstance(leaf, OverTime):
            return leaf
        times = -(-COVERED // leaf.steps)
        return OverTime(jax.tree.map(lambda v: np.tile(v, (times, *[1] * (np.ndim(v) - 1))), leaf.values))

    result: Network = jax.tree.map(again, network, is_leaf=lambda leaf: isinstance(leaf, OverTime))
    return result
