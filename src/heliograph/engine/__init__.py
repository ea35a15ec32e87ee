"""Choice of the engine that computes a function of one run: native code (`straightline`) or XLA."""

from heliograph.numerics.lazy_exports import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
