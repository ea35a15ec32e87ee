"""Fusion centres that carry joint moments of local errors, and uplinks to them."""

from heliograph.numerics.lazy_exports import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
