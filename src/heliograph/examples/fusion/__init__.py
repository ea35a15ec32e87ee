"""Fusion that knows what is shared: what intersection throws away, a centre that remembers every report, trees."""

from heliograph.examples.fusion.run import example as example
