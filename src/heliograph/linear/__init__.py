"""Linear systems with random coefficients: their best linear filters, lifts to monomials, schedules of gains."""

from heliograph.numerics.lazy_exports import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
