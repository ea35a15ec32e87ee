"""Links that fade slowly: what a filter without memory claims and errs, what memory and being told are worth."""

from heliograph.examples.links_with_memory.run import example as example
