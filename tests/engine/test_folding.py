"""A filter whose numbers are all known folds to numbers."""

import numpy as np

import heliograph as hg
from tests.straightline.test_lowering import agree


def test_a_filter_step_folds_to_its_numbers():
    plant = hg.LinearPlant([[1, 0.1], [0, 1]], np.diag([1e-3, 1e-2]), [0, 1], np.eye(2))
    kalman = hg.kalman_filter(plant, hg.LinearSensor([[1, 0]], 0.01))
    agree(lambda z: kalman.step(kalman.init(), z)[1].mean, np.array([0.3]))
    agree(lambda z: kalman.step(kalman.init(), z)[1].covariance, np.array([np.nan]))
