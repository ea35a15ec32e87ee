"""Estimation without a centre: who receives whom, what a node does with what arrived, and what its error is then."""

from heliograph.numerics.lazy_exports import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
