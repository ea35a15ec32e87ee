"""A mower's recorded ranges to four beacons through a simulated relay, to filters that know it or do not."""

from heliograph.examples.demo.run import example as example
