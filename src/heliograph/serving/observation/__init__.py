"""Running services observed: what is wrong with each plant, as a page and as metrics, and tests of covariances."""

from heliograph.numerics.lazy_exports import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
