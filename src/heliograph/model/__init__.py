"""Models: plants, sensors, channels and relays, constant or over time; and what an estimate is."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
