"""Contract tests for your own channels, filters, quantizers and fusion rules; they raise AssertionError."""

from heliograph.numerics.lazy_exports import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
