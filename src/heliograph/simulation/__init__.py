"""Simulation of networks: Monte Carlo runs, filtered recordings, and statistics of errors against claims."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
