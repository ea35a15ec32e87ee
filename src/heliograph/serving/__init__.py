"""A network's filters kept running: messages in, estimates out, exactly once in effect."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
