"""Public names of the room; the package loads them when first used."""

from .certificate import (
    HInfinityCertificate as HInfinityCertificate,
    certify_level as certify_level,
)
from .closed_form_design import (
    known_channel_design as known_channel_design,
)
from .design import (
    HInfinityDesign as HInfinityDesign,
    horizon_design as horizon_design,
    recursive_design as recursive_design,
)
from .filter import (
    HInfinityFilter as HInfinityFilter,
    h_infinity_filter as h_infinity_filter,
)
from .lipschitz_check import (
    GrowthFinding as GrowthFinding,
    check_growth as check_growth,
)
from .error_system import (
    Growth as Growth,
    GrowthSystem as GrowthSystem,
    growth_system as growth_system,
)
