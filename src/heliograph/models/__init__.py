"""Models ready to use: continuous time made discrete, motion of vehicles, parts of time series, and joining."""

from heliograph.numerics.lazy_exports import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
