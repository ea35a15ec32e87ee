"""Contract tests for your own channels, filters, quantizers and fusion rules; they raise AssertionError."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
