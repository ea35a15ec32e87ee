"""An induction machine simulated by gym-electric-motor; its currents reach flux and speed filters through relays.

Run it with `python -m heliograph.examples.motor_drive --out out` (extras `motor` and `report`).
"""
