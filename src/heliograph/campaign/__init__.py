"""Campaigns: many settings of one network, simulated into one labelled store that survives any interruption."""

from heliograph.numerics.lazy_exports import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
