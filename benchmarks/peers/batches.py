"""Many runs at once in JAX, for ours and for a JAX peer alike: a function of one run, vectorised at its best width."""

from collections.abc import Callable
from typing import Any

import jax
import numpy as np
from timed import Contender, fastest

WIDTHS = (128, 512, 2_000)  # divide 10,000 and 20,000 or nearly; and all at once


def vectorised(one_run: Callable[..., Any], arrays: list[np.ndarray]) -> Contender:
    """Runs side by side in blocks of the fastest width; `one_run` maps a run's arrays to (means, last covariance).

    Shapes: arrays (runs, steps, ...), means (steps, n).
    """
    runs = len(arrays[0])
    with jax.enable_x64(True):
        inputs = [jax.device_put(a) for a in arrays]

    def block(width: int) -> Callable[[], Any]:
        every = jax.jit(lambda *parts: jax.lax.map(lambda part: one_run(*part), parts, batch_size=width))

        def work() -> Any:
            with jax.enable_x64(True):
                return jax.block_until_ready(every(*inputs))

        return work

    widths = [w for w in WIDTHS if w < runs] + [runs]
    name, work = fastest({f"{w:,} runs side by side": block(w) for w in widths})
    return Contender(work, lambda result: np.asarray(result[0]), name)
