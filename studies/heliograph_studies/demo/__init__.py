"""A mower's recorded ranges to four beacons through a simulated relay, to filters that know it or do not."""

from heliograph_studies.demo.run import example as run_example
from heliograph_studies.old import Old

example = Old(run_example)
