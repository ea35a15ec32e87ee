"""Processor time of straightline on three examples that are no filters, beside C by hand, Numba and JAX.

Run: python benchmarks/native_code.py. Writes benchmarks/native_code.json. Needs a C compiler (cc); Numba is no
dependency, and is left out where it is not installed. Each round computes everything once, and a time is the least of
ROUNDS, in seconds of processor (all threads), so that other programs disturb little; what is compared is their ratio.

`ode`: ten steps of Runge-Kutta of order four of Lorenz's system for a million particles. `option`: the price of an
Asian option, 50 normal draws a path; straightline and JAX draw by Threefry with JAX's keys, C by xoshiro256+ and the
polar method, Numba by its own generator. `controller`: steps of a controller: its C by hand or by `to_c`, called from a
loop in C, and calls of one step from Python. `float32` is straightline in single precision. Times count only after
results agree: to 1e-10 of each particle and of the controller's last output, in float32 to 1e-4, and to five deviations
of the price.
"""

import ctypes
import json
import platform
import subprocess
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

import straightline

PARTICLES, TURNS, PATHS, DRAWS = 1_000_000, 10, 200_000, 50
CALLS, LOOPS, ROUNDS = 20_000, 5_000_000, 5
FLAGS = ("-std=c99", "-O3", "-march=native", "-D_POSIX_C_SOURCE=199309L")
RESULTS = Path(__file__).with_suffix(".json")
DT, SPOT, STRIKE, RATE, VOLATILITY = 0.01, 100.0, 100.0, 0.03, 0.2


def lorenz(x: jax.Array) -> jax.Array:
    """Right-hand side of Lorenz's system."""
    return jnp.stack([10 * (x[1] - x[0]), x[0] * (28 - x[2]) - x[1], x[0] * x[1] - 8 / 3 * x[2]])


def advanced(x: jax.Array) -> jax.Array:
    """Ten steps of Runge-Kutta of order four."""

    def step(_: Any, x: jax.Array) -> jax.Array:
        a = lorenz(x)
        b = lorenz(x + DT / 2 * a)
        c = lorenz(x + DT / 2 * b)
        return x + DT / 6 * (a + 2 * b + 2 * c + lorenz(x + DT * c))

    return jax.lax.fori_loop(0, TURNS, step, x)


def payoff(key: jax.Array, number: jax.Array) -> tuple[Any, Any]:
    """Discounted payoff of one path, and its square: max(mean of the prices - strike, 0) exp(-rate)."""
    z = jax.random.normal(jax.random.fold_in(key, number), (DRAWS,))
    drift, spread = (RATE - VOLATILITY**2 / 2) / DRAWS, VOLATILITY / DRAWS**0.5
    prices = SPOT * jnp.exp(jnp.cumsum(drift + spread * z))
    value = jnp.exp(-RATE) * jnp.maximum(jnp.mean(prices) - STRIKE, 0.0)
    return (value, value**2), ()


def controller(state: jax.Array, error: jax.Array) -> tuple[jax.Array, jax.Array]:
    """PID with a bounded integral and output; state: the integral, the filtered derivative, the last error."""
    integral = jnp.clip(state[0] + 0.01 * error, -1.0, 1.0)
    derivative = 0.9 * state[1] + 0.1 * (error - state[2]) / 0.01
    u = jnp.clip(8.0 * error + 2.0 * integral + 0.3 * derivative, -10.0, 10.0)
    return jnp.stack([integral, derivative, error]), u


BY_HAND = """
#include <math.h>
#include <stdint.h>
#include <time.h>

static void lorenz(const double *x, double *d)
{
    d[0] = 10 * (x[1] - x[0]);
    d[1] = x[0] * (28 - x[2]) - x[1];
    d[2] = x[0] * x[1] - 8.0 / 3 * x[2];
}

void ode(double *restrict y, const double *restrict x, long count)
{
    for (long p = 0; p < count; ++p) {
        double s[3] = {x[3 * p], x[3 * p + 1], x[3 * p + 2]}, a[3], b[3], c[3], d[3], t[3];
        for (int turn = 0; turn < TURNS; ++turn) {
            lorenz(s, a);
            for (int i = 0; i < 3; ++i) t[i] = s[i] + DT / 2 * a[i];
            lorenz(t, b);
            for (int i = 0; i < 3; ++i) t[i] = s[i] + DT / 2 * b[i];
            lorenz(t, c);
            for (int i = 0; i < 3; ++i) t[i] = s[i] + DT * c[i];
            lorenz(t, d);
            for (int i = 0; i < 3; ++i) s[i] += DT / 6 * (a[i] + 2 * b[i] + 2 * c[i] + d[i]);
        }
        for (int i = 0; i < 3; ++i) y[3 * p + i] = s[i];
    }
}

static uint64_t s[4] = {1, 2, 3, 4};

static double uniform(void)
{
    const uint64_t result = s[0] + s[3], t = s[1] << 17;
    s[2] ^= s[0];
    s[3] ^= s[1];
    s[1] ^= s[2];
    s[0] ^= s[3];
    s[2] ^= t;
    s[3] = (s[3] << 45) | (s[3] >> 19);
    return (double)(result >> 11) * 0x1p-53;
}

static double normal(void)
{
    static double spare;
    static int has_spare;
    if (has_spare) {
        has_spare = 0;
        return spare;
    }
    double u, v, r;
    do {
        u = 2 * uniform() - 1;
        v = 2 * uniform() - 1;
        r = u * u + v * v;
    } while (r >= 1 || r == 0);
    const double factor = sqrt(-2 * log(r) / r);
    spare = v * factor;
    has_spare = 1;
    return u * factor;
}

void option(double *sums, long paths)
{
    const double drift = (RATE - VOLATILITY * VOLATILITY / 2) / DRAWS, spread = VOLATILITY / sqrt(DRAWS);
    double total = 0, squares = 0;
    for (long p = 0; p < paths; ++p) {
        double logarithm = 0, mean = 0;
        for (int k = 0; k < DRAWS; ++k) {
            logarithm += drift + spread * normal();
            mean += SPOT * exp(logarithm);
        }
        const double value = exp(-RATE) * fmax(mean / DRAWS - STRIKE, 0);
        total += value;
        squares += value * value;
    }
    sums[0] = total;
    sums[1] = squares;
}
"""
CONTROLLER = """
static double clip(double x) { return x < -1 ? -1 : x > 1 ? 1 : x; }

void by_hand(const double state[3], double error, double after[3], double u[1])
{
    const double integral = clip(state[0] + 0.01 * error);
    const double derivative = 0.9 * state[1] + 0.1 * (error - state[2]) / 0.01;
    const double sum = 8 * error + 2 * integral + 0.3 * derivative;
    after[0] = integral;
    after[1] = derivative;
    after[2] = error;
    u[0] = sum < -10 ? -10 : sum > 10 ? 10 : sum;
}
"""
LOOP = """
void NAME(const double state[3], double error, double after[3], double u[1]);

double loop_NAME(long count, double *last)
{
    double state[3] = {0, 0, 0}, u[1] = {0}, sum = 0;
    for (long k = 0; k < count; ++k) {
        NAME(state, 0.01 * (double)(k % 7) - 0.1 * u[0], state, u);
        sum += u[0];
    }
    last[0] = u[0];
    return sum;
}
"""


def library(folder: Path) -> ctypes.CDLL:
    """What is written in C, compiled; each controller in a file of its own, as on a device."""
    made = straightline.to_c(controller, np.zeros(3), 0.0, name="made")
    numbers = {"TURNS": TURNS, "DT": DT, "DRAWS": DRAWS, "SPOT": SPOT, "STRIKE": STRIKE, "RATE": RATE}
    defined = "".join(f"#define {name} {value}\n" for name, value in (numbers | {"VOLATILITY": VOLATILITY}).items())
    files = {
        "hand.c": defined + BY_HAND,
        "controller.c": CONTROLLER,
        "made.c": made.source,
        "made.h": made.header,
        "loops.c": "".join(LOOP.replace("NAME", name) for name in ("by_hand", "made")),
    }
    for name, text in files.items():
        (folder / name).write_text(text)
    sources = [name for name in files if name.endswith(".c")]
    subprocess.run(["cc", *FLAGS, "-shared", "-fPIC", *sources, "-o", "all.so", "-lm"], cwd=folder, check=True)
    loaded = ctypes.CDLL(str(folder / "all.so"))
    for name in ("loop_by_hand", "loop_made"):
        getattr(loaded, name).restype = ctypes.c_double
    return loaded


def pointer(array: np.ndarray) -> ctypes.c_void_p:
    """The address of an array."""
    return ctypes.c_void_p(array.ctypes.data)


Way = Callable[[], Any]  # computes one example, and returns what the ways must agree in


def odes(c: ctypes.CDLL) -> dict[str, Way]:
    """Ways to advance the particles; each returns them."""
    x = np.random.default_rng(0).normal(size=(PARTICLES, 3))
    code, by_jax = straightline.compile(advanced, x[0]), jax.jit(jax.vmap(advanced))
    floats, single = x.astype(np.float32), straightline.compile(advanced, x[0], single=True)

    def by_hand() -> np.ndarray:
        y = np.empty_like(x)
        c.ode(pointer(y), pointer(x), ctypes.c_long(PARTICLES))
        return y

    ways: dict[str, Way] = {"straightline": lambda: code(x), "c": by_hand, "jax": lambda: np.asarray(by_jax(x))}
    ways["float32"] = lambda: single(floats)
    if (numba := compiled_by_numba()) is not None:
        ways["numba"] = lambda: numba["ode"](x)
    return ways


def options(c: ctypes.CDLL) -> dict[str, Way]:
    """Ways to price the option; each returns the price and its standard error."""
    key = jax.random.key(0)
    code, single = straightline.accumulate(payoff, key), straightline.accumulate(payoff, key, single=True)
    by_jax = jax.jit(lambda key, n: jax.tree.map(jnp.sum, jax.vmap(lambda n: payoff(key, n)[0])(n)))
    numbers = np.arange(PATHS, dtype=np.uint32)

    def priced(sums: Any) -> tuple[float, float]:
        total, squares = (float(np.sum(x)) / PATHS for x in sums)
        return total, ((squares - total**2) / PATHS) ** 0.5

    def by_hand() -> tuple[float, float]:
        sums = np.empty(2)
        c.option(pointer(sums), ctypes.c_long(PATHS))
        return priced(sums)

    ways: dict[str, Way] = {
        "straightline": lambda: priced(code(key, runs=PATHS)[0]),
        "float32": lambda: priced(single(key, runs=PATHS)[0]),
        "c": by_hand,
        "jax": lambda: priced(by_jax(key, numbers)),
    }
    if (numba := compiled_by_numba()) is not None:
        ways["numba"] = lambda: priced(numba["option"](PATHS))
    return ways


def steps(c: ctypes.CDLL) -> dict[str, Way]:
    """Ways to step the controller; each returns the last output of its count of steps."""
    one, by_jax = straightline.compile_one(controller, np.zeros(3), 0.0, in_place={0: 0}), jax.jit(controller)

    def loop(name: str) -> Way:
        last = np.empty(1)

        def run() -> float:
            getattr(c, f"loop_{name}")(ctypes.c_long(LOOPS), pointer(last))
            return float(last[0])

        return run

    def in_place() -> float:
        (state, error), (_, u) = one.inputs, one.outputs
        state[...], u[...] = 0.0, 0.0
        for k in range(CALLS):
            error[...] = 0.01 * (k % 7) - 0.1 * u
            one()
        return float(u)

    def called(function: Callable[..., Any]) -> Way:
        def run() -> float:
            state, u = np.zeros(3), 0.0
            for k in range(CALLS):
                state, u = function(state, 0.01 * (k % 7) - 0.1 * float(u))
            return float(u)

        return run

    ways = {"to_c": loop("made"), "c": loop("by_hand"), "compile_one": in_place, "jax": called(by_jax)}
    if (numba := compiled_by_numba()) is not None:
        ways["numba"] = called(numba["controller"])
    return ways


def compiled_by_numba() -> dict[str, Any] | None:
    """The three examples as one writes them for Numba, None where it is not installed."""
    try:
        from native_code_numba import FUNCTIONS
    except ImportError:
        return None
    return dict(FUNCTIONS)


def measured(ways: dict[str, Way]) -> tuple[dict[str, float], dict[str, Any]]:
    """Least processor time of each way in rounds that take turns, and what each returned."""
    returned = {name: way() for name, way in ways.items()}  # compiles
    times = dict.fromkeys(ways, float("inf"))
    for _ in range(ROUNDS):
        for name, way in ways.items():
            start = time.process_time()
            way()
            times[name] = min(times[name], time.process_time() - start)
    return times, returned


def main() -> None:
    """Measure all, and write the results."""
    results: dict[str, Any] = {"machine": platform.machine(), "rounds": ROUNDS}
    with tempfile.TemporaryDirectory() as folder, jax.enable_x64(True):
        c = library(Path(folder))
        times, particles = measured(odes(c))
        for name, value in particles.items():
            error = 1e-4 if name == "float32" else 1e-10
            np.testing.assert_allclose(value, particles["c"], rtol=error, atol=error, err_msg=name)
        results["ode"] = {"ns_per_particle_step": scaled(times, PARTICLES * TURNS)}
        times, prices = measured(options(c))
        for name, (price, error) in prices.items():
            assert abs(price - prices["c"][0]) < 5 * 2**0.5 * error, (name, prices)
        results["option"] = {"ns_per_draw": scaled(times, PATHS * DRAWS)}
        times, last = measured(steps(c))
        for names in (("to_c", "c"), [n for n in last if n not in ("to_c", "c")]):
            np.testing.assert_allclose([last[n] for n in names], last[names[0]], rtol=1e-10)
        counts = {name: LOOPS if name in ("to_c", "c") else CALLS for name in times}
        results["controller"] = {"ns_per_step": {n: round(1e9 * t / counts[n], 3) for n, t in times.items()}}
    RESULTS.write_text(json.dumps(results, indent=1) + "\n")
    print(json.dumps(results, indent=1))


def scaled(times: dict[str, float], count: int) -> dict[str, float]:
    """Nanoseconds of one of so many."""
    return {name: round(1e9 * spent / count, 3) for name, spent in times.items()}


if __name__ == "__main__":
    main()
