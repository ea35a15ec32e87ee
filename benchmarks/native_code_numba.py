"""The three examples of benchmarks/native_code.py as one writes them for Numba, which is no dependency."""

import numba
import numpy as np

TURNS, DRAWS = 10, 50
DT, SPOT, STRIKE, RATE, VOLATILITY = 0.01, 100.0, 100.0, 0.03, 0.2


@numba.njit
def _slope(x, y, z):
    return 10 * (y - x), x * (28 - z) - y, x * y - 8 / 3 * z


@numba.njit
def ode(starts):
    """Ten steps of Runge-Kutta of order four of each particle."""
    ends = np.empty_like(starts)
    for p in range(len(starts)):
        x, y, z = starts[p]
        for _ in range(TURNS):
            a, b, c = _slope(x, y, z)
            d, e, f = _slope(x + DT / 2 * a, y + DT / 2 * b, z + DT / 2 * c)
            g, h, i = _slope(x + DT / 2 * d, y + DT / 2 * e, z + DT / 2 * f)
            j, k, m = _slope(x + DT * g, y + DT * h, z + DT * i)
            x += DT / 6 * (a + 2 * d + 2 * g + j)
            y += DT / 6 * (b + 2 * e + 2 * h + k)
            z += DT / 6 * (c + 2 * f + 2 * i + m)
        ends[p] = x, y, z
    return ends


@numba.njit
def option(paths):
    """Sum of the payoffs, and of their squares."""
    drift, spread = (RATE - VOLATILITY**2 / 2) / DRAWS, VOLATILITY / DRAWS**0.5
    total = squares = 0.0
    for _ in range(paths):
        logarithm = mean = 0.0
        for _ in range(DRAWS):
            logarithm += drift + spread * np.random.normal()
            mean += SPOT * np.exp(logarithm)
        value = np.exp(-RATE) * max(mean / DRAWS - STRIKE, 0.0)
        total += value
        squares += value**2
    return total, squares


@numba.njit
def controller(state, error):
    """One step of the controller."""
    integral = min(max(state[0] + 0.01 * error, -1.0), 1.0)
    derivative = 0.9 * state[1] + 0.1 * (error - state[2]) / 0.01
    u = min(max(8.0 * error + 2.0 * integral + 0.3 * derivative, -10.0), 10.0)
    return np.array([integral, derivative, error]), u


FUNCTIONS = {"ode": ode, "option": option, "controller": controller}
