"""What waiting is worth: smoothing behind fading links and relays, from a lag of one step to a whole run."""

from heliograph_studies.old import Old
from heliograph_studies.smoothing.run import example as run_example

example = Old(run_example)
