"""Native code: a traced function of one run as scalar operations, compiled for many runs at once."""

from heliograph.numerics.names import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
