"""A strapdown navigation of twelve states, and an error-state filter of it in NumPy, by the textbook's matrices."""

import jax.numpy as jnp
import numpy as np
from scipy.spatial.transform import Rotation

import heliograph as hg

GRAVITY, NORTH = np.array([0.0, 0.0, -9.81]), np.array([0.0, 0.43, -0.9])  # m/s^2; the magnetic field, in its size
STATES = ["rx", "ry", "rz", "vx", "vy", "vz", "px", "py", "pz", "bx", "by", "bz"]
INPUTS = ["wx", "wy", "wz", "ax", "ay", "az", "dt"]
START = np.array([0.1, -0.2, 0.4, 0.5, 0.0, 0.0, 1.0, 2.0, 3.0, 0.0, 0.0, 0.0])
P0 = np.diag([0.2**2] * 3 + [0.5**2] * 3 + [2.0**2] * 3 + [0.02**2] * 3)
Q = np.diag([0.01**2] * 3 + [0.1**2] * 3 + [0.0] * 3 + [0.001**2] * 3)  # in a second
R = np.diag([0.5**2] * 3 + [0.05**2] * 3)


def move(x, u):
    """x+ of attitude, velocity, position and gyroscope's bias, by what the IMU measures."""
    dt = u[6]
    a = hg.models.rotation_matrix(x[:3]) @ u[3:6] + GRAVITY
    attitude = hg.models.turn_attitude(x[:3], (u[:3] - x[9:]) * dt)
    return jnp.concatenate([attitude, x[3:6] + a * dt, x[6:9] + x[3:6] * dt + a * dt**2 / 2, x[9:]])


def observe(x):
    """Position of a receiver, and the magnetic field as the body sees it."""
    return jnp.concatenate([x[6:9], hg.models.rotation_matrix(x[:3]).T @ NORTH])


PLANT = hg.Plant(move, lambda u: Q * u[6], START, P0, STATES, INPUTS, attitude=["rx", "ry", "rz"])
SENSOR = hg.Sensor(observe, R, ["x", "y", "z", "mx", "my", "mz"])


def cross(v):
    """[v]x."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def right_jacobian(v):
    """Jr of the rotations: I - (1 - cos t) / t^2 [v]x + (t - sin t) / t^3 [v]x^2."""
    t, K = np.linalg.norm(v), cross(v)
    return np.eye(3) if t < 1e-9 else np.eye(3) - (1 - np.cos(t)) / t**2 * K + (t - np.sin(t)) / t**3 * K @ K


class ErrorState:
    """An error-state Kalman filter: a nominal state with a rotation matrix, and the covariance of its error."""

    def __init__(self):
        self.R, self.x, self.P = Rotation.from_rotvec(START[:3]).as_matrix(), START[3:].copy(), P0.copy()
        self.trace = []

    def predict(self, u):
        """Move the nominal state; F of the error by hand."""
        w, f, dt = u[:3] - self.x[6:], u[3:6], u[6]
        dR, I3 = Rotation.from_rotvec(w * dt).as_matrix(), np.eye(3)
        F = np.eye(12)
        F[:3, :3], F[:3, 9:] = dR.T, -right_jacobian(w * dt) * dt
        F[3:6, :3] = -self.R @ cross(f) * dt
        F[6:9, :3], F[6:9, 3:6] = -self.R @ cross(f) * dt**2 / 2, I3 * dt
        a = self.R @ f + GRAVITY
        before = self.P, F, self.R, self.x.copy()
        self.x = np.concatenate([self.x[:3] + a * dt, self.x[3:6] + self.x[:3] * dt + a * dt**2 / 2, self.x[6:]])
        self.R, self.P = self.R @ dR, F @ self.P @ F.T + Q * dt
        self.trace.append((before, (self.R, self.x.copy(), self.P)))

    def correct(self, z):
        """Update the error by what arrived, put it into the nominal state, and turn the covariance to its axes."""
        H = np.zeros((6, 12))
        H[:3, 6:9], H[3:, :3] = np.eye(3), cross(self.R.T @ NORTH)
        e = z - np.concatenate([self.x[3:6], self.R.T @ NORTH])
        there = ~np.isnan(z)
        H, e, noise = H[there], e[there], R[np.ix_(there, there)]
        K = self.P @ H.T @ np.linalg.inv(H @ self.P @ H.T + noise)
        A = np.eye(12) - K @ H
        self.P = A @ self.P @ A.T + K @ noise @ K.T
        self.inject(K @ e)

    def inject(self, d):
        """Add an error to the nominal state; the covariance is then of errors about the new one."""
        G = np.eye(12)
        G[:3, :3] = right_jacobian(d[:3])
        self.R = self.R @ Rotation.from_rotvec(d[:3]).as_matrix()
        self.x, self.P = self.x + d[3:], G @ self.P @ G.T

    def smooth(self):
        """Go back from the last state: Rauch's gains on errors, (attitudes (steps, 3, 3), others, covariances)."""
        later, results = (self.R, self.x, self.P), []
        for (P, F, turned, x), (ahead, moved, prior) in reversed(self.trace):
            results.append(later)
            S, z, Ps = later
            d = np.concatenate([Rotation.from_matrix(ahead.T @ S).as_rotvec(), z - moved])
            J = np.eye(12)
            J[:3, :3] = np.linalg.inv(right_jacobian(d[:3]))
            C = P @ F.T @ np.linalg.inv(prior)
            back = ErrorState()
            back.R, back.x, back.P = turned, x, P + C @ (J @ Ps @ J.T - prior) @ C.T
            back.inject(C @ d)
            later = back.R, back.x, back.P
        return results[::-1]


def simulate(steps, seed=0):
    """IMU, measurements with gaps, and the true states of a body that tumbles."""
    draw = np.random.default_rng(seed)
    turned, x = Rotation.from_rotvec(START[:3]) * Rotation.from_rotvec(0.2 * draw.normal(size=3)), START[3:].copy()
    x += np.sqrt(np.diag(P0)[3:]) * draw.normal(size=9)
    u, z, truth = np.zeros((steps, 7)), np.zeros((steps, 6)), []
    for k in range(steps):
        dt = 0.02 * (1 + k % 3)
        w = np.array([0.8 * np.sin(0.5 * k * 0.04), 0.5, 0.9 * np.cos(0.3 * k * 0.04)])
        f = turned.inv().apply(np.array([np.sin(0.1 * k), np.cos(0.07 * k), 0.2]) - GRAVITY)
        noisy = np.sqrt(np.diag(Q)[:6] / dt) * draw.normal(size=6)
        u[k] = [*(w + x[6:] + noisy[:3]), *(f + noisy[3:]), dt]
        a = turned.apply(f) + GRAVITY
        x[3:6], x[:3] = x[3:6] + x[:3] * dt + a * dt**2 / 2, x[:3] + a * dt
        turned = turned * Rotation.from_rotvec(w * dt)
        z[k] = np.concatenate([x[3:6], turned.inv().apply(NORTH)]) + np.sqrt(np.diag(R)) * draw.normal(size=6)
        if k % 5:
            z[k, :3] = np.nan
        truth.append(np.concatenate([turned.as_rotvec(), x]))
    return u, z, np.array(truth)
