"""The algebra of random affine maps z = G y + n: sampling and joint moments of one object.

Knows nothing of filters or networks. Start with `base`, then `atoms` and `combine`; filters read `second_order`."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
