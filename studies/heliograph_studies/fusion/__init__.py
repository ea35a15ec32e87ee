"""Fusion that knows what is shared: what intersection throws away, a centre that remembers every report, trees."""

from heliograph_studies.fusion.run import example as run_example
from heliograph_studies.old import Old

example = Old(run_example)
