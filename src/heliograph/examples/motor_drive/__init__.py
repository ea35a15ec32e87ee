"""Flux and speed of an induction machine that gym-electric-motor simulates, its currents heard through relays."""

from heliograph.examples.motor_drive.run import example as example
