"""Riccati steps by the textbook."""

import numpy as np


def riccati(a, c, q, r, p, arrived):
    """P+ = A P A' + Q, less A P C' (C P C' + R)^-1 C P A' where z arrived."""
    moved = a @ p @ a.T + q
    return moved - a @ p @ c.T @ np.linalg.solve(c @ p @ c.T + r, c @ p @ a.T) if arrived else moved
