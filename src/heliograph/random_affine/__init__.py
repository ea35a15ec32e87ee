"""The algebra of random affine maps z = G y + n: sampling and joint moments of one object.

Knows nothing of filters or networks. Start with `base`, then `combine`; filters read `second_order`."""

from heliograph.numerics.lazy_exports import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
