"""A drive through a real broker, its service killed three times: the estimates are those of one that was left alone."""

from heliograph_studies.live.run import example as run_example
from heliograph_studies.old import Old

example = Old(run_example)
