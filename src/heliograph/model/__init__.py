"""Models: plants, sensors, channels and relays, constant or over time; and what an estimate is."""

from heliograph.numerics.lazy_exports import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
