"""Data that come late, told or not, and clocks that are wrong: what filters claim, and what is true."""

from heliograph_studies.delays.run import example as run_example
from heliograph_studies.old import Old

example = Old(run_example)
