"""Joint moments of random affine maps and of noises, their atoms, and what becomes of a signal that passes."""

from heliograph.numerics.lazy_exports import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
