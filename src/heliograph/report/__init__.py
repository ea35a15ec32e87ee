"""Figures and self-contained HTML pages; the only place that imports a plotting library (the extra `report`)."""

from heliograph.numerics.lazy_exports import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
