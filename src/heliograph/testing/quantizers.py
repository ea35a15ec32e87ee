"""Contract test of a quantizer: error bound, state, and idempotence."""

import jax
import jax.numpy as jnp
import numpy as np

from heliograph.fusion.quantizer import AbstractQuantizer, Quantized
from heliograph.testing.filters import ROUNDING


def check_quantizer(quantizer: AbstractQuantizer, n: int = 2, steps: int = 20, seed: int = 0) -> None:
    """Check (init, step) of a quantizer on random values, some far out of range, some NaN.

    The stated error bound holds, and is NaN where a component is saturated or NaN; a value that was delivered
    unsaturated is delivered again from the same state; a step is deterministic, preserves the structure of the state,
    and does the same under jit and vmap.

    Args:
        quantizer: the quantizer to test.
        n: number of components (default 2).
        steps: number of values (default 20).
        seed: seed of the values (default 0).

    Raises:
        AssertionError: naming the rule that is broken.
    """
    generator = np.random.default_rng(seed)
    state = quantizer.init(n)
    structure, compiled = str(jax.tree.structure(state)), jax.jit(jax.vmap(quantizer.step))
    for k in range(steps):
        # Values over seven decades, some components NaN.
        value = generator.normal(size=n) * 10.0 ** generator.integers(-3, 4, size=n)
        value[generator.random(n) < 0.1] = np.nan
        following, sent = quantizer.step(state, value)
        assert str(jax.tree.structure(following)) == structure, "step: expected a state of init's structure"
        _check_quantized(sent, value, n)
        # Idempotence: Q(Q(x)) = Q(x) where not saturated.
        again = np.asarray(quantizer.step(state, sent.value)[1].value)
        usable = np.isfinite(sent.error)
        off = np.abs(again - sent.value)[usable] > ROUNDING * np.abs(value)[usable]
        assert not np.any(off), f"step {k}: expected what was delivered to be delivered again"
        # The same compiled and batched.
        with jax.enable_x64(True):
            batch = jax.tree.map(lambda leaf: jnp.stack([leaf, leaf]), (state, jnp.asarray(value)))
            _, twice = compiled(*batch)
        for name, item in sent._asdict().items():
            both = np.asarray(getattr(twice, name))
            same = np.allclose(both, item, rtol=ROUNDING, atol=0, equal_nan=True)
            assert same, f"step {k}, {name}: expected the same under jit and vmap"
        state = following


def _check_quantized(sent: Quantized, value: np.ndarray, n: int) -> None:
    assert all(np.shape(part) == (n,) for part in sent), f"step: expected parts of shape ({n},)"
    unusable = np.asarray(sent.saturated) | np.isnan(value)
    assert np.array_equal(np.isnan(sent.error), unusable), "error: expected NaN where saturated or NaN, and only there"
    assert np.array_equal(np.isnan(sent.value), np.isnan(value)), "value: expected NaN for NaN, and only there"
    assert np.all(np.asarray(sent.symbols) >= 1), "symbols: expected at least one"
    excess = (np.abs(sent.value - value) - sent.error * (1 + ROUNDING))[~unusable]
    assert np.all(excess <= 0), f"error: expected a bound, exceeded by {excess.max(initial=0.0):g}"
