"""What the compiler is asked, and by whom it is overruled."""

import jax
import pytest

from heliograph.numerics import float64 as compiler
from heliograph.numerics import fully_optimised, quickly_compiled, understood


@pytest.mark.parametrize("least", [False, True])
def test_who_asks_for_next_to_no_optimisation_gets_it(least):
    """An option of one program goes before JAX's own setting, which therefore must be looked at."""
    before = jax.config.values["jax_disable_most_optimizations"]
    jax.config.update("jax_disable_most_optimizations", least)
    try:
        options = understood.__wrapped__()
    finally:
        jax.config.update("jax_disable_most_optimizations", before)
    assert (compiler.LEVEL in options) is not least


def test_an_option_of_another_release_costs_no_other(monkeypatch):
    """JAX 0.12 no longer has one that 0.10 has."""
    monkeypatch.setattr(compiler, "OPTIONS", {"xla_of_another_release": True, "xla_cpu_enable_fast_math": False})
    assert compiler.understood.__wrapped__() == {"xla_cpu_enable_fast_math": False}


@pytest.mark.parametrize(("wrap", "at_a_lower_level"), [(quickly_compiled, True), (fully_optimised, False)])
def test_only_what_runs_millions_of_steps_asks_for_the_last_level(monkeypatch, wrap, at_a_lower_level):
    requested = {}

    def jitted(function, *, donate, compiler_options):
        requested.update(compiler_options)
        return function

    monkeypatch.setattr(compiler, "understood", lambda: dict(compiler.OPTIONS))
    monkeypatch.setattr(compiler.eqx, "filter_jit", jitted)
    assert wrap(lambda x: x + 1)(1) == 2
    assert (compiler.LEVEL in requested) is at_a_lower_level
    assert "xla_cpu_use_fusion_emitters" in requested
