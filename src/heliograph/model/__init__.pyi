"""Public names of the room; the package loads them when first used."""

from .channel import (
    mean_gain as mean_gain,
    silent as silent,
)
from .estimate import (
    Innovation as Innovation,
)
from .over_time import (
    OverTime as OverTime,
)
from .plant import (
    with_bias as with_bias,
)
from .relays import (
    RelayNetwork as RelayNetwork,
)
