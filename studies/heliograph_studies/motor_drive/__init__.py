"""Flux and speed of an induction machine that gym-electric-motor simulates, its currents heard through relays."""

from heliograph_studies.motor_drive.run import example as run_example
from heliograph_studies.old import Old

example = Old(run_example)
