"""What is implausible is refused by every filter, and leaves no trace; what is only surprising is used."""

import jax
import numpy as np
import pytest

import heliograph as hg
from heliograph.filters.plausibility import Judgement
from heliograph.model.over_time import OverTime

FAR, UNREADABLE = 1, 5  # of the reasons
PUSHED = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0, [[1.0]], inputs=["push"])
PLANT = hg.LinearPlant([[0.9]], 0.1, [0.0], 1.0)
SENSOR, TWO = hg.LinearSensor([[1.0]], 0.1), hg.LinearSensor([[1.0], [0.5]], np.diag([0.1, 0.2]))
FADING = hg.hop(hg.Rayleigh(1.0), 0.1)
BURSTS = hg.gilbert_elliott(hg.hop(1.0, 0.05), hg.hop(0.2, 0.05), 0.2, 0.2)
CURVED = hg.Plant(lambda x, u: x + 0.1 * jax.numpy.sin(x) + u, 0.1, [0.0], 1.0, inputs=["push"])
BEND = hg.Sensor(lambda x: x + 0.1 * jax.numpy.tanh(x), 0.1)


def h_infinity():
    return hg.h_infinity.HInfinityFilter(
        plant=PLANT, sensor=SENSOR, gains=OverTime(np.full((40, 1, 1), 0.4)),
        expected_gain=OverTime(np.ones((40, 1, 1))), initial_mean=np.ones(1), claim="none",
        states=PLANT.states, inputs=(), received=1,
    )  # fmt: skip


FILTERS = {
    "linear": hg.linear_filter(PUSHED, SENSOR, hg.perfect()),
    "fading": hg.linear_filter(PUSHED, SENSOR, FADING),
    "modal": hg.linear_filter(PUSHED, SENSOR, BURSTS),
    "cubature": hg.cubature_filter(CURVED, BEND, FADING),
    "extended": hg.extended_filter(CURVED, BEND, FADING),
    "mixture": hg.filters.mixture_filter(PUSHED, SENSOR, BURSTS),
    "imm": hg.filters.imm_filter(PUSHED, SENSOR, BURSTS),
    "particles": hg.filters.particle_filter(PUSHED, SENSOR, BURSTS, particles=8),
    "polynomial": hg.polynomial_filter(PLANT, SENSOR, FADING, 20),
    "two": hg.cubature_filter(PUSHED, TWO, hg.perfect(2)),
}
ABSURD = [1e16, -1e20, 1e155, -1e308]
TURNING = hg.Plant(lambda x, u: x + 0.1 + u, 0.1, [3.0], 1.0, states=["heading"], circular=["heading"], inputs=["push"])
COMPASS = hg.Sensor(lambda x: x, 0.1, outputs=["compass"], circular=["compass"])


@pytest.mark.parametrize("name", FILTERS)
def test_no_absurd_value_leaves_a_trace(name):
    """Measurements, with and without missing components, and inputs; the state after it, bit for bit."""
    item = FILTERS[name]
    stream, clean = hg.Stream(item), hg.Stream(item)
    for k in range(4):
        u, z = np.full(len(item.inputs), 0.1 * k), np.full(item.received, 0.3 - 0.1 * k)
        for value in ABSURD:
            for bad in [np.full(item.received, value)] if item.received == 1 else [[value, 0.2], [np.nan, value]]:
                with pytest.raises(
                    ValueError, match=f"measurement of step {k}: expected a plausible one, got"
                ) as raised:
                    stream.push(bad, u)
                assert "\n" not in str(raised.value)
            for rest in (z, np.full(item.received, np.nan)) if item.inputs else ():
                with pytest.raises(ValueError, match=f"inputs of step {k}: expected plausible ones, got"):
                    stream.push(rest, [value])
        assert stream.steps == k
        got, expected = stream.push(z, u), clean.push(z, u)
        np.testing.assert_array_equal(got.mean, expected.mean)
        np.testing.assert_array_equal(got.covariance, expected.covariance)


@pytest.mark.filterwarnings("ignore:stream, step:UserWarning")  # beyond 2 pi: degrees?
@pytest.mark.parametrize("make", [hg.extended_filter, hg.cubature_filter])
def test_an_angle_whose_turns_leave_it_no_digits_leaves_no_trace(make):
    """1e20 rad less whole turns is any number, of rounding alone: 207 of them moved the heading by 519 deviations."""
    stream, clean = (hg.Stream(make(TURNING, COMPASS, hg.perfect())) for _ in range(2))
    for k in range(3):
        for value in ABSURD:
            with pytest.raises(ValueError, match=f"step {k}: .*an angle of so many turns|step {k}: .*more than 1e6"):
                stream.push([value], [0.0])
        # A counter of a hundred thousand turns has its digits: 1e-10 rad of them.
        got, expected = stream.push([-3.1 + 2e5 * np.pi], [0.0]), clean.push([-3.1], [0.0])
        np.testing.assert_allclose(got.mean, expected.mean, atol=1e-9)


def test_the_bound_of_turns_is_where_it_says():
    item = hg.extended_filter(TURNING, COMPASS, hg.perfect())
    deviation = np.sqrt(1.0 + 0.1 + 0.1)  # of the first innovation
    for factor, refused in ((0.99, False), (1.01, True)):
        z = factor * 0.1 * deviation / np.finfo(float).eps
        assert (item.judge_step(item.init(), [z], [0.0])[2].reason == UNREADABLE) == refused


@pytest.mark.parametrize("name", FILTERS)
def test_after_a_long_silence_a_far_value_is_used(name):
    """A statistical gate would refuse ten thousand deviations, and what follows, for ever."""
    item = FILTERS[name]
    stream, nothing = hg.Stream(item), np.full(item.received, np.nan)
    for _ in range(10):
        before = stream.push(nothing, np.zeros(len(item.inputs)))
    reach = 1e4 * np.sqrt(before.covariance[0, 0])
    after = stream.push(np.full(item.received, reach), np.zeros(len(item.inputs)))
    assert abs(after.mean[0]) > 0.1 * reach


def test_an_estimate_that_is_lost_comes_back():
    """A value that is smaller than what was expected takes the mean to where it has more digits; it is said that."""
    stream = hg.Stream(FILTERS["linear"])
    stream.push([0.0], [0.0])
    assert stream.push([np.nan], [1e12]).mean[0] > 1e11
    with pytest.warns(UserWarning, match="the last 10 measurements were each further off"):
        for k in range(60):
            last = stream.push([0.5 + 1e-9 * k], [0.0])  # no two readings are equal, as of a sensor that is not stuck
    np.testing.assert_allclose(last.mean, stream.push([0.5], [0.0]).mean, atol=1e-6)
    assert abs(last.mean[0]) < 1


def test_the_bound_is_where_it_says():
    item = hg.linear_filter(PLANT, SENSOR, hg.perfect())
    deviation = np.sqrt(0.9**2 + 0.1 + 0.1)  # of the first innovation, with nothing expected
    for factor, refused in ((0.999, False), (1.001, True)):
        judged = item.judge_step(item.init(), [factor * 1e6 * deviation])[2]
        assert (judged.reason == FAR) == refused
        np.testing.assert_allclose(judged.distance, (factor * 1e6) ** 2, rtol=1e-12)


def test_without_a_covariance_only_what_is_no_number_is_refused():
    item = h_infinity()
    stream = hg.Stream(item)
    assert stream.push([1e20]).mean[0] == 0.9  # an estimate of a step uses what came before it
    assert stream.push([0.0]).mean[0] > 1e19
    grown = hg.Stream(item.__class__(**{**vars(item), "gains": OverTime(np.full((40, 1, 1), 1e10))}))
    with pytest.raises(ValueError, match="measurement of step 0: expected a plausible one"):
        grown.push([1e300])


def test_a_prediction_over_an_absurd_time_is_no_number():
    plant = hg.Plant(lambda x, u: x * jax.numpy.exp(u), lambda u: 0.1 * u.reshape(1, 1), [1.0], 1.0, inputs=["dt"])
    stream = hg.Stream(hg.extended_filter(plant, SENSOR, hg.perfect()))
    said = r"inputs of step 0: expected plausible ones, got \[1000000000.0\].*transition\(x, u\) returned \[inf\]"
    with pytest.raises(ValueError, match=said):
        stream.push([1.0], [1e9])
    assert np.isfinite(stream.push([1.0], [1.0]).mean).all()


@pytest.mark.slow
def test_in_single_precision_too():
    """The bound is eps^-1/2 = 2,900 deviations, where eps d^2 is all of a variance; squares of sentinels overflow."""
    most = 2.0**23
    for name in ("linear", "extended", "imm"):
        item = FILTERS[name]
        with jax.enable_x64(False):
            state = jax.tree.map(lambda x: jax.numpy.asarray(x, jax.numpy.asarray(x).dtype), item.init())
            state = jax.tree.map(lambda x: x.astype("float32") if x.dtype == "float64" else x, state)
            judged = jax.jit(lambda z, u: item.judge_step(state, z, u, 0)[2])  # noqa: B023
            values = np.float32([1e2, 1e3, 1e5, 1e6, 1e20, 3e38])
            said = [judged(np.float32([z]), np.float32([0.0])) for z in values]
            assert {item.reason.dtype for item in said} == {np.dtype(np.float32)}
            far = [bool(item.reason == FAR) for item in said]
            assert far == [not item.distance <= most for item in said] == [False, False, True, True, True, True]
            assert judged(np.float32([0.5]), np.float32([1e20])).input == 1


def test_a_filter_that_is_lost_does_not_refuse_for_the_others():
    why_values, why_inputs = Judgement.why_values, Judgement.why_inputs
    fine, far, silent = [1.0, 1.0, 0.0, 0.0], [1e20, 1.0, FAR, 0.0], [np.nan, 1.0, 0.0, np.nan]
    assert why_values(np.array([fine, far])) is None and why_values(np.array([fine, silent])) is None
    assert why_values(np.array([far, silent])) == "more than 1e6 deviations from what was expected (1e+10 of them)"
    single = why_values(np.array([far, silent], dtype=np.float32))  # eps^-1/2
    assert single == "more than 2,896 deviations from what was expected (1e+10 of them)"
    assert why_inputs(np.array([[1.0, 1.0, 0.0, 1.0], silent])) and why_inputs(np.array([fine, silent])) is None
