"""Guaranteed ratios of energies: growth bounds, designs by matrix inequalities, certificates."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
