"""Filters turn measurements into estimates: `base` defines what a filter is, every other file holds one idea."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
