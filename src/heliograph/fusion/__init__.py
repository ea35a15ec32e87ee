"""Fusion of several estimates: rules, covariance intersection, H-infinity levels, and quantizers on the uplinks."""

from heliograph.numerics.lazy_exports import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
