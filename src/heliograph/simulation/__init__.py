"""Simulation of networks: Monte Carlo runs, filtered recordings, and statistics of errors against claims."""

from heliograph.numerics.lazy_exports import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
