"""Late measurements in C: filled into their step, or into a row of their time, and run again from there."""

import shutil
import subprocess
import warnings

import jax.numpy as jnp
import numpy as np
import pytest

import heliograph as hg
from tests.export.device import COMPILER, Device, needs_compiler
from tests.export.test_apart import SENSOR, VEHICLE
from tests.export.test_c_files import changing
from tests.follow import apart, follow_known

STEPS, WINDOW = 60, 8
TURN = hg.Plant(
    lambda x, u: jnp.array([x[0] + 0.1 * x[1], 0.98 * x[1] - 0.1 * jnp.sin(x[0]) + 0.1 * u[0]]),
    np.diag([1e-4, 1e-2]), [0.3, 0.0], 0.2 * np.eye(2), inputs=["torque"],
)  # fmt: skip
ANGLES = hg.Sensor(lambda x: jnp.array([jnp.sin(x[0]), x[1]]), 0.01 * np.eye(2), outputs=["height", "rate"])
MAKERS = {"extended": hg.extended_filter, "cubature": hg.cubature_filter}
DIGITS = [("double", 1e-12), ("float", 1e-4)]
MOVE = hg.LinearPlant(
    lambda u: jnp.array([[1.0, u[0]], [0.0, 1.0]]),
    lambda u: 0.3 * jnp.array([[u[0] ** 3 / 3, u[0] ** 2 / 2], [u[0] ** 2 / 2, u[0]]]),
    [0.0, 1.0], np.eye(2), inputs=["dt"],
)  # fmt: skip
PLACE = hg.LinearSensor([[1.0, 0.0]], 0.04)


def measured(seed=3):
    """Two numbers of each step, a fifth of them lost, and how many steps late each comes: half of them at once."""
    rng = np.random.default_rng(seed)
    z = 0.3 * rng.normal(size=(STEPS, 2))
    z[rng.random(z.shape) < 0.2] = np.nan
    late = np.where(rng.random(z.shape) < 0.5, 0, rng.integers(1, WINDOW + 1, z.shape))
    return z, 0.5 * rng.normal(size=(STEPS, 1)), late


def alone(row, component):
    """One component of a row, the other NaN."""
    return [row[i] if i == component else np.nan for i in range(len(row))]


class WindowDevice(Device):
    """A device that takes late measurements."""

    def __init__(self, filter_, folder, precision="double", **options):
        super().__init__(filter_, folder, precision=precision, **{"window": WINDOW} | options)
        self.name += "_window"
        names = {"mean", "covariance"}
        self._function = lambda part: getattr(self.library, f"step_{part}" if part in names else f"step_window_{part}")

    def late(self, ago, z) -> int:
        """Give a measurement of so many steps ago, or of an age where it is no whole number."""
        z, ago = np.ascontiguousarray(z, dtype=self.real), ago if isinstance(ago, int) else self.real(ago)
        return self._function("late")(self._pointer(self.state), ago, self._pointer(z))

    @property
    def counted(self) -> list[int]:
        """Counts of what was too late, and of what was there already."""
        return self.state[-2:].tolist()


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize(("precision", "most"), DIGITS)
@pytest.mark.parametrize("name", MAKERS)
def test_late_components_give_the_estimate_in_order(name, precision, most, tmp_path):
    """In deviations, once all is there; each comes alone, up to WINDOW steps late."""
    filter_, (z, u, late) = MAKERS[name](TURN, ANGLES), measured()
    device = WindowDevice(filter_, tmp_path, precision)
    for k in range(STEPS + WINDOW):
        now = np.where(late[k] == 0, z[k], np.nan) if k < STEPS else [np.nan, np.nan]
        assert device.step(now, u[k] if k < STEPS else [0.0]) == 0
        for ago in range(min(k, WINDOW), 0, -1):
            for i in range(2):
                if k - ago < STEPS and late[k - ago, i] == ago and np.isfinite(z[k - ago, i]):
                    assert device.late(ago, alone(z[k - ago], i)) == 0
    rows = np.concatenate([z, np.full((WINDOW, 2), np.nan)]), np.concatenate([u, np.zeros((WINDOW, 1))])
    right = follow_known(filter_, *rows)
    got = device.mean()[None], device.covariance()[None]
    assert max(apart(got, (right.mean[-1:], right.covariance[-1:]))) < most
    assert device.counted == [0, 0]


@pytest.mark.slow
@needs_compiler
def test_after_each_measurement_it_is_the_timeline_s(tmp_path):
    """The same events, at every step; both count what is late, and what is there already."""
    still = hg.Plant(lambda x, u: TURN.transition(x, jnp.zeros(1)), TURN.noise, [0.3, 0.0], 0.2 * np.eye(2))
    filter_, (z, _, late) = hg.extended_filter(still, ANGLES), measured(5)
    node = hg.Node(ANGLES, hg.perfect(2), {"f": filter_})
    timeline = hg.Timeline(hg.Network(still, {"n": node}), window=WINDOW)
    device, sequence = WindowDevice(filter_, tmp_path), 0
    for k in range(STEPS):
        assert device.step([np.nan, np.nan]) == 0
        for ago in range(min(k, WINDOW), -1, -1):
            for i in range(2):
                if late[k - ago, i] == ago and np.isfinite(z[k - ago, i]):
                    sequence += 1
                    values = alone(z[k - ago], i)
                    assert timeline.push("n", sequence, k - ago, values, arrival=k) == "used"
                    assert device.late(ago, values) == 0
        timeline.advance(k)
        right = timeline.estimates()["n"]["f"]
        got = device.mean()[None], device.covariance()[None]
        assert max(apart(got, (right.mean[None], right.covariance[None]))) < 1e-9


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize(("precision", "most"), DIGITS)
@pytest.mark.parametrize("name", ["vehicle", "line"])
def test_at_times_between_steps(name, precision, most, tmp_path):
    """Rows are made for measurements of any time, or filled where one is of that time, as sorted rows have it."""
    plant, sensor = (VEHICLE, SENSOR) if name == "vehicle" else (MOVE, PLACE)
    make, m = (hg.extended_filter, 2) if name == "vehicle" else (hg.kalman_filter, 1)
    filter_, rng = make(plant, sensor), np.random.default_rng(4)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # the vehicle's noise is per step: what is made in between adds some
        device = WindowDevice(filter_, tmp_path, precision, window=30)
    time, rows = 0.0, []
    for k in range(40):
        dt = float(rng.uniform(0.05, 0.3))
        time += dt
        missing = [np.nan] * m
        assert device.step(missing, [dt]) == 0
        rows.append((time, missing))
        # A measurement of up to .4 before now, every third of them of the time of the step before.
        age = float(rng.uniform(0.0, min(0.4, time))) if k % 3 else (dt if k else 0.0)
        value = np.array([np.hypot(5 + 1.8 * (time - age), 3.0), 2.0])[:m] + 0.1 * rng.normal(size=m)
        assert device.late(age, value) == 0
        same = [i for i, (at, _) in enumerate(rows) if abs(at - (time - age)) < 1e-9]
        if same:
            rows[same[0]] = (rows[same[0]][0], value)
        else:
            rows.append((time - age, value))
        rows.sort(key=lambda row: row[0])
    times = np.array([at for at, _ in rows])
    right = follow_known(filter_, np.array([z for _, z in rows]), np.diff(times, prepend=0.0)[:, None])
    got = device.mean()[None], device.covariance()[None]
    assert max(apart(got, (right.mean[-1:], right.covariance[-1:]))) < most


@needs_compiler
def test_what_is_refused_changes_nothing_but_its_count(tmp_path):
    filter_, (z, u, _) = hg.extended_filter(TURN, ANGLES), measured()
    device = WindowDevice(filter_, tmp_path)
    assert device.late(0, [0.1, 0.1]) == 8 and device.counted == [1, 0]  # before the first step
    for row, given in zip(z[:20], u[:20], strict=True):
        assert device.step([row[0], np.nan], given) == 0
    before = device.state.copy()
    assert device.late(WINDOW + 1, [np.nan, 0.1]) == 8 and device.late(2**32 - 1, [np.nan, 0.1]) == 8
    there = next(ago for ago in range(WINDOW) if np.isfinite(z[19 - ago, 0]))
    assert device.late(there, [0.2, 0.1]) == 9
    assert device.counted == [3, 1]
    assert device.late(1, [np.nan, np.inf]) == 1 and device.late(1, [np.nan, 1e9]) == 5
    assert device.late(3, [np.nan, np.nan]) == 0  # nothing
    np.testing.assert_array_equal(device.state[:-4], before[:-4])
    assert device.late(WINDOW, [np.nan, 0.1]) == 0 and np.any(device.state[:-4] != before[:-4])


@pytest.mark.slow
@needs_compiler
@pytest.mark.parametrize("plant", ["steps", "time"])
def test_one_that_has_a_later_step_refused_is_taken_out_again(plant, tmp_path):
    """A level that is measured to 1e-6: 1 late makes the 1000 that came after it a billion deviations off."""
    still = hg.LinearPlant([[1.0]], 1e-30, [0.0], 1e14) if plant == "steps" else hg.LinearPlant(
        lambda u: jnp.eye(1), lambda u: 1e-30 * u[0] * jnp.eye(1), [0.0], 1e14, inputs=["dt"])  # fmt: skip
    device = WindowDevice(hg.kalman_filter(still, hg.LinearSensor([[1.0]], 1e-12)), tmp_path, window=2)
    u = [] if plant == "steps" else [1.0]
    assert device.step([np.nan], u) == 0 and device.step([1000.0], u) == 0 and device.step([np.nan], u) == 0
    before, estimate = device.state.copy(), (device.mean(), device.covariance())

    def follow(ago):
        """Estimates after a late measurement that is used, and a step."""
        assert device.late(ago, [1000.0]) == 0 and device.step([1001.0], u) == 0
        return device.mean(), device.covariance()

    for ago in (2,) if plant == "steps" else (2.0, 1.5, 2.5):
        right, device.state[:] = follow(ago), before
        assert device.late(ago, [1.0]) == 5
        np.testing.assert_equal((device.mean(), device.covariance()), estimate)
        np.testing.assert_equal(follow(ago), right)
        device.state[:] = before


@pytest.mark.slow
@needs_compiler
def test_made_rows_push_out_the_oldest(tmp_path):
    """Three rows are held: of two seconds, and then of less."""
    device = WindowDevice(hg.kalman_filter(MOVE, PLACE), tmp_path, window=2)
    for _ in range(4):
        assert device.step([np.nan], [1.0]) == 0
    assert device.late(2.9, [0.5]) == 0, "within the step that led to the oldest row; it takes that row's place"
    assert device.late(2.95, [0.5]) == 8 and device.late(2.5, [0.5]) == 0 and device.late(0.5, [0.5]) == 0
    assert device.late(2.2, [0.5]) == 8 and device.late(1.5, [0.5]) == 0 and device.counted == [2, 0]
    assert device.late(-0.1, [0.5]) == 6 and device.late(np.nan, [0.5]) == 6 and device.late(np.inf, [0.5]) == 6
    assert device.late(0.5, [0.5]) == 9 and device.counted == [2, 1]


SIZED = '#include "step.h"\ntypedef char same[sizeof(step_window) == {size} ? 1 : -1];\n'


@pytest.mark.slow
@pytest.mark.parametrize("compiler", [COMPILER, "clang", "g++"])
@pytest.mark.parametrize("name", ["time", "steps", "counted"])
@pytest.mark.filterwarnings("ignore:window")
def test_the_bytes_are_those_of_the_compiler(compiler, name, tmp_path):
    """The struct, of a state with a counter too; and the files without a warning."""
    if shutil.which(compiler) is None:
        pytest.skip(f"no compiler {compiler}")
    make = {"time": lambda: hg.extended_filter(VEHICLE, SENSOR), "steps": lambda: hg.extended_filter(TURN, ANGLES),
            "counted": changing}  # fmt: skip
    filter_ = make[name]()
    for precision in ("double", "float"):
        written = hg.export_c(filter_, tmp_path / "step.c", precision, window=WINDOW, apart=True)
        (tmp_path / "same.c").write_text(SIZED.format(size=written.state_bytes))
        assert f"sizeof(step_window) is {written.state_bytes:,}." in written.header.read_text()
        flags = ["-Wall", "-Wextra", "-Wconversion", "-Wshadow", "-Werror"]
        names = ["same.c"] if compiler == "g++" else ["same.c", "step.c"]
        language = ["-x", "c++"] if compiler == "g++" else ["-std=c99", "-pedantic"]
        subprocess.run([compiler, *language, *flags, "-c", *names], cwd=tmp_path, check=True)


def test_a_wrong_window_is_refused(tmp_path):
    filter_ = hg.extended_filter(TURN, ANGLES)
    for wrong in (0, -1, 1.5, True, "5", np.nan):
        with pytest.raises(ValueError, match=r"^window: expected a positive whole number, got"):
            hg.export_c(filter_, tmp_path / "step.c", window=wrong)
    assert not list(tmp_path.iterdir())


def test_continuous_time_is_divided_where_it_can_be(tmp_path):
    """A link that remembers goes by steps; noise for each step is not noise for each second."""
    hop = hg.gilbert_elliott(hg.hop(1.0, 0.1), hg.hop(0.2, 0.1), 0.1, 0.3)
    with pytest.raises(ValueError, match=r"window: expected no part that goes by steps.*a channel that remembers"):
        hg.export_c(hg.extended_filter(MOVE, PLACE, hop), tmp_path / "step.c", window=5)
    assert not list(tmp_path.iterdir())
    with pytest.warns(UserWarning, match="window: predictions depend on what comes late: noise over 0 and then 1"):
        hg.export_c(hg.extended_filter(VEHICLE, SENSOR), tmp_path / "step.c", window=5)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        hg.export_c(hg.kalman_filter(MOVE, PLACE), tmp_path / "step.c", window=5)
        hg.export_c(hg.extended_filter(MOVE, PLACE, hop), tmp_path / "step.c")
