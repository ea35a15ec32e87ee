"""A filter over the rows of a recording: one scan, chunks side by side, and rows in which only means move."""
