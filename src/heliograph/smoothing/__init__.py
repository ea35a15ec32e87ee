"""Estimates of earlier states from later data too: fixed interval, fixed lag, fixed point."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
