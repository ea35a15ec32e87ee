"""Which packets were lost, read off what was received: the example's noises and states are known."""

import numpy as np

from heliograph_studies.h_infinity_fusion import setting
from heliograph_studies.h_infinity_fusion.example import Outcome


def arrivals(outcome: Outcome) -> np.ndarray:
    """beta_1, beta_2, beta_3 of each run, node and step, (run, node, time, 3).

    r = beta_2 (beta_1 y + C_1 rho_1) + C_2 rho_2 and y_2 = sqrt(E_3) beta_3 y + C_3 rho_3, each the nearest of the two
    values that it can have; beta_1 is NaN where beta_2 = 0, since then nobody can tell.
    """
    z = np.stack([outcome.record.measurements[n] for n in setting.NODES], axis=1)
    n1, n2, n3 = (np.array(setting.NOISE_GAIN) * setting.CHANNEL_NOISES).T
    sensing, through = np.array(setting.SENSING)[:, None], np.array(setting.FEEDTHROUGH)[:, None]
    y = sensing * outcome.truth.sum(axis=1) + through * setting.DISTURBANCES
    second = z[..., 0] != n2
    first = np.abs(z[..., 0] - n2 - n1) > np.abs(z[..., 0] - n2 - n1 - y)
    direct = np.abs(z[..., 1] - n3) > np.abs(z[..., 1] - n3 - np.sqrt(setting.POWERS[2]) * y)
    return np.stack([np.where(second, first, np.nan), second, direct], axis=-1).astype(float)
