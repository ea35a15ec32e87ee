"""Spread of a random gain as a sum of squares: matrices K_r with E[(H - E H) W (H - E H)'] = sum_r K_r W K_r'."""

import numpy as np

from heliograph.filters.gaussian.factors import columns_of_known
from heliograph.model.over_time import OverTime, unstack
from heliograph.numerics.check import fail
from heliograph.random_affine.moments.second_moments import SecondOrder


def gain_spread(channel: SecondOrder | OverTime) -> np.ndarray | OverTime:
    """Operators K_r (operators, m, p + 1) of z = G y + n, H = [G, n]; one set per step where the channel varies.

    A channel is described by E[(z - E z)(z - E z)' | y] alone, which leaves open how E[dH_ia dH_jb] divides between
    (a, b) and (b, a). Where one of the two is zero because an entry never varies, the other is all; else they are taken
    to be equal. A spread that then is no sum of squares is refused.

    Raises:
        ValueError: uncertain probabilities, a spread that is no sum of squares in this sense.
    """
    # One set of operators per step, padded with zeros to the same number.
    if isinstance(channel, OverTime):
        parts = [np.asarray(gain_spread(step)) for step in unstack(channel)]
        most = max(len(part) for part in parts)
        return OverTime(np.stack([np.pad(part, [(0, most - len(part)), (0, 0), (0, 0)]) for part in parts]))
    if channel.uncertain:
        raise fail("single precision", "a channel whose probabilities are known", "uncertain ones")
    # Entries of H that vary, and how a pair's moment divides between (a, b) and (b, a).
    tensor = np.asarray(channel.spread.center)
    m, p = tensor.shape[0], tensor.shape[2]
    varies = np.einsum("iiaa->ia", tensor) > 0
    straight = varies[:, None, :, None] & varies[None, :, None, :]  # (i, a) with (j, b)
    crossed = straight.swapaxes(2, 3)
    share = np.where(straight & crossed, 1.0, np.where(straight, 2.0, 0.0))
    same = np.eye(m, dtype=bool)[:, :, None, None] | np.eye(p, dtype=bool)
    # E[vec dH vec dH'] = sum_r vec K_r vec K_r'.
    whole = np.where(same, tensor, share * tensor).transpose(0, 2, 1, 3).reshape(m * p, m * p)
    try:
        root = columns_of_known(whole)
    except ValueError:
        expected = "a channel whose gain varies by a sum of squares (one gain for each output, or for all)"
        raise fail("single precision", expected, "outputs whose gains mix several inputs") from None
    return root.T.reshape(-1, m, p)
