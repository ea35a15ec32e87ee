"""Packets that a recorded radio network delivered late, out of order and twice, and what a filter makes of them."""

from heliograph_studies.late_data.run import example as run_example
from heliograph_studies.old import Old

example = Old(run_example)
