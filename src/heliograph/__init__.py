"""State estimation over relay networks: describe plant, sensors, relays and fusion once; simulate, filter, report.

Public names are listed in `__init__.pyi`, in the order data flows, and loaded when first used; this is the only stable
import path.
"""

from heliograph.numerics.names import lazy_names

__getattr__, __dir__, __all__ = lazy_names(__name__, __file__)

__version__ = "0.2.0"
