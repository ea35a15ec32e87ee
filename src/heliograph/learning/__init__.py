"""Links learned from recordings: what is free, its estimates with intervals, and what the data cannot tell."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
