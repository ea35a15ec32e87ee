"""A drive through a real broker, its service killed three times: the estimates are those of one that was left alone."""

from heliograph.examples.live.run import example as example
