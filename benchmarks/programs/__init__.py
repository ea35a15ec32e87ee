"""Random programs: their text, and what two engines make of it."""
