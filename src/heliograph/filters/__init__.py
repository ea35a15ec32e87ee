"""Filters turn measurements into estimates: `base` defines what a filter is, every other file holds one idea."""

from heliograph.numerics.lazy_exports import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
