"""The Nile at Aswan, 1871 to 1970, with a step of its level in 1899, against the density of all flows at once."""

import numpy as np
import pytest
from scipy import optimize, stats

import heliograph as hg

# Cobb, The problem of the Nile (1978), in 1e8 m^3 a year.
FLOW = np.array([
    1120, 1160, 963, 1210, 1160, 1160, 813, 1230, 1370, 1140, 995, 935, 1110, 994, 1020, 960, 1180, 799, 958, 1140,
    1100, 1210, 1150, 1250, 1260, 1220, 1030, 1100, 774, 840, 874, 694, 940, 833, 701, 916, 692, 1020, 1050, 969,
    831, 726, 456, 824, 702, 1120, 1100, 832, 764, 821, 768, 845, 864, 862, 698, 845, 744, 796, 1040, 759,
    781, 865, 845, 944, 984, 897, 822, 1010, 771, 676, 649, 846, 812, 742, 801, 1040, 860, 874, 848, 890,
    744, 749, 838, 1050, 918, 986, 797, 923, 975, 815, 1020, 906, 901, 1170, 912, 746, 919, 718, 714, 740,
], dtype=float)  # fmt: skip
DAM = np.arange(1871, 1971) == 1899
VAGUE = 1e7


def likelihood(level, noise, shift=0.0):
    """Log-density of all flows at once: a walk, a start known to VAGUE, a step from 1899 on, and noise."""
    n = np.arange(1, 101)
    covariance = VAGUE + level * np.minimum(n[:, None], n) + noise * np.eye(100)
    return stats.multivariate_normal(shift * np.cumsum(DAM), covariance).logpdf(FLOW)


def river(*step):
    plant = hg.LinearPlant([[1.0]], hg.free(1000.0, "level"), [0.0], VAGUE, *step)
    return hg.Network(plant, {"gauge": hg.Node(hg.LinearSensor([[1.0]], hg.free(1e4, "noise")), hg.perfect(), {})})


@pytest.mark.slow
def test_a_local_level_has_the_published_variances():
    """Durbin and Koopman, Time series analysis by state space methods (2012), 2.10.3: 1469.1 and 15098.5."""
    found = hg.fit(river, FLOW[:, None], starts=1)
    level, noise = found.values["level"], found.values["noise"]
    assert found.converged and level == pytest.approx(1469.1, rel=2e-3) and noise == pytest.approx(15098.5, rel=2e-3)
    assert found.best.total == pytest.approx(likelihood(level, noise), abs=1e-6)


@pytest.mark.parametrize("first", [-100.0, 1000.0])
def test_a_step_in_1899_leaves_the_level_constant(first):
    """With the step the level's variance is 0: two means, whose difference is known to r (1/28 + 1/72)."""
    found = hg.fit(lambda: river([[hg.free(first, "shift", "real")]]), FLOW[:, None], DAM.astype(float)[:, None], 1)
    best = optimize.minimize(lambda x: -likelihood(0.0, np.exp(x[0]), x[1]), [9.0, -200.0], method="Nelder-Mead",
                             options={"xatol": 1e-6, "fatol": 1e-9})  # fmt: skip
    values = found.values
    assert found.converged and values["level"] == 0
    assert found.best.total == pytest.approx(-best.fun, abs=1e-6)
    assert values["shift"] == pytest.approx(FLOW[28:].mean() - FLOW[:28].mean(), abs=0.1)  # the start's law pulls
    assert values["noise"] == pytest.approx(np.exp(best.x[0]), rel=1e-3)
    assert found.best.total > likelihood(10.0, values["noise"], values["shift"])
    shift = next(row for row in found.rows("hessian") if row.name == "shift")
    assert shift.standard_error == pytest.approx(np.sqrt(values["noise"] * (1 / 28 + 1 / 72)), rel=1e-3)
