"""torch-kf: a batch of series with the same matrices in PyTorch, whose covariances then have no axis of series."""

from collections.abc import Callable
from typing import Any

import numpy as np
import torch
from timed import Arrays, Contender, serve
from torch_kf import GaussianState, KalmanFilter


def filtered(filter: KalmanFilter, start: GaussianState, z: torch.Tensor) -> GaussianState:
    """What the filter says after each row."""
    return filter.filter(start, z, update_first=False, return_all=True)


def smoothed(filter: KalmanFilter, start: GaussianState, z: torch.Tensor) -> GaussianState:
    """What the smoother says of each row, given all rows."""
    return filter.rts_smooth(filtered(filter, start, z))


def contender(estimate: Callable[..., GaussianState], dtype: torch.dtype) -> Callable[[Arrays], Contender]:
    """The program of one estimate in one precision, on all threads."""

    def prepare(p: Arrays) -> Contender:
        a, c, q, r, covariance = (torch.as_tensor(p[name], dtype=dtype) for name in ("A", "C", "Q", "R", "covariance"))
        z = torch.as_tensor(np.ascontiguousarray(p["z"].swapaxes(0, 1))[..., None], dtype=dtype)
        mean = torch.as_tensor(np.broadcast_to(p["mean"][:, None], (z.shape[1], 4, 1)).copy(), dtype=dtype)
        filter, start = KalmanFilter(a, c, q, r), GaussianState(mean, covariance)

        def lay_out(result: Any) -> np.ndarray:
            return np.ascontiguousarray(result.mean[..., 0].numpy().swapaxes(0, 1), dtype=np.float64)

        how = f"all series at once, {torch.get_num_threads()} threads"
        return Contender(lambda: estimate(filter, start, z), lay_out, how)

    return prepare


def run(estimate: Callable[..., GaussianState], dtype: torch.dtype) -> None:
    """Answer the driver."""
    with torch.inference_mode():
        serve(contender(estimate, dtype), ("torch-kf", "torch", "numpy"))
