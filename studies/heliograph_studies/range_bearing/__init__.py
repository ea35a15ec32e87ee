"""A station that measures range and bearing: across the cut at pi, and close by behind a relay that fades."""

from heliograph_studies.old import Old
from heliograph_studies.range_bearing.run import example as run_example

example = Old(run_example)
