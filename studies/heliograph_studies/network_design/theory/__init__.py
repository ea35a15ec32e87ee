"""Theory of network design: schedules, bursts, sites of relays, coherent sums, and a semidefinite programme."""

from heliograph_studies.network_design.theory.bursts import Bursts, burst_sending
from heliograph_studies.network_design.theory.choose import Choice, choose_sensors
from heliograph_studies.network_design.theory.coherent import (
    CoherentDesign,
    CoherentSum,
    coherent_least_power,
    coherent_powers,
    coherent_programme,
    coherent_sum,
)
from heliograph_studies.network_design.theory.map_figure import site_map
from heliograph_studies.network_design.theory.relay_line import RelayLine, best_relays, relay_line
from heliograph_studies.network_design.theory.relay_scene import Radio, RelayScene
from heliograph_studies.network_design.theory.relay_sites import RelayMap, choose_relays, relay_map
from heliograph_studies.network_design.theory.schedules import SendingSchedule, best_schedule
from heliograph_studies.network_design.theory.semidefinite import semidefinite_design
from heliograph_studies.network_design.theory.splits import path_noise, power_for_noise

__all__ = [
    "Bursts",
    "Choice",
    "CoherentDesign",
    "CoherentSum",
    "Radio",
    "RelayLine",
    "RelayMap",
    "RelayScene",
    "SendingSchedule",
    "best_relays",
    "best_schedule",
    "burst_sending",
    "choose_relays",
    "choose_sensors",
    "coherent_least_power",
    "coherent_powers",
    "coherent_programme",
    "coherent_sum",
    "path_noise",
    "power_for_noise",
    "relay_line",
    "relay_map",
    "semidefinite_design",
    "site_map",
]
