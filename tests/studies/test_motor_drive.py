"""The motor-drive example: its model against a fine integration, its steady state, its scores, and the simulator."""

import sys
from importlib.util import find_spec

import jax
import numpy as np
import pytest
from scipy.integrate import solve_ivp

import heliograph as hg
from heliograph import cli
from heliograph.numerics.extras import how_to_install
from heliograph_studies import motor_drive
from heliograph_studies.motor_drive import compute, machine
from heliograph_studies.motor_drive.machine import POLE_PAIRS, RATED, STEP, Machine, euler, runge_kutta

needs_simulator = pytest.mark.skipif(
    find_spec("gym_electric_motor") is None, reason=f"no motor simulator here: {how_to_install('motor')}"
)
RUNNING = np.array([3.0, -1.0, 0.1, -0.37, 124.0, 2.0])  # A, Vs, rad/s, Nm: near the drive's end


def step(model, x, u):
    with jax.enable_x64(True):
        return np.asarray(jax.jit(model.__call__)(x / RATED[: len(x)], u)) * RATED[: len(x)]


def rates(x, u):
    """The machine's equations written again with complex numbers: i = i_alpha + j i_beta, psi alike."""
    i, psi, omega, load = x[0] + 1j * x[1], x[2] + 1j * x[3], x[4], x[5]
    inductance, k = machine.WINDING_INDUCTANCE, machine.COUPLING
    psi_rate = (
        machine.ROTOR_RESISTANCE / inductance * (machine.MAIN_INDUCTANCE * i - psi) + 1j * POLE_PAIRS * omega * psi
    )
    i_rate = (u[0] + 1j * u[1] - machine.STATOR_RESISTANCE * i - k * psi_rate) / machine.TRANSIENT_INDUCTANCE
    torque = 1.5 * POLE_PAIRS * k * np.imag(np.conj(psi) * i)
    return np.array([i_rate.real, i_rate.imag, psi_rate.real, psi_rate.imag, (torque - load) / machine.INERTIA, 0.0])


def test_one_step_agrees_with_a_fine_integration():
    u = np.array([60.0, 85.0])
    exact = solve_ivp(lambda _, x: rates(x, u), (0, STEP), RUNNING, method="DOP853", rtol=1e-12, atol=1e-12).y[:, -1]
    error = np.abs(step(Machine(), RUNNING, u) - exact) / RATED
    # Fastest mode h lambda = -0.165, first change h x' = 1.4 per unit: the term left out is
    # |h lambda|^4 |h x'| / 120 = 8.7e-6, and twice that is allowed. Euler's is |h lambda| |h x'| / 2 = 0.12.
    assert np.all(error < 1.8e-5)
    assert np.max(error) > 1e-9, "a one-step method of fourth order is not exact"
    assert np.max(np.abs(step(Machine(integrate=euler), RUNNING, u) - exact) / RATED) > 1e-2


def test_the_methods_have_the_orders_they_claim():
    for method, order in ((euler, 1), (runge_kutta, 4)):
        errors = []
        for steps in (20, 40):
            x = 1.0
            for _ in range(steps):
                x = method(lambda value: -value, x, 1 / steps)
            errors.append(abs(x - np.exp(-1.0)))
        # The next term of the error is 1/20 to 1/40 of the leading one.
        assert np.log2(errors[0] / errors[1]) == pytest.approx(order, abs=0.06)


def steady_state(speed: float, frequency: float, amplitude: float) -> tuple[complex, complex]:
    """Current (A) and rotor flux (Vs) of a machine turned at `speed` (rad/s) by a voltage turning at `frequency` (Hz).

    psi (1 / tau_r + j (omega_1 - p omega)) = L_m i / tau_r,  u = (R_s + j omega_1 sigma L_s) i + j omega_1 k psi.
    """
    omega = 2 * np.pi * frequency
    damping = machine.ROTOR_RESISTANCE / machine.WINDING_INDUCTANCE
    flux_of_current = damping * machine.MAIN_INDUCTANCE / (damping + 1j * (omega - POLE_PAIRS * speed))
    impedance = machine.STATOR_RESISTANCE + 1j * omega * (
        machine.TRANSIENT_INDUCTANCE + machine.COUPLING * flux_of_current
    )
    current = complex(amplitude / impedance)
    return current, complex(flux_of_current * current)


def test_steady_state_turns_without_changing_and_balances_power():
    speed, frequency, amplitude = 122.0, 40.0, 105.0
    current, flux = steady_state(speed, frequency, amplitude)
    x = np.array([current.real, current.imag, flux.real, flux.imag, speed, 0.0])
    x[5] = torque = float(machine.torque(x))
    turned = 2j * np.pi * frequency * np.array([current, flux])
    expected = np.array([turned[0].real, turned[0].imag, turned[1].real, turned[1].imag, 0.0, 0.0])
    with jax.enable_x64(True):
        values = np.asarray(Machine().rates(x, np.array([amplitude, 0.0])))
    assert values == pytest.approx(expected, rel=1e-9, abs=1e-8)  # rounding of terms up to 1e4 A/s
    slip = 2 * np.pi * frequency - POLE_PAIRS * speed
    electrical = 1.5 * amplitude * current.real
    copper = 1.5 * machine.STATOR_RESISTANCE * abs(current) ** 2
    rotor = torque * slip / POLE_PAIRS  # lost in the rotor: torque times the slip of the field
    assert electrical == pytest.approx(copper + rotor + torque * speed, rel=1e-10)
    assert 1.0 < torque < machine.TORQUE


def test_load_and_noise_of_the_model():
    model = machine.plant(Machine(), load_is_state=True)
    assert len(model.states) == 6 and len(machine.plant(Machine()).states) == 5
    loaded, free = (step(Machine(), np.append(RUNNING[:5], load), np.zeros(2)) for load in (2.0, 0.0))
    # Two newton metres over one step; the current answers within the step only to second order.
    assert free[4] - loaded[4] == pytest.approx(2.0 * STEP / machine.INERTIA, rel=1e-3)
    stated, tenth = (machine.plant(Machine(), trust=t).noise.covariance for t in (1.0, 10.0))
    assert np.allclose(stated, 100 * tenth, rtol=1e-12)


def test_commands_reach_the_frequency_and_turn_with_it():
    voltages = machine.commands() @ np.array([1, 1j])
    turns = np.angle(voltages[1:] / voltages[:-1]) / (2 * np.pi * STEP)
    after = round(machine.RAMP / STEP)
    assert turns[after:] == pytest.approx(np.full(len(turns) - after, machine.FREQUENCY), rel=1e-9)
    assert np.all(np.diff(turns[: after - 1]) > 0)
    assert abs(voltages[-1]) == pytest.approx(machine.BOOST + machine.VOLTS_AT_50_HZ * machine.FREQUENCY / 50)


def test_scores_of_made_up_errors():
    rng, seeds, steps = np.random.default_rng(0), 200, 50
    truth = np.zeros((seeds, steps, 5))
    bias = np.array([0.0, 0.0, 0.0, 0.0, 0.03])
    mean = truth - bias - 0.04 * rng.standard_normal(truth.shape)
    bound = np.broadcast_to(0.02**2 * np.eye(5), (*truth.shape, 5))
    estimate = hg.model.Estimate(mean, bound, "nominal")
    record = hg.Record(np.arange(50.0), machine.STATES[:5], truth, {}, {"node": {"filter": estimate}})
    score = compute.score(record, "node", "filter")
    # 10,000 draws: a mean square within 4 standard errors of sqrt(2 / 10,000) = 1.4 %, a root within half of it.
    assert score.rmse["speed"] == pytest.approx(0.05 * RATED[4], rel=0.03)
    assert score.ratio["flux"] == pytest.approx(2.0, rel=0.03)
    assert score.common["speed"] == pytest.approx(0.36, abs=0.02) and score.common["flux"] == pytest.approx(
        0, abs=0.005
    )
    assert score.nees_per_dimension["mean"] == pytest.approx((4 * 0.04**2 + 0.05**2) / 5 / 0.02**2, rel=0.03)
    assert score.nees_per_dimension["low"] < score.nees_per_dimension["mean"] < score.nees_per_dimension["high"]


@pytest.mark.slow
def test_received_currents_have_the_channel_s_mean_and_nodes_differ():
    truth = np.tile(RUNNING[:5] / RATED[:5], (4000, 1))
    result = compute.received(truth, 0)
    means = {"relay_1": 0.865 * 0.93, "relay_2": 0.79 * 0.93, "wired": 1.0}
    for node, gain in means.items():
        error = result[node].std(axis=0) / np.sqrt(4000)
        assert np.all(np.abs(result[node].mean(axis=0) - gain * RUNNING[:2]) < 4 * error), node
    assert np.array_equal(result["relay_1"], compute.received(truth, 0)["relay_1"])
    assert not np.array_equal(result["relay_1"], compute.received(truth, 1)["relay_1"])


def test_a_missing_simulator_is_said_before_the_work_starts(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "gym_electric_motor", None)
    with pytest.raises(ModuleNotFoundError) as caught:
        motor_drive.run(out=tmp_path / "out")
    assert caught.value.name == "gym_electric_motor" and cli.EXTRAS[caught.value.name] == "motor"
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"seeds": 1}, "seeds: expected a whole number of at least 2, got 1"),
        ({"dead_time": 1.0}, "dead_time: expected seconds, at least 0 and less than a step of 0.0005, got 1.0"),
        ({"resistance": 0.0}, "resistance: expected a positive number, got 0.0"),
    ],
)
def test_refuses_settings_that_are_none(change, words):
    with pytest.raises(ValueError, match=words):
        motor_drive.Setting(**change)


@pytest.mark.slow
@needs_simulator
def test_the_model_is_the_simulator_s_machine():
    result = machine.simulate_drive(loaded=False)

    def fine(x, u):
        def part(_, x):
            return runge_kutta(lambda value: Machine().rates(value, u), x, STEP / 10)

        return jax.lax.fori_loop(0, 10, part, x)

    with jax.enable_x64(True):
        ends = np.asarray(jax.jit(jax.vmap(fine))(result.truth[:-1, :5] * RATED[:5], result.voltages[1:])) / RATED[:5]
    # The simulator's solver is asked for 1e-6 of each value; values are up to 1.3 per unit.
    assert np.max(np.abs(ends - result.truth[1:, :5])) < 1.3e-6


@pytest.mark.slow
@needs_simulator
def test_the_simulator_s_speed_obeys_torque_and_load():
    result = machine.simulate_drive().truth * RATED
    rate = (machine.torque(result) - result[:, 5]) / machine.INERTIA
    error = np.diff(result[:, 4]) - STEP * (rate[1:] + rate[:-1]) / 2
    error[round(machine.LOAD_STEP_AT / STEP) - 1] = 0.0  # the load jumps inside this step
    # Trapezoidal rule, (h lambda)^2 / 12 of h times the rate: 0.165^2 / 12 of 0.25 rad/s. At the start dry friction
    # settles within a step's time.
    assert np.max(np.abs(error[20:])) < 6e-4
    assert np.max(np.abs(np.diff(result[:, 4]))) > 0.1


@pytest.mark.slow
@needs_simulator
def test_the_filter_that_knows_the_relay_is_cautious_and_the_other_too_sure():
    result = machine.simulate_drive()
    case = compute.Case("load", result.voltages, [result.truth[:, :5]] * 2, machine.plant(Machine()))
    record = compute.run_case(case, range(2))
    assert record.failures() == []
    scores = {name: compute.score(record, *name.split("/")) for name in ("fused/zero_mean", "relay_1/mean_gain")}
    # Twenty seeds give 0.223 and 4.31 with 2 % between seeds.
    assert scores["fused/zero_mean"].nees_per_dimension["mean"] == pytest.approx(0.223, rel=0.15)
    assert scores["relay_1/mean_gain"].nees_per_dimension["mean"] == pytest.approx(4.31, rel=0.15)
    assert scores["fused/zero_mean"].common["current"] < 0.2, "the seeds draw different sensors and relays"
