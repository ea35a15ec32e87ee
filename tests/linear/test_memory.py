"""The system behind the filter with memory."""

import numpy as np

import heliograph as hg
from heliograph.linear.polynomial_filter_errors import quadratic_system_with_linear_estimate
from tests.oracles import quadratic_bias as oracle
from tests.relay_bias import model, scalar_system, two_sensors


def designs(system, horizon):
    s = model(system, horizon)
    linear = hg.linear.lmmse(hg.linear.lifted_system(*s, 1, horizon))
    quadratic = hg.linear.lmmse(hg.linear.lifted_system(*s, 2, horizon)).gains.covariance
    memory = quadratic_system_with_linear_estimate(*s, linear)
    return linear.gains.covariance, quadratic, memory


def test_memory_is_never_worse_than_the_square_and_claims_the_truth():
    for system in (oracle.paper_example(), two_sensors()):
        _, quadratic, memory = designs(system, 8)
        schedule = hg.linear.lmmse(memory)
        covariance = schedule.gains.covariance
        scale = np.abs(covariance).max()
        assert np.linalg.eigvalsh(quadratic - covariance).min() >= -1e-10 * scale
        np.testing.assert_allclose(hg.linear.true_covariance(memory, schedule), covariance, rtol=0, atol=1e-10 * scale)


def test_first_step_has_no_past_to_multiply_with():
    _, quadratic, memory = designs(oracle.paper_example(), 3)
    covariance = hg.linear.lmmse(memory).gains.covariance
    np.testing.assert_allclose(covariance[0], quadratic[0], rtol=0, atol=1e-14)
    assert covariance[2, 0, 0] < (1 - 1e-4) * quadratic[2, 0, 0]


def test_second_step_is_regression_on_all_products_of_all_paths():
    """Two steps: z_2 times the linear estimate is z_2 z_1 up to a factor: the full second-order Volterra filter."""
    s = scalar_system()
    x, p = oracle.independent(s.x0, s.eps0)
    received, past = oracle.independent(s.l, s.m, s.v, s.varpi, s.sigma), []
    for t in range(2):
        a, b, w = oracle.augmented(s, t)
        i, j, k = (
            axis.reshape(-1) for axis in np.meshgrid(*map(np.arange, (len(p), len(w.chance), len(received.chance))))
        )
        x, p = x[i] @ a.T + w.points[j] @ b.T, p[i] * w.chance[j] * received.chance[k]
        power, relay, v, varpi, sigma = received.points[k].T
        y = x[:, 0] * s.C[0, 0] + s.D[0, 0] * v
        past = [z[i] for z in past]
        past.append(s.theta * np.sqrt(relay) * (np.sqrt(power) * y + varpi) + sigma)
    item, two = past
    features = np.column_stack([np.ones(len(p)), item, item**2, two, two**2, item * two])
    root = np.sqrt(p)[:, None]
    residual = x - features @ np.linalg.lstsq(root * features, root * x, rcond=None)[0]
    covariance = hg.linear.lmmse(designs(s, 2)[2]).gains.covariance
    np.testing.assert_allclose(covariance[1], (residual.T * p) @ residual, rtol=0, atol=1e-12)
