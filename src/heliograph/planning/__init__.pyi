"""Public names of the room; the package loads them when first used."""

from .budget import (
    Budget as Budget,
)
from .certificate import (
    Certificate as Certificate,
)
from .criterion import (
    Error as Error,
)
from .outcome import (
    NetworkDesign as NetworkDesign,
)
from .sent import (
    SentPower as SentPower,
)
