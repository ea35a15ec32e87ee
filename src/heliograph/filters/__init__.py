"""What turns measurements into estimates: `base` says what a filter is, every other file holds one idea."""
