"""Native code: a traced function of one run as scalar operations, compiled for many runs at once."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
