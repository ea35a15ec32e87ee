"""A network's step as a function of rows of doubles, and what stands in which column."""
