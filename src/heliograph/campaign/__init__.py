"""Campaigns: many settings of one network, simulated into one labelled store that survives any interruption."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
