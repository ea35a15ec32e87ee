"""Laws of a scalar gain."""
