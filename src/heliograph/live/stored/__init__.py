"""Stored states: a plant as bytes, what a store is of, and states of other networks and versions carried over."""

from heliograph.numerics.lazy_exports import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
