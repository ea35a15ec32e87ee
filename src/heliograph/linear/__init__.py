"""Linear systems with random coefficients: their best linear filters, lifts to monomials, schedules of gains."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
