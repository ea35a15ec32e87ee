"""Words of bits on their way, and what rounding to them adds."""
