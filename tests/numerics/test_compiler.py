"""What the compiler is asked, and by whom it is overruled."""

import jax
import pytest

from heliograph.numerics.compiler import LEVEL, OPTIONS, understood


@pytest.mark.parametrize("least", [False, True])
def test_who_asks_for_next_to_no_optimisation_gets_it(least):
    """An option of one program goes before JAX's own setting, which therefore must be looked at."""
    before = jax.config.values["jax_disable_most_optimizations"]
    jax.config.update("jax_disable_most_optimizations", least)
    try:
        options = understood.__wrapped__()
    finally:
        jax.config.update("jax_disable_most_optimizations", before)
    wanted = {name: value for name, value in OPTIONS.items() if not (least and name == LEVEL)}
    assert options in (wanted, {})  # none where this release of the compiler has others
