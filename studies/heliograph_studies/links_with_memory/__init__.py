"""Links that fade slowly: what a filter without memory claims and errs, what memory and being told are worth."""

from heliograph_studies.links_with_memory.run import example as run_example
from heliograph_studies.old import Old

example = Old(run_example)
