"""Smoothing: estimates of earlier states from later data too, with fixed interval, fixed lag or fixed point."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
