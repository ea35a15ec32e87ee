"""Straight-line native code: a JAX function of small arrays, as scalar operations, over many runs or as C99.

Public names are listed in `__init__.pyi` and loaded when first used; this is the only stable import path.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
