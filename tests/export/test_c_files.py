"""A filter as C: the numbers of Python, what it refuses, and what the files hold."""

import os
import re
import shutil
import subprocess
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from tests.export.device import COMPILER, FLAGS, Device, needs_compiler
from tests.follow import apart, follow_known

README = (Path(__file__).parents[2] / "README.md").read_text()
STEPS = 10_000
LINE = hg.LinearPlant([[1, 0.1], [0, 0.95]], 0.02 * np.eye(2), [1.0, 2.0], np.eye(2), [[0.0], [0.1]])
RANGE = hg.LinearSensor([[1.0, 0.3]], 0.05)
FADING = hg.hop(hg.Rayleigh(0.8), 0.02)
TWO_GAINS = hg.hop(hg.Discrete([0.8, 1.2], [0.5, 0.5]), 0.1)


@pytest.fixture(scope="module")
def readme():
    """The network of the README, as it stands there."""
    scope: dict = {"__name__": "my_network"}
    exec(re.search(r"<!-- file: my_network.py -->\n```python\n(.*?)```", README, re.DOTALL)[1], scope)
    return scope["network"]


@pytest.fixture(scope="module")
def recording(readme):
    """10,000 steps of a cart that is held between its walls; a fifth of the components did not arrive."""
    rng, x = np.random.default_rng(1), np.array([5.0, 0.0])
    z, u = np.empty((STEPS, 2)), np.full((STEPS, 2), 0.5)
    for k in range(STEPS):
        u[k, 0] = -0.5 * (x[0] - 5) - x[1] + 0.3 * rng.normal()
        x = x + u[k, 1] * np.array([x[1], u[k, 0]]) + rng.normal(size=2) * np.sqrt([1e-4, 5e-3])
        relayed = 1.2 * (rng.rayleigh(0.8) * (x[0] + 0.1 * rng.normal()) + 0.14 * rng.normal()) + 0.1 * rng.normal()
        z[k] = relayed, 10 - x[0] + 0.1 * rng.normal()
    z[rng.random((STEPS, 2)) < 0.2] = np.nan
    return z, u


@pytest.fixture(scope="module")
def recorded(readme, recording):
    return hg.run(readme, {"cart": recording[0]}, inputs=recording[1]).estimates["cart"]


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("name", ["relay_aware", "mean_gain"])
@pytest.mark.parametrize(("precision", "most"), [("double", 1e-12), ("float", 1e-4)])
def test_the_readme_s_filters_are_those_of_run(readme, recording, recorded, tmp_path, name, precision, most):
    """In deviations. Single precision: the mean itself, up to 10 m, is known to 6e-7 m, 1e-5 of its deviation."""
    device = Device(readme.nodes["cart"].filters[name], tmp_path, precision=precision)
    reference = recorded[name].mean, recorded[name].covariance
    assert max(apart(device.follow(*recording), reference)) < most


def changing():
    """A plant and a link that change from step to step."""
    plants = [hg.LinearPlant([[1, 0.1], [0, 0.9 + k / 999]], (0.01 + k / 999) * np.eye(2), [1, 2], np.eye(2),
                             [[0], [0.1]]) for k in range(30)]  # fmt: skip
    hops = [hg.hop(hg.Rayleigh(0.5 + k / 30), 0.02) for k in range(30)]
    return hg.linear_filter(hg.model.over_time(plants), RANGE, hg.model.over_time(hops))


def scheduled():
    """A relay that filters and forwards, as a schedule of gains."""
    plant = hg.LinearPlant(LINE.matrix, LINE.noise, LINE.initial_mean, LINE.initial_covariance)
    slots = [{"relay": {"sensor": FADING}}, {"receiver": {"relay": FADING}}]
    network = hg.model.RelayNetwork(plant, RANGE, ["relay"], slots)
    design = hg.relays.local_error_design(network, 30)
    return hg.filters.ScheduledFilter(hg.relays.relay_schedules(network, design)["relay"])


FILTERS = {
    "linear behind a random gain": lambda: hg.linear_filter(LINE, RANGE, FADING),
    "over time": changing,
    "uncertain probabilities": lambda: hg.linear_filter(
        LINE, RANGE, hg.hop(hg.Discrete([0.8, 1.2], [0.5, 0.5], 0.1), 0.1)
    ),
    "late": lambda: hg.linear_filter(LINE, RANGE, hg.model.delayed(FADING, hg.Discrete([0, 1], [0.5, 0.5]))),
    "late by one step, with a state called step": lambda: hg.linear_filter(LINE, RANGE, hg.model.delayed(FADING, 1)),
    "squares of what arrives": lambda: hg.polynomial_filter(
        hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0), hg.LinearSensor([[1.0]], 0.1), TWO_GAINS, horizon=30, degree=2
    ),
    "hidden modes": lambda: hg.linear_filter(LINE, RANGE, hg.gilbert_elliott(FADING, hg.hop(0.2, 0.05), 0.2, 0.3)),
}


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("name", FILTERS)
def test_other_filters_too(name, tmp_path):
    """To rounding over 30 steps, one of them without data."""
    item, rng = FILTERS[name](), np.random.default_rng(0)
    z, u = rng.normal(size=(30, item.received)) + 1, 0.1 * rng.normal(size=(30, len(item.inputs)))
    z[4] = np.nan
    assert max(apart(Device(item, tmp_path).follow(z, u), follow_known(item, z, u))) < 1e-12


IN_FLOAT = {  # whose numbers in double precision have no float: weights of 1e-44, 1e150 deviations, the largest double
    "a mode ruled out": lambda: hg.filters.gpb2_filter(
        LINE, RANGE, hg.gilbert_elliott(FADING, hg.hop(0.1, 0.01), 0.1, 0.3)
    ),
    "outliers": lambda: hg.robust_filter(LINE, hg.LinearSensor([[1.0, 0.3]], hg.StudentT(0.05, 4.0)), hg.perfect()),
    "stamped": lambda: hg.linear_filter(
        LINE, RANGE, hg.model.delayed(FADING, hg.Discrete([0, 1], [0.5, 0.5]), timestamped=True)
    ),
}


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("name", IN_FLOAT)
def test_single_precision_has_the_numbers_of_double(name, tmp_path):
    """To some hundred units of rounding; a mode is ruled out by 100 nats: step 4 was refused, others not exported."""
    item, rng = IN_FLOAT[name](), np.random.default_rng(0)
    z, u = rng.normal(size=(30, item.received)) + 1, 0.1 * rng.normal(size=(30, 1))
    z[4, 0], z[:, 1:] = 5.0, rng.integers(0, 2, (30, item.received - 1))
    assert max(apart(Device(item, tmp_path, precision="float").follow(z, u), follow_known(item, z, u))) < 2e-5


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize(("precision", "most"), [("double", 1e-12), ("float", 1e-5)])
def test_a_relay_s_schedule(precision, most, tmp_path):
    """Its gains and its covariance are tables: complete data, and NaN for the covariance after a gap."""
    item = scheduled()
    device, z = Device(item, tmp_path, precision=precision), np.random.default_rng(0).normal(size=(30, 1))
    z[1::2] = 0.0  # while the relay sends, it receives nothing
    assert np.isnan(device.mean()).all(), "before its first prediction a schedule estimates nothing"
    assert max(apart(device.follow(z, np.zeros((30, 0))), follow_known(item, z, np.zeros((30, 0))))) < most
    assert device.step([0.0]) == 3, "past its end"
    device = Device(item, tmp_path, name=f"again_{precision}", precision=precision)
    assert device.step([0.3]) == 0 and device.step([0.3]) == 5, "there was nothing to receive"
    device = Device(item, tmp_path, name=f"gap_{precision}", precision=precision)
    assert device.step([np.nan]) == 0 and np.isnan(device.covariance()).all() and np.isfinite(device.mean()).all()


@needs_compiler
@pytest.mark.parametrize(("precision", "turns"), [("double", 1e5), ("float", 10)])
def test_an_angle_whose_turns_leave_it_no_digits_is_refused(precision, turns, tmp_path):
    plant = hg.Plant(lambda x, u: x + 0.1, 0.1, [3.0], 1.0, states=["heading"], circular=["heading"])
    sensor = hg.Sensor(lambda x: x, 0.1, outputs=["compass"], circular=["compass"])
    device = Device(hg.extended_filter(plant, sensor, hg.perfect()), tmp_path, precision=precision)
    assert device.step([3.0 + 2 * np.pi * turns]) == 0
    before = device.mean()
    assert [device.step([z]) for z in (1e20, -1e30)] == [5, 5] and np.array_equal(device.mean(), before)


@needs_compiler
def test_what_is_refused_leaves_the_state(tmp_path):
    device = Device(changing(), tmp_path)
    assert device.step([1.0], [0.1]) == 0
    before = device.state.copy()
    for z, u, code in (([np.inf], [0.0], 1), ([1.0], [np.nan], 2), ([1.0], [-np.inf], 2)):
        assert device.step(z, u) == code
        np.testing.assert_array_equal(device.state, before)
    assert [device.step([1.0], [0.1]) for _ in range(30)] == [0] * 29 + [3]
    before = device.state.copy()
    assert device.step([1.0], [0.1]) == 3
    np.testing.assert_array_equal(device.state, before)


@needs_compiler
def test_an_estimate_that_is_no_number_is_refused(tmp_path):
    """A finite input whose square is not."""
    plant = hg.Plant(lambda x, u: 0.9 * x + u**2, 0.1, [0.0], 1.0, inputs=["u"])
    device = Device(hg.extended_filter(plant, hg.LinearSensor([[1.0]], 0.1), FADING), tmp_path)
    assert device.step([1.0], [0.5]) == 0
    before = device.state.copy()
    assert device.step([1.0], [1e200]) == 4
    np.testing.assert_array_equal(device.state, before)
    assert device.step([1.0], [0.5]) == 0 and np.isfinite(device.mean()).all()


def precise(rounding=0.0):
    """Position measured a hundred million times better than it is known; with the rounding of each number as noise."""
    noise = np.diag([rounding, 1e-6 + rounding])
    plant = hg.LinearPlant([[1, 0.1], [0, 1]], noise, [0, 0], 1e6 * np.eye(2))
    return hg.kalman_filter(plant, hg.LinearSensor([[1.0, 0.0]], 1e-2 + rounding))


SINGLE = (4 * float(np.finfo(np.float32).eps)) ** 2 * 1e6  # rounding of a number of deviation 1e3, four eps of it


MILLION = """
#include <stdio.h>
#include "step.h"
int main(void)
{
    static step_state state;
    step_start(&state);
    for (long k = 0; k < 1000000; ++k) {
        float z[1] = {(float)(k % 7 - 3)};
        if (step_step(&state, z, 0)) return 1;
        const float *p = step_covariance(&state);
        if (!(p[0] > 0 && p[3] > 0 && p[0] * p[3] > p[1] * p[2])) return 2;
    }
    printf("%.9g %.9g %.9g", step_covariance(&state)[0], step_covariance(&state)[1], step_covariance(&state)[3]);
    return 0;
}
"""


@pytest.mark.slow
@needs_compiler
def test_single_precision_keeps_variances_positive(tmp_path):
    """P_0 / R = 1e8 over a million steps; the end is the steady covariance with the rounding of states and outputs.

    That is a fifth of the process noise here; a few products are rounded themselves.
    """
    hg.export_c(precise(), tmp_path / "step.c", "float")
    (tmp_path / "main.c").write_text(MILLION)
    subprocess.run([COMPILER, *FLAGS, "main.c", "step.c", "-lm", "-o", "main"], cwd=tmp_path, check=True)
    said = subprocess.run([str(tmp_path / "main")], capture_output=True, text=True, check=True).stdout
    steady = follow_known(precise(SINGLE), np.zeros((3000, 1)), np.zeros((3000, 0))).covariance[-1]
    np.testing.assert_allclose(np.array(said.split(), float), [steady[0, 0], steady[0, 1], steady[1, 1]], rtol=1e-5)


@needs_compiler
def test_the_first_precise_measurement_keeps_its_digits(tmp_path):
    """1e6 measured with 1e-2 leaves 1e-2 in single precision too, where P - P^2 / (P + R) is nothing.

    Besides it the rounding of a position of deviation 1e3 in that precision, four eps of it.
    """
    p, r = np.float32(1e6), np.float32(1e-2)
    assert p - p * p / (p + r) == 0
    device = Device(precise(), tmp_path, precision="float")
    assert device.step([0.0]) == 0
    np.testing.assert_allclose(device.covariance()[0, 0], 1e-2 + SINGLE, rtol=1e-6)


@needs_compiler
@pytest.mark.skipif(shutil.which("nm") is None, reason="no command nm, which lists an object's symbols")
@pytest.mark.parametrize("precision", ["double", "float"])
def test_no_heap_no_variables_no_library_but_libm(readme, tmp_path, precision):
    hg.export_c(readme.nodes["cart"].filters["relay_aware"], tmp_path / "cart.c", precision)
    subprocess.run([COMPILER, *FLAGS, "-c", "cart.c", "-o", "cart.o"], cwd=tmp_path, check=True)
    listed = subprocess.run(["nm", "cart.o"], cwd=tmp_path, capture_output=True, text=True, check=True).stdout
    suffix = "" if precision == "double" else "f"
    symbols = [line.split()[-2:] for line in listed.splitlines()]
    assert {name for kind, name in symbols if kind == "U"} == {f"{f}{suffix}" for f in ("nearbyint", "sqrt")}
    assert sorted(name for kind, name in symbols if kind == "T") == [
        "cart_covariance", "cart_mean", "cart_start", "cart_step",
    ]  # fmt: skip
    assert not [name for kind, name in symbols if kind in "BbDdC"]


def test_the_files_say_what_they_are(readme, tmp_path):
    written = hg.export_c(readme.nodes["cart"].filters["relay_aware"], tmp_path / "cart.c")
    header, source = written.header.read_text(), written.source.read_text()
    for text in ("z[0]: left", "u[1]: dt", "mean[1]: velocity", "Claim: nominal", f"heliograph {hg.__version__}"):
        assert text in header
    state = "double mean[2];\n    double lower[1];\n    double variances[2];\n    double estimate_covariance[4];"
    assert f"typedef struct {{\n    {state}\n}} cart_state;" in header
    assert written.state_bytes == 72 and written.operations["mul"] < 200
    again = hg.export_c(readme.nodes["cart"].filters["relay_aware"], tmp_path / "cart.c")
    assert (again.header.read_text(), again.source.read_text()) == (header, source)
    exact = hg.export_c(hg.linear_filter(LINE, RANGE, FADING), tmp_path / "line.c")
    single = hg.export_c(hg.linear_filter(LINE, RANGE, FADING), tmp_path / "line_f.c", "float")
    assert "Claim: exact" in exact.header.read_text() and "Claim: nominal" in single.header.read_text()


def test_a_name_does_not_end_the_comment(tmp_path):
    plant = hg.LinearPlant([[0.9]], 1.0, [0.0], 1.0, states=["*/ int x; /*"])
    item = hg.kalman_filter(plant, hg.LinearSensor([[1.0]], 1.0))
    header = hg.export_c(item, tmp_path / "a.c").header.read_text()
    assert header.count("*/") == 1 and header.count("/*") == 1


def with_transition(function):
    plant = hg.Plant(function, 0.1 * np.eye(2), [0.0, 0.0], np.eye(2))
    return hg.extended_filter(plant, RANGE, FADING)


SHIFTED = with_transition(lambda x, u: jax.lax.conv(x[None, None], jnp.ones((1, 1, 1)), (1,), "SAME")[0, 0])
BEYOND = with_transition(lambda x, u: jax.scipy.special.erfinv(x / 9))


class WithCovariance(hg.filters.AbstractFilter):
    """A user's filter whose state is a mean and a covariance, which single precision may make indefinite."""

    states, inputs, received, claim = ("x",), (), 1, "nominal"

    def init(self):
        return jnp.zeros(1), jnp.eye(1)

    def predict(self, state, u, k):
        return state[0], state[1] + 0.1

    def correct(self, state, z, k):
        gain = state[1] / (state[1] + 1.0)
        return state[0] + gain[0] * (z - state[0]), (1.0 - gain) * state[1]

    def estimate(self, state):
        return hg.Estimate(*state, "nominal")


HIDDEN = hg.gilbert_elliott(FADING, hg.hop(0.2, 0.05), 0.2, 0.3)


@pytest.mark.parametrize(
    ("make", "path", "precision", "words"),
    [
        (lambda: hg.filters.particle_filter(LINE, RANGE, HIDDEN, 9), "a.c", "double", "got random_.*particle.py:"),
        (lambda: SHIFTED, "a.c", "double", r"C has, got conv_general_dilated at .*test_c_files\.py:\d+"),
        (lambda: BEYOND, "a.c", "double", r"operations that C has, got erf_inv at .*test_c_files\.py:\d+"),
        (lambda: hg.linear_filter(LINE, RANGE, FADING), "a.cpp", "double", "a name that ends in .c"),
        (lambda: hg.linear_filter(LINE, RANGE, FADING), "2a.c", "double", "a name that C takes"),
        (lambda: hg.linear_filter(LINE, RANGE, FADING), "while.c", "double", "a name that C takes"),
        (lambda: hg.linear_filter(LINE, RANGE, FADING), "no/a.c", "double", "an existing folder"),
        (lambda: hg.linear_filter(LINE, RANGE, FADING), "a.c", "half", "expected double or float, got 'half'"),
        (lambda: WithCovariance(), "a.c", "float", "or a schedule of gains, got WithCovariance"),
        (lambda: "relay_aware", "a.c", "double", "export: expected a filter"),
    ],
)  # fmt: skip
def test_one_line_and_nothing_written(make, path, precision, words, tmp_path):
    with pytest.raises(ValueError, match=words) as refused:
        hg.export_c(make(), tmp_path / path, precision)
    assert "\n" not in str(refused.value) and not list(tmp_path.iterdir())


def test_a_header_of_somebody_else_is_not_replaced(tmp_path):
    """It is written beside the source that is named: a header of that name was gone without a word."""
    item = hg.linear_filter(LINE, RANGE, FADING)
    (tmp_path / "control.h").write_text("/* mine */")
    with pytest.raises(hg.InputError, match=r"control\.h: expected a name beside control\.c that is free, or has an"):
        hg.export_c(item, tmp_path / "control.c")
    assert [p.name for p in tmp_path.iterdir()] == ["control.h"]
    (tmp_path / "control.h").unlink()
    for _ in range(2):  # the second time over its own
        hg.export_c(item, tmp_path / "control.c")


def test_both_files_or_none(tmp_path, monkeypatch):
    """The second file cannot take its place: the first is what it was before."""
    item, replace = hg.linear_filter(LINE, RANGE, FADING), os.replace
    before = "Made by heliograph"
    (tmp_path / "a.h").write_text(before)

    def full(partial, path):
        if path.suffix == ".c":
            raise OSError(28, "No space left on device")
        replace(partial, path)

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(OSError, match=r"No space left on device: '.*a\.c'"):
        hg.export_c(item, tmp_path / "a.c")
    assert [p.name for p in tmp_path.iterdir()] == ["a.h"] and (tmp_path / "a.h").read_text() == before
    (tmp_path / "a.h").unlink()
    with pytest.raises(OSError, match="No space"):
        hg.export_c(item, tmp_path / "a.c")
    assert not list(tmp_path.iterdir())


def of_inputs(noise, name="dt"):
    plant = hg.LinearPlant(lambda u: jnp.array([[1.0, u[0]], [0.0, 1.0]]), noise, [0.0, 0.0], np.eye(2), inputs=[name])
    return hg.kalman_filter(plant, hg.LinearSensor([[1.0, 0.0]], 0.04))


# One and a hundred counts back, in counts and in seconds of a counter of milliseconds or microseconds.
WRAPS = [(2.0**32 - back) * unit for back in (1, 100) for unit in (1.0, 1e-3, 1e-6)]


@needs_compiler
@pytest.mark.parametrize("precision", ["double", "float"])
def test_a_time_step_that_is_none_is_refused_as_elsewhere(precision, tmp_path):
    """Also a Q of rank 1, whose second pivot is rounding; the steps around it are as if it had never come."""
    walk = of_inputs(lambda u: 0.1 * jnp.array([[u[0] ** 4 / 4, u[0] ** 3 / 2], [u[0] ** 3 / 2, u[0] ** 2]]))
    device, clean = Device(walk, tmp_path, precision=precision), Device(walk, tmp_path, "clean", precision)
    for dt in (1.0, 0.3, 7.7, 0.0, 1e-3):
        assert device.step([1.0], [dt]) == clean.step([1.0], [dt]) == 0
        before = device.state.copy()
        for none in (-1.0, -1e-9, 2.0**32 - 2.0**20, 1e30, 2.0**60, *WRAPS):
            assert device.step([1.0], [none]) == 6
        np.testing.assert_array_equal(device.state, before)
    np.testing.assert_array_equal(device.mean(), clean.mean())
    np.testing.assert_array_equal(device.covariance(), clean.covariance())


@needs_compiler
@pytest.mark.parametrize("precision", ["double", "float"])
def test_inputs_for_which_a_function_returns_no_covariance_are_refused(precision, tmp_path):
    device = Device(of_inputs(lambda u: jnp.array([[1.0, u[0]], [u[0], 1.0]]), "s"), tmp_path, precision=precision)
    assert [device.step([1.0], [s]) for s in (0.5, 2.0, 0.5, 1.0, -1.5)] == [0, 6, 0, 0, 6]
