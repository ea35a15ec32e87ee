"""Two hundred fits from starts that are far off, against Nelder and Mead from the truth and from ten other starts.

Run: python benchmarks/fits.py [SERIES]. Rows are written to benchmarks/fits.json as they come, so that a run that was
stopped goes on; delete the file to begin anew.

Trends, lines, local levels and walks (also with a variance of 0), first-order autoregressions, alternations,
Gauss-Markov processes, means, biases and level shifts far from the start. Starts of variances are wrong by factors of
up to a thousand, those of means by up to 10,000. A fit must end at most 1e-3 nats
below the best of the eleven searches, or say that it did not converge; series without a maximum (an exact line, an
exact alternation) must not be said to have converged. Writes benchmarks/fits.json; ends with an error otherwise.
"""

import json
import sys
import time
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from scipy.optimize import minimize

import heliograph as hg

SERIES, STEPS, NATS = 200, 100, 1e-3
RESULTS = Path(__file__).with_suffix(".json")
VAGUE = 1e4


class Model(NamedTuple):
    """x+ = F x + B u + w with Cov w = diag q, z = H x + v with Var v = r, x ~ (m0, P0) before the first step."""

    F: Any
    q: Any
    r: Any
    m0: Any
    P0: Any
    H: Any
    B: Any = None


class Family(NamedTuple):
    """Models of free numbers, positive (p) or real (r); laws of the truth and of the starts; times of an input of 1."""

    kinds: str
    model: Callable[[Any], Model]
    truth: Callable[[np.random.Generator], Any]
    real_start: float = 0.0
    shifts: bool = False


def scalar(f: Any, q: Any, r: Any, m0: Any = 0.0, start: float = VAGUE, b: Any = None) -> Model:
    """One state."""
    return Model([[f]], [q], r, [m0], [[start]], [[1.0]], b)


def trend(t: Any) -> Model:
    """A level with a slope."""
    return Model([[1.0, 1.0], [0.0, 1.0]], [t[0], t[1]], t[2], [0.0, 0.0], VAGUE * np.eye(2), [[1.0, 0.0]])


def biased(t: Any) -> Model:
    """An autoregression whose sensor has a bias."""
    return Model([[t[1], 0.0], [0.0, 1.0]], [t[2], 1e-9], t[3], [0.0, t[0]], np.diag([1.0, 1e-9]), [[1.0, 1.0]])


def gauss_markov(t: Any) -> Model:
    """A process with a time constant and a variance, sampled every 0.1."""
    kept = jnp.exp(-0.1 / t[0])
    return scalar(kept, t[1] * (1 - kept**2), t[2], start=1.0)


def sizes(low: float, high: float, count: int) -> Callable[[np.random.Generator], Any]:
    """Positive numbers, uniform in their logarithm."""
    return lambda g: np.exp(g.uniform(low, high, count))


FAMILIES = {
    "level": Family("pp", lambda t: scalar(1.0, *t), sizes(-6, 2, 2)),
    "constant": Family("pp", lambda t: scalar(1.0, *t), lambda g: np.array([1e-12, 1.0])),
    "walk": Family("pp", lambda t: scalar(1.0, *t), lambda g: np.array([1.0, 1e-12])),
    "trend": Family("ppp", trend, sizes(-5, 1, 3)),
    "line": Family("ppp", trend, lambda g: np.array([1e-14, 1e-14, np.exp(g.uniform(-5, 1))])),
    "autoregression": Family(
        "rpp",
        lambda t: scalar(t[0], t[1], t[2], start=1.0),
        lambda g: np.array([g.uniform(-0.95, 0.98), *sizes(-3, 1, 2)(g)]),
        0.5,
    ),
    "alternation": Family(
        "rpp",
        lambda t: scalar(t[0], t[1], t[2], start=1.0),
        lambda g: np.array([-0.995, 1e-3, np.exp(g.uniform(-5, 0))]),
        0.5,
    ),
    "gauss_markov": Family("ppp", gauss_markov, sizes(-2, 1, 3)),
    "mean": Family(
        "rpp",
        lambda t: scalar(1.0, t[1], t[2], t[0], 1.0),
        lambda g: np.array([g.choice([-300.0, 400.0, 1e4]), *sizes(-3, 1, 2)(g)]),
    ),
    "shift": Family(
        "rpp",
        lambda t: scalar(1.0, t[1], t[2], b=[[t[0]]]),
        lambda g: np.array([g.choice([-300.0, 400.0, 25.0]), *sizes(-4, 1, 2)(g)]),
        shifts=True,
    ),
    "bias": Family(
        "rrpp",
        biased,
        lambda g: np.array([g.normal() * g.choice([1, 100]), g.uniform(0.3, 0.9), *sizes(-2, 1, 2)(g)]),
    ),
}  # fmt: skip


class Case(NamedTuple):
    """A series of a family, the numbers of its world, and where a fit is to start."""

    family: Family
    truth: np.ndarray
    start: np.ndarray
    z: np.ndarray
    u: np.ndarray


def case(name: str, seed: int, steps: int = STEPS) -> Case:
    """Draw numbers, a series and a start."""
    family, g = FAMILIES[name], np.random.default_rng([seed, list(FAMILIES).index(name)])
    truth = np.asarray(family.truth(g), dtype=float)
    m = family.model(list(truth))
    f, q, h = np.asarray(m.F, dtype=float), np.asarray(m.q, dtype=float), np.asarray(m.H)[0]
    b = np.zeros(len(f)) if m.B is None else np.asarray(m.B, dtype=float)[:, 0]
    u = (np.arange(steps) == steps // 2) * float(family.shifts)
    x, z = np.asarray(m.m0, dtype=float), np.zeros(steps)
    for k in range(steps):
        x = f @ x + b * u[k] + np.sqrt(q) * g.normal(size=len(f))
        z[k] = h @ x + np.sqrt(float(m.r)) * g.normal()
    start = [np.exp(g.uniform(-7, 7)) if kind == "p" else family.real_start for kind in family.kinds]
    return Case(family, truth, np.array(start), z, u)


def network(family: Family, start: np.ndarray) -> hg.Network:
    """The network whose numbers are free."""
    kinds = zip(start, family.kinds, strict=True)
    free = [hg.free(float(at), f"t{i}", "positive" if kind == "p" else None) for i, (at, kind) in enumerate(kinds)]
    m = family.model(free)
    noise = hg.random_affine.Independent([hg.Gaussian([[q]]) for q in m.q])
    inputs = {} if m.B is None else {"input_matrix": m.B}
    plant = hg.LinearPlant(jnp.array(m.F), noise, jnp.array(m.m0), m.P0, **inputs)
    return hg.Network(plant, {"a": hg.Node(hg.LinearSensor(m.H, m.r), hg.perfect(), {})})


def fitted(one: Case, starts: int = 6) -> Any:
    """Fit the series."""
    inputs = one.u[:, None] if one.family.shifts else None
    return hg.fit(lambda: network(one.family, one.start), one.z[:, None], inputs, starts)


@cache
def likelihood(family: Family) -> Callable[[Any, Any, Any], Any]:
    """The Kalman filter's log-likelihood as a function of the numbers (positive ones by their logarithms), z and u."""

    def total(x: Any, z: Any, u: Any) -> Any:
        m = family.model([jnp.exp(v) if kind == "p" else v for kind, v in zip(family.kinds, x, strict=True)])
        f, q, h = jnp.array(m.F), jnp.diag(jnp.array(m.q)), jnp.array(m.H)[0]
        b = jnp.zeros(len(f)) if m.B is None else jnp.array(m.B)[:, 0]

        def step(state: Any, row: Any) -> Any:
            (mean, p), (z_k, u_k) = state, row
            mean, p = f @ mean + b * u_k, f @ p @ f.T + q
            s, e = h @ p @ h + m.r, z_k - h @ mean
            gain = p @ h / s
            return (mean + gain * e, p - jnp.outer(gain, gain) * s), -(jnp.log(2 * jnp.pi * s) + e * e / s) / 2

        start = jnp.array(m.m0, dtype=float), jnp.array(m.P0, dtype=float)
        return jax.lax.scan(step, start, (z, u))[1].sum()

    return jax.jit(total)


def reference(one: Case, total: Callable[[Any, Any, Any], Any], searches: int, seed: int) -> float:
    """The best of Nelder and Mead from the truth and from others around it."""
    rng, kinds = np.random.default_rng(seed), np.array(list(one.family.kinds))
    truth = np.where(kinds == "p", np.log(np.maximum(one.truth, 1e-10)), one.truth)

    def lack(x: np.ndarray) -> float:
        value = float(total(x, one.z, one.u))
        return -value if np.isfinite(value) else 1e300

    ends = []
    options: Any = {"xatol": 1e-6, "fatol": 1e-8, "maxfev": 3000}
    for i in range(searches):
        away = np.where(kinds == "p", rng.uniform(-3, 3, len(kinds)), 0.3 * rng.normal(size=len(kinds)))
        ends.append(minimize(lack, truth + (i > 0) * away, method="Nelder-Mead", options=options).fun)
    return -float(min(ends))


def measured(i: int) -> dict[str, Any]:
    """Fit one series of all, and say how far below the best it ended."""
    names = list(FAMILIES)
    name, seed = names[i % len(names)], i // len(names)
    one, began = case(name, seed), time.process_time()
    found = fitted(one)
    seconds = time.process_time() - began
    with jax.enable_x64(True):
        best = reference(one, likelihood(one.family), 11, seed)
    below = round(best - found.best.total, 6)
    return {"family": name, "seed": seed, "below": below, "converged": found.converged, "seconds": round(seconds, 1)}


def summary(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Count the fits within NATS of the best, above it and below it, and claims of a maximum where there is none."""
    n = np.arange(STEPS)
    endless = {"trend": 0.3 * n, "autoregression": (-1.0) ** n}
    claimed = [name for name, z in endless.items() if fitted(case(name, 0)._replace(z=z)).converged]
    return {
        "series": len(rows),
        "within": sum(abs(row["below"]) <= NATS for row in rows),
        "higher": sum(row["below"] < -NATS for row in rows),
        "lower": sum(row["below"] > NATS for row in rows),
        "lower_and_converged": sum(row["below"] > NATS and row["converged"] for row in rows),
        "not_converged": sum(not row["converged"] for row in rows),
        "worst": max(row["below"] for row in rows),
        "highest": -min(row["below"] for row in rows),
        "endless_said_to_converge": claimed,
    }


def main(count: int) -> None:
    """Fit what is not yet fitted, write how far each ended below the best, and judge all."""
    rows = json.loads(RESULTS.read_text(encoding="utf-8"))["rows"] if RESULTS.exists() else []
    for i in range(len(rows), count):
        rows.append(measured(i))
        print(rows[-1], flush=True)
        RESULTS.write_text(json.dumps({"rows": rows}) + "\n", encoding="utf-8")
    content = summary(rows)
    lines = ",\n  ".join(json.dumps(row) for row in rows)
    RESULTS.write_text(f'{{"summary": {json.dumps(content)},\n "rows": [\n  {lines}]}}\n', encoding="utf-8")
    print(json.dumps(content, indent=1))
    if content["lower_and_converged"] or content["endless_said_to_converge"]:
        raise SystemExit("fits: some ended below the best and said that they converged")


if __name__ == "__main__":
    main(int(sys.argv[1]) if len(sys.argv) > 1 else SERIES)
