"""Links learned from recordings: what is free, its estimates with intervals, and what the data cannot tell."""

from heliograph.numerics.lazy_exports import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
