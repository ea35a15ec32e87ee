"""Particle filters of the state, and what particle filters share: resampling, and keys made of data."""

from heliograph.numerics.lazy_exports import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
