"""Networks that are designed: powers, relays, sites and schedules, each beside what nothing can beat."""

from heliograph_studies.network_design.run import example as run_example
from heliograph_studies.old import Old

example = Old(run_example)
