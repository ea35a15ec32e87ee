"""Files and folders that appear whole or not at all, and names quoted for where they land."""

from heliograph.numerics.lazy_exports import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)
