"""Theory that the study needs beside planning: who sends when, seldom and loud, where relays stand, feedback."""

from heliograph_studies.network_design.theory.feedback import fed_back_channel, feedback_limit
from heliograph_studies.network_design.theory.relay_line import RelayLine, best_relays, relay_line
from heliograph_studies.network_design.theory.sending import (
    Bursts,
    Choice,
    SendingSchedule,
    best_schedule,
    burst_sending,
    choose_sensors,
    steady_error,
)

__all__ = [
    "Bursts",
    "Choice",
    "RelayLine",
    "SendingSchedule",
    "best_relays",
    "best_schedule",
    "burst_sending",
    "choose_sensors",
    "fed_back_channel",
    "feedback_limit",
    "relay_line",
    "steady_error",
]
