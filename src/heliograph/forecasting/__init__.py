"""Forecasting: what will be, given what arrived; when a level is passed; and whether such claims held on the data."""

from heliograph.numerics.lazy_exports import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
