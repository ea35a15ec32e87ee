"""Public names of the room; the package loads them when first used."""

from .allocation import (
    Allocation as Allocation,
    LeastPower as LeastPower,
)
from .budget import (
    Budget as Budget,
)
from .criterion import (
    Error as Error,
)
from .fixed_point import (
    least_power as least_power,
    water_filling as water_filling,
)
from .independent import (
    independent_paths as independent_paths,
)
from .paths import (
    Paths as Paths,
)
from .semidefinite import (
    semidefinite_least_power as semidefinite_least_power,
    semidefinite_powers as semidefinite_powers,
)
