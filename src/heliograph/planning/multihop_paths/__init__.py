"""Powers of independent paths of hops: their information, convex bounds, and designs."""

from heliograph.numerics.lazy_exports import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
