"""The truth: gym-electric-motor's squirrel-cage induction machine on an inverter, started by voltage over frequency."""

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module
from types import ModuleType

import numpy as np

from heliograph_studies.motor_drive.machine import INERTIA, LOAD_INERTIA, RATED, STEP

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
    system.reset()
    solver.set_initial_value(start, 0.0)
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
