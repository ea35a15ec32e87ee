"""Time of an exported extended Kalman filter, beside one in C by hand that does what TinyEKF does.

Run: python benchmarks/export.py [--header tinyekf.h]. Needs a C compiler (cc). Nanoseconds of a step, by best of nine.

The problem is TinyEKF's example: eight states (position, velocity, clock offset and drift), four pseudo-ranges of
moving satellites, 25 steps. TinyEKF itself is no part of this repository: unless `--header` names a copy of it, the
peer is a re-statement of it, written here: loops over dense matrices, Cholesky's inverse, P = (I - G H) P. The Jacobian
of the ranges is the true one in both. Times count only after both estimates agree to 1e-6 m and 1e-6 m/s. More than
some 80 steps could not be compared: without a symmetric P the peer's innovation covariance is then indefinite.
"""

import argparse
import subprocess
import tempfile
from pathlib import Path
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import heliograph as hg

STEPS = 25
ROUNDS = 800
FLAGS = ("-std=c99", "-O2", "-D_POSIX_C_SOURCE=199309L")
AGREEMENT = 1e-6

START = np.array([-2168816.2, 0.0, 4386648.5, 0.0, 4077161.6, 0.0, 3575261.2, 45.49])
PROCESS = np.kron(np.diag([1.0, 1.0, 1.0, 0.0]), 25.0 * np.array([[1 / 3, 1 / 2], [1 / 2, 1.0]]))
PROCESS[6:, 6:] = [[36.0 + 0.01 / 3, 0.01 / 2], [0.01 / 2, 0.01]]


class Ranges(eqx.Module):
    """Distances to satellites at `positions` (4, 3), and the clock's offset."""

    positions: Any

    def __call__(self, x: jax.Array) -> jax.Array:
        """The four pseudo-ranges."""
        apart = jnp.stack([x[0], x[2], x[4]]) - self.positions
        return jnp.sqrt(jnp.sum(apart**2, axis=1)) + x[6]


def satellites() -> np.ndarray:
    """Positions (STEPS, 4, 3): circles of 26,600 km around the earth's centre, once in half a day."""
    angle = np.array([0.0, 0.9, 1.9, 3.1])[None] + 2 * np.pi * np.arange(STEPS)[:, None] / 43200
    tilt = np.array([0.3, 0.9, -0.5, 1.3])
    circle = np.stack([np.cos(angle), np.sin(angle) * np.cos(tilt), np.sin(angle) * np.sin(tilt)], axis=2)
    return np.asarray(2.66e7 * circle)


def filter_of(positions: np.ndarray) -> hg.filters.AbstractFilter:
    """The extended filter of the problem."""
    transition = np.kron(np.eye(4), [[1.0, 1.0], [0.0, 1.0]])
    plant = hg.LinearPlant(transition, PROCESS, START, 10 * np.eye(8))
    sensors = [hg.Sensor(Ranges(p), 36.0 * np.eye(4)) for p in positions]
    return hg.extended_filter(plant, hg.model.over_time(sensors), hg.perfect(4))


def measurements(positions: np.ndarray) -> np.ndarray:
    """Of a receiver at rest whose clock drifts evenly."""
    ranges = np.sqrt(np.sum((START[[0, 2, 4]] - positions) ** 2, axis=2))
    clock = START[6] + START[7] * (1 + np.arange(STEPS))
    return np.asarray(ranges + clock[:, None] + 6.0 * np.random.default_rng(0).normal(size=(STEPS, 4)))


def table(name: str, values: np.ndarray) -> str:
    """A table in C."""
    numbers = ", ".join(map(repr, values.ravel().tolist()))
    return f"static const double {name}[{values.size}] = {{{numbers}}};\n"


OURS = """
#include "ours.h"
static ours_state state;
static void begin(void) { ours_start(&state); }
static int step(int k) { return ours_step(&state, z_table + 4 * k, (const double *)0); }
static const double *mean(void) { return ours_mean(&state); }
"""

MODEL = """
#include <math.h>
static ekf_t ekf;
static void begin(void)
{
    const double pdiag[8] = {10, 10, 10, 10, 10, 10, 10, 10};
    ekf_initialize(&ekf, pdiag);
    for (int i = 0; i < 8; ++i) ekf.x[i] = start[i];
}
static int step(int k)
{
    double fx[8] = {0}, F[64] = {0}, hx[4] = {0}, H[32] = {0};
    const double *s = positions + 12 * k;
    for (int j = 0; j < 8; j += 2) {
        fx[j] = ekf.x[j] + ekf.x[j + 1];
        fx[j + 1] = ekf.x[j + 1];
        F[9 * j] = F[9 * j + 9] = F[9 * j + 1] = 1;
    }
    for (int i = 0; i < 4; ++i) {
        double d[3], square = 0;
        for (int j = 0; j < 3; ++j) {
            d[j] = fx[2 * j] - s[3 * i + j];
            square += d[j] * d[j];
        }
        double range = sqrt(square);
        hx[i] = range + fx[6];
        for (int j = 0; j < 3; ++j) H[8 * i + 2 * j] = d[j] / range;
        H[8 * i + 6] = 1;
    }
    ekf_predict(&ekf, fx, F, process);
    return !ekf_update(&ekf, z_table + 4 * k, hx, H, noise);
}
static const double *mean(void) { return ekf.x; }
"""

# The same operations in the same order of loops as TinyEKF, written anew.
PEER = """
#include <math.h>
#include <string.h>
enum { N = 8, M = 4 };
typedef struct { double x[N]; double P[N * N]; } ekf_t;

static void product(const double *a, const double *b, double *c, int n, int k, int m)
{
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < m; ++j) {
            c[i * m + j] = 0;
            for (int l = 0; l < k; ++l) c[i * m + j] += a[i * k + l] * b[l * m + j];
        }
}
static void transposed(const double *a, double *b, int n, int m)
{
    for (int i = 0; i < n; ++i)
        for (int j = 0; j < m; ++j) b[j * n + i] = a[i * m + j];
}
static int inverse(const double *a, double *b)
{
    double l[M * M], d[M];
    memcpy(l, a, sizeof l);
    for (int i = 0; i < M; ++i)
        for (int j = i; j < M; ++j) {
            double sum = l[i * M + j];
            for (int k = i - 1; k >= 0; --k) sum -= l[i * M + k] * l[j * M + k];
            if (i == j) {
                if (sum <= 0) return 1;
                d[i] = sqrt(sum);
            } else {
                l[j * M + i] = sum / d[i];
            }
        }
    for (int i = 0; i < M; ++i) {
        l[i * M + i] = 1 / d[i];
        for (int j = i + 1; j < M; ++j) {
            double sum = 0;
            for (int k = i; k < j; ++k) sum -= l[j * M + k] * l[k * M + i];
            l[j * M + i] = sum / d[j];
        }
    }
    for (int i = 0; i < M; ++i)
        for (int j = i; j < M; ++j) {
            double sum = 0;
            for (int k = j; k < M; ++k) sum += l[k * M + i] * l[k * M + j];
            b[i * M + j] = b[j * M + i] = sum;
        }
    return 0;
}
static void ekf_initialize(ekf_t *ekf, const double *pdiag)
{
    memset(ekf, 0, sizeof *ekf);
    for (int i = 0; i < N; ++i) ekf->P[i * N + i] = pdiag[i];
}
static void ekf_predict(ekf_t *ekf, const double *fx, const double *F, const double *Q)
{
    double FP[N * N], Ft[N * N];
    memcpy(ekf->x, fx, sizeof ekf->x);
    product(F, ekf->P, FP, N, N, N);
    transposed(F, Ft, N, N);
    product(FP, Ft, ekf->P, N, N, N);
    for (int i = 0; i < N * N; ++i) ekf->P[i] += Q[i];
}
static int ekf_update(ekf_t *ekf, const double *z, const double *hx, const double *H, const double *R)
{
    double G[N * M], Ht[N * M], PHt[N * M], HP[M * N], S[M * M], Si[M * M], GH[N * N], after[N * N];
    transposed(H, Ht, M, N);
    product(ekf->P, Ht, PHt, N, N, M);
    product(H, ekf->P, HP, M, N, N);
    product(HP, Ht, S, M, N, M);
    for (int i = 0; i < M * M; ++i) S[i] += R[i];
    if (inverse(S, Si)) return 0;
    product(PHt, Si, G, N, M, M);
    for (int i = 0; i < N; ++i)
        for (int j = 0; j < M; ++j) ekf->x[i] += G[i * M + j] * (z[j] - hx[j]);
    product(G, H, GH, N, M, N);
    for (int i = 0; i < N * N; ++i) GH[i] = -GH[i];
    for (int i = 0; i < N; ++i) GH[i * N + i] += 1;
    product(GH, ekf->P, after, N, N, N);
    memcpy(ekf->P, after, sizeof after);
    return 1;
}
"""

MAIN = """
#include <stdio.h>
#include <time.h>
int main(void)
{
    double best = 1e30;
    for (int r = 0; r < 9; ++r) {
        struct timespec a, b;
        clock_gettime(CLOCK_MONOTONIC, &a);
        for (int n = 0; n < ROUNDS; ++n) {
            begin();
            for (int k = 0; k < STEPS; ++k)
                if (step(k)) return 1;
        }
        clock_gettime(CLOCK_MONOTONIC, &b);
        double spent = 1e9 * (double)(b.tv_sec - a.tv_sec) + (double)(b.tv_nsec - a.tv_nsec);
        if (spent < best) best = spent;
    }
    printf("%.1f", best / ROUNDS / STEPS);
    for (int i = 0; i < 8; ++i) printf(" %.17g", mean()[i]);
    return 0;
}
"""


def timed(folder: Path, name: str, text: str, *sources: str) -> tuple[float, np.ndarray]:
    """Nanoseconds of a step, and the last mean."""
    (folder / f"{name}_main.c").write_text(text)
    numbers = (f"-DSTEPS={STEPS}", f"-DROUNDS={ROUNDS}")
    subprocess.run(["cc", *FLAGS, *numbers, f"{name}_main.c", *sources, "-lm", "-o", name], cwd=folder, check=True)
    said = subprocess.run([str(folder / name)], check=True, capture_output=True, text=True).stdout.split()
    return float(said[0]), np.array(said[1:], dtype=float)


def measure(header: Path | None) -> dict[str, float]:
    """Nanoseconds of both, after their estimates agree."""
    positions = satellites()
    z = measurements(positions)
    with tempfile.TemporaryDirectory() as place:
        folder = Path(place)
        written = hg.export_c(filter_of(positions), folder / "ours.c")
        data = table("z_table", z)
        ours, mean = timed(folder, "exported", data + OURS + MAIN, "ours.c")
        data += table("positions", positions) + table("process", PROCESS) + table("noise", 36.0 * np.eye(4))
        data += table("start", START)
        peer = PEER
        if header is not None:
            peer = f"#define EKF_N 8\n#define EKF_M 4\n#define _float_t double\n{header.read_text()}\n"
        theirs, other = timed(folder, "peer", data + peer + MODEL + MAIN)
    gap = float(np.max(np.abs(mean - other)))
    if not gap <= AGREEMENT:
        raise SystemExit(f"peer: expected its estimate within {AGREEMENT} of ours, got {gap:.3g}")
    return {"exported": ours, "by hand, dense": theirs, "operations": float(sum(written.operations.values()))}


def main() -> None:
    """Print both times."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--header", type=Path, help="a copy of tinyekf.h to be timed instead of the re-statement")
    chosen = parser.parse_args().header
    result = measure(chosen)
    ratio = result["by hand, dense"] / result["exported"]
    title = "a re-statement of TinyEKF by hand" if chosen is None else f"TinyEKF ({chosen.name})"
    print(f"exported: {result['exported']:.0f} ns a step, {result['operations']:.0f} operations")
    print(f"{title}: {result['by hand, dense']:.0f} ns a step, {ratio:.2f} times ours")


if __name__ == "__main__":
    main()
