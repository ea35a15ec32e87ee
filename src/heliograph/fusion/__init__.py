"""Several estimates made one: rules, intersection, levels, and quantizers on the way."""
