"""Laws of additive noises, with and without outliers, and factors of their covariances."""

from heliograph.numerics.lazy_exports import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
