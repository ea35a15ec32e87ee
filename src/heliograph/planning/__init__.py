"""Network design: powers and other numbers for a small error, with certificates of how good they are."""

from heliograph.numerics.lazy_exports import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
