"""Gaussians by their mean and the factors L diag(d) L' of their covariance."""

from heliograph.numerics.lazy_exports import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
