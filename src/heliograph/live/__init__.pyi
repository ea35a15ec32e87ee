"""Public names of the room; the package loads them when first used."""

from .event import (
    Event as Event,
)
from .health.link_counts import (
    LinkCounts as LinkCounts,
)
