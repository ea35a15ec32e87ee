"""How much memory a process has had at most."""

import math
import sys


def peak_gb() -> float:
    """Gigabytes; NaN on systems that do not say."""
    try:
        import resource
    except ModuleNotFoundError:  # Windows has none
        return math.nan
    unit = 1e9 if sys.platform == "darwin" else 1e6
    return float(resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / unit)
