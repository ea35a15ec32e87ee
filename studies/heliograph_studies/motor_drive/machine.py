"""The induction machine as the filters believe it: currents, rotor flux and speed in the stator frame, per unit.

With i stator current, psi rotor flux, omega mechanical speed, p pole pairs, T the load's torque (0 if it is no state):

sigma L_s i' = u - (R_s + R_r k^2) i + (k / tau_r - k p omega J) psi,   k = L_m / L_r,   J = [[0, -1], [1, 0]],
psi' = (L_m i - psi) / tau_r + p omega J psi,   tau_r = L_r / R_r,
inertia omega' = 3/2 p k (i x psi turned: psi_alpha i_beta - psi_beta i_alpha) - T.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np

import heliograph as hg
from heliograph.numerics.module import Module

STEP = 5e-4  # s, of the drive's control and of the filters
POLE_PAIRS = 2
STATOR_RESISTANCE, ROTOR_RESISTANCE = 2.9338, 1.355  # ohm, the simulator's own motor
MAIN_INDUCTANCE, STRAY_INDUCTANCE = 143.75e-3, 5.87e-3  # H, the stray one on each side
LOAD_INERTIA, ROTOR_INERTIA = 4e-3, 1.1e-3  # kg m^2
INERTIA = LOAD_INERTIA + ROTOR_INERTIA

WINDING_INDUCTANCE = MAIN_INDUCTANCE + STRAY_INDUCTANCE  # L_s = L_r
COUPLING = MAIN_INDUCTANCE / WINDING_INDUCTANCE  # k
TRANSIENT_INDUCTANCE = WINDING_INDUCTANCE - MAIN_INDUCTANCE * COUPLING  # sigma L_s
TORQUE_FACTOR = 1.5 * POLE_PAIRS * COUPLING

CURRENT = 3.9  # A, the simulator's nominal amplitude
FLUX = MAIN_INDUCTANCE * CURRENT / np.sqrt(2)  # Vs: as much current magnetises as makes torque
SPEED = 2 * np.pi * 50 / POLE_PAIRS  # rad/s, synchronous at 50 Hz
TORQUE = TORQUE_FACTOR * FLUX * CURRENT / np.sqrt(2)  # Nm
RATED = np.array([CURRENT, CURRENT, FLUX, FLUX, SPEED, TORQUE])
STATES = ("i_alpha", "i_beta", "psi_alpha", "psi_beta", "omega", "load")
INPUTS = ("u_alpha", "u_beta")

# One step's process noise, stated before any run. Load: 1 Nm that lasts 50 ms, as white noise of the same intensity
# 2 sigma^2 tau where it is no state; where it is one, a walk of 1 Nm in 100 ms.
CURRENT_WALK, FLUX_WALK = 0.05, 5e-4  # A, Vs
SPEED_WALK = float(np.sqrt(2 * 1.0**2 * 0.05 * STEP)) / INERTIA  # rad/s
KNOWN_LOAD_SPEED_WALK = 0.02  # rad/s
LOAD_WALK = float(np.sqrt(1.0**2 / 0.1 * STEP))  # Nm
START_DEVIATION = np.array([0.1, 0.1, 0.01, 0.01, 1.0, 0.5])  # A, Vs, rad/s, Nm: at rest and without flux

Rate = Callable[[jax.Array], jax.Array]
Method = Callable[[Rate, jax.Array, float], jax.Array]


def euler(rate: Rate, x: jax.Array, step: float) -> jax.Array:
    """x + h x'."""
    return x + step * rate(x)


def runge_kutta(rate: Rate, x: jax.Array, step: float) -> jax.Array:
    """The classical method of fourth order."""
    a = rate(x)
    b = rate(x + step / 2 * a)
    c = rate(x + step / 2 * b)
    d = rate(x + step * c)
    return x + step / 6 * (a + 2 * b + 2 * c + d)


class Machine(Module):
    """One step of the machine, x per unit of `RATED` (5 states, or 6 with the load's torque), u in volts."""

    rotor_resistance: np.ndarray
    integrate: Method = eqx.field(static=True)

    def __init__(
        self,
        rotor_resistance: float = ROTOR_RESISTANCE,
        integrate: Method = runge_kutta,
    ):
        self.rotor_resistance = np.asarray(rotor_resistance, dtype=float)
        self.integrate = integrate

    def __call__(self, x: jax.Array, u: jax.Array) -> jax.Array:
        """State after one step with the voltage held."""
        scale = RATED[: x.shape[0]]
        return self.integrate(lambda physical: self.rates(physical, u), x * scale, STEP) / scale

    def rates(self, x: jax.Array, u: jax.Array) -> jax.Array:
        """x' in SI units."""
        i, psi, omega = x[:2], x[2:4], x[4]
        damping = self.rotor_resistance / WINDING_INDUCTANCE
        turned = POLE_PAIRS * omega * jnp.stack([-psi[1], psi[0]])
        resistance = STATOR_RESISTANCE + self.rotor_resistance * COUPLING**2
        current = (u - resistance * i + COUPLING * (damping * psi - turned)) / TRANSIENT_INDUCTANCE
        flux = damping * (MAIN_INDUCTANCE * i - psi) + turned
        load = x[5:6]  # nothing where it is no state
        speed = (torque(x) - jnp.sum(load)) / INERTIA
        return jnp.concatenate([current, flux, speed[None], 0 * load])


def torque(x: jax.Array) -> jax.Array:
    """Torque of the machine in Nm, x (..., states) in SI units: 3/2 p k (psi_alpha i_beta - psi_beta i_alpha)."""
    return TORQUE_FACTOR * (x[..., 2] * x[..., 1] - x[..., 3] * x[..., 0])


def plant(machine: Machine, load_is_state: bool = False, trust: float = 1.0) -> hg.Plant:
    """The machine as a plant per unit, from rest; `trust` divides the deviations of the process noise."""
    speed_walk = KNOWN_LOAD_SPEED_WALK if load_is_state else SPEED_WALK
    walk = np.array([CURRENT_WALK, CURRENT_WALK, FLUX_WALK, FLUX_WALK, speed_walk, LOAD_WALK])
    n = 6 if load_is_state else 5
    covariances = [np.diag((deviation / RATED)[:n] ** 2) for deviation in (walk / trust, START_DEVIATION)]
    return hg.Plant(machine, covariances[0], np.zeros(n), covariances[1], STATES[:n], INPUTS)


def draw_truth(model: hg.Plant, voltages: np.ndarray, key: jax.Array) -> jax.Array:
    """One trajectory of the filters' own model with its process noise, (steps, n) per unit."""

    def body(x: jax.Array, item: tuple[jax.Array, jax.Array]) -> tuple[jax.Array, jax.Array]:
        draw, u = item
        x = model.transition(x, u) + model.sample_noise(draw, u)
        return x, x

    start, *_ = keys = jax.random.split(key, len(voltages) + 1)
    return jax.lax.scan(body, model.sample_initial(start), (keys[1:], jnp.asarray(voltages)))[1]


DC_LINK = 560.0  # V
FREQUENCY, RAMP = 40.0, 0.5  # Hz, reached after s
BOOST, VOLTS_AT_50_HZ = 4.0, 125.0  # V: amplitude = boost + what grows with the frequency
DURATION, LOAD_STEP_AT = 1.0, 0.75  # s
FRICTION = {"a": 0.1, "b": 1e-3, "c": 3e-5}  # Nm, Nm s, Nm s^2: dry, viscous and a fan
LOAD_STEP = 1.5  # Nm
NO_LOAD = {"a": 0.0, "b": 0.0, "c": 0.0}
STANDSTILL = 1e-3  # s: below dry / inertia * this speed, the simulator lets dry friction grow with the speed


@dataclass(frozen=True)
class Drive:
    """What the simulator did: time (steps,) s, commanded voltages (steps, 2) V, truth (steps, 6) per unit of `RATED`.

    Row k is the end of the step over which voltages[k] were held.
    """

    time: np.ndarray
    voltages: np.ndarray
    truth: np.ndarray


def commands() -> np.ndarray:
    """Voltages in the stator frame, (steps, 2): amplitude over frequency, held over a step at its middle angle."""
    middle = STEP * (np.arange(round(DURATION / STEP)) + 0.5)
    frequency = FREQUENCY * np.minimum(middle / RAMP, 1.0)
    angle = 2 * np.pi * FREQUENCY * np.where(middle < RAMP, middle**2 / (2 * RAMP), middle - RAMP / 2)
    amplitude = BOOST + VOLTS_AT_50_HZ * frequency / 50
    result: np.ndarray = amplitude[:, None] * np.column_stack([np.cos(angle), np.sin(angle)])
    return result


def load_torque(speed: np.ndarray, load: Mapping[str, float]) -> np.ndarray:
    """The simulator's static load in Nm: dry, viscous, quadratic."""
    dry = np.clip(speed * INERTIA / STANDSTILL, -load["a"], load["a"])
    result: np.ndarray = dry + load["b"] * speed + load["c"] * speed * np.abs(speed)
    return result


def simulate_drive(loaded: bool = True, dead_time: float = 0.0) -> Drive:
    """Run the simulator from rest, with friction and a load step unless it runs without load.

    `dead_time` (s) of the inverter in each step: its voltage then falls short by dead_time / STEP of the DC link, in
    the direction of each phase's current; the command, which the filters know, does not say so.

    Raises:
        ModuleNotFoundError: the extra `motor` is not installed.
    """
    voltages = commands()
    change = round(LOAD_STEP_AT / STEP) if loaded else len(voltages)
    before = FRICTION if loaded else NO_LOAD
    after = {**before, "a": before["a"] + LOAD_STEP}
    first = _phase(voltages[:change], np.zeros(6), before, dead_time)
    second = _phase(voltages[change:], first[-1], after, dead_time)
    states = np.concatenate([first, second])  # speed, current, flux, angle
    speed = states[:, 0]
    loads = np.concatenate([load_torque(speed[:change], before), load_torque(speed[change:], after)])
    truth = np.column_stack([states[:, 1:5], speed, loads]) / RATED
    return Drive(STEP * np.arange(1, len(voltages) + 1), voltages, truth)


def _phase(voltages: np.ndarray, start: np.ndarray, load: Mapping[str, float], dead_time: float) -> np.ndarray:
    """States (steps, 6) of the simulator's differential equation under one load."""
    parts = simulator()
    solver = parts.ScipyOdeSolver()  # ours to hold: its state has the flux, which the simulator's outputs lack
    system = parts.SquirrelCageInductionMotorSystem(
        converter=parts.ContB6BridgeConverter(tau=STEP, interlocking_time=dead_time),
        motor=parts.SquirrelCageInductionMotor(),
        load=parts.PolynomialStaticLoad(load_parameter={**load, "j_load": LOAD_INERTIA}),
        supply=parts.IdealVoltageSupply(u_nominal=DC_LINK),
        ode_solver=solver,
        tau=STEP,
    )
    # From the states of the phase before.
    system.reset()
    solver.set_initial_value(start, 0.0)
    # Each step's voltage as duty cycles of the three phases.
    axes = 2 * np.pi / 3 * np.arange(3)
    phases = voltages @ np.stack([np.cos(axes), np.sin(axes)])
    states = []
    for duty in phases / (DC_LINK / 2):
        system.simulate(duty)
        states.append(np.array(solver.y))
    return np.array(states).reshape(-1, 6)


def simulator() -> ModuleType:
    """The simulator's physical systems; imported only here.

    Raises:
        ModuleNotFoundError: the extra `motor` is not installed.
    """
    return import_module("gym_electric_motor.physical_systems")
