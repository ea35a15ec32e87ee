"""Networks that are designed: powers, relays, sites and schedules, each beside what nothing can beat."""

from heliograph.examples.network_design.run import example as example
