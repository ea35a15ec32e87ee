"""Smoothing: estimates of earlier states from later data too, with fixed interval, fixed lag or fixed point."""

from heliograph.numerics.lazy_exports import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
