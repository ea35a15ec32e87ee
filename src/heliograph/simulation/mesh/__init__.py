"""Fusion between neighbours, without a centre: every node fuses what arrives from its neighbours."""

from heliograph.numerics.lazy_exports import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
