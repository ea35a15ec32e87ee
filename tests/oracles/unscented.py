"""The unscented Kalman filter as printed, with its points and weights written out (Wan and van der Merwe, 2001)."""

import numpy as np


def sigma_points(x, P, alpha, beta, kappa):
    """Points (2 L + 1, L), weights of the mean and of the covariance."""
    L = len(x)
    lam = alpha**2 * (L + kappa) - L
    root = np.linalg.cholesky((L + lam) * P)
    points = np.array([x, *(x + root[:, i] for i in range(L)), *(x - root[:, i] for i in range(L))])
    wm = np.full(2 * L + 1, 1 / (2 * (L + lam)))
    wc = wm.copy()
    wm[0] = lam / (L + lam)
    wc[0] = wm[0] + 1 - alpha**2 + beta
    return points, wm, wc


def weighted_moments(X, Y, wm, wc):
    """Mean and covariance of Y, and its cross covariance with X."""
    y = wm @ Y
    return y, (Y - y).T @ (wc[:, None] * (Y - y)), (X - X[0]).T @ (wc[:, None] * (Y - y))


def unscented_kalman(plant, sensor, z, alpha, beta, kappa):
    """Means and covariances after each row; points are drawn anew from the prediction."""
    x, P = np.asarray(plant.initial_mean), np.asarray(plant.initial_covariance)
    Q, R = np.asarray(plant.noise.covariance), np.asarray(sensor.noise.covariance)
    means, covariances = [], []
    for row in z:
        X, *w = sigma_points(x, P, alpha, beta, kappa)
        x, P, _ = weighted_moments(X, np.array([np.asarray(plant.function(p, ())) for p in X]), *w)
        P = P + Q
        X, *w = sigma_points(x, P, alpha, beta, kappa)
        y, S, C = weighted_moments(X, np.array([np.asarray(sensor.function(p)) for p in X]), *w)
        S = S + R
        K = C @ np.linalg.inv(S)
        x, P = x + K @ (row - y), P - K @ S @ K.T
        means.append(x)
        covariances.append(P)
    return np.array(means), np.array(covariances)
