"""Links learned from recordings: whether intervals cover the truth behind random gains, method by method."""

from heliograph_studies.learning.run import example as run_example
from heliograph_studies.old import Old

example = Old(run_example)
