"""No step raises a floating-point flag of an invalid operation: a device may stop at one."""

import subprocess

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from tests.export.device import COMPILER, FLAGS, needs_compiler

LINE = hg.LinearPlant([[1, 0.1], [0, 0.95]], 0.02 * np.eye(2), [1.0, 2.0], np.eye(2), [[0.0], [0.1]])
CURVE = hg.Sensor(lambda x: jnp.array([jnp.sqrt(1 + x[0] ** 2), jnp.interp(x[1], jnp.arange(4.0), jnp.arange(4.0))]),
                  0.05 * np.eye(2))  # fmt: skip
BOTH = hg.LinearSensor([[1.0, 0.3], [0.0, 1.0]], 0.05 * np.eye(2))
FILTERS = {
    "kalman": lambda: hg.kalman_filter(LINE, BOTH),
    "extended": lambda: hg.extended_filter(LINE, CURVE),
    "cubature": lambda: hg.cubature_filter(LINE, CURVE),
    "gate": lambda: hg.robust_filter(LINE, CURVE, hg.perfect(2), hg.filters.Gate(13.8)),
    "Huber": lambda: hg.robust_filter(LINE, CURVE, hg.perfect(2), hg.filters.Huber(1.345)),
    "told": lambda: hg.linear_filter(LINE, BOTH, hg.hop(hg.Rayleigh(0.8), 0.1 * np.eye(2), dimension=2, known=True)),
}
MAIN = """
#include <fenv.h>
#include <math.h>
#include "step.h"
int main(void)
{{
    static step_state state;
    step_start(&state);
    for (int k = 0; k < 200; ++k) {{
        {real} z[8], u[1] = {{0.1f}};
        for (int i = 0; i < 8; ++i) z[i] = (k >> i) & 1 ? NAN : 1.5f;
        feclearexcept(FE_ALL_EXCEPT);
        if (step_step(&state, z, u)) return 1;
        if (fetestexcept(FE_INVALID | FE_DIVBYZERO | FE_OVERFLOW)) return 2;
    }}
    return 0;
}}
"""


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("precision", ["double", "float"])
@pytest.mark.parametrize("name", FILTERS)
def test_a_missing_value_raises_no_flag(name, precision, tmp_path):
    """Every pattern of what did not arrive; without optimisation, which might leave an operation out."""
    hg.export_c(FILTERS[name](), tmp_path / "step.c", precision)
    (tmp_path / "main.c").write_text(MAIN.format(real=precision))
    for optimisation in ("-O0", "-O2"):
        command = [COMPILER, *FLAGS[:-1], optimisation, "-Wno-unknown-pragmas", "main.c", "step.c", "-lm", "-o", "main"]
        subprocess.run(command, cwd=tmp_path, check=True)
        assert subprocess.run([str(tmp_path / "main")], check=False).returncode == 0
