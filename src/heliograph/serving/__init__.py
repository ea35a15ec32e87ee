"""A network's filters kept running: messages in, estimates out, exactly once in effect."""

from heliograph.numerics.lazy_exports import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
