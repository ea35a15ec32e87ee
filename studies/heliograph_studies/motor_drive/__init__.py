"""Flux and speed of an induction machine that gym-electric-motor simulates, its currents received through relays."""

from heliograph_studies.motor_drive import compute, figures
from heliograph_studies.motor_drive.compute import Setting as Setting
from heliograph_studies.study import Study

example = Study(
    "motor-drive", Setting, compute.compute, 3, figures.figures, figures.words, needs=["gym_electric_motor"]
)
run = example.run
