"""Public names of the room; the package loads them when first used."""

from .steady_state import (
    CriticalArrival as CriticalArrival,
    critical_arrival as critical_arrival,
)
from .polynomial_filter_errors import (
    GainOverLinear as GainOverLinear,
    gain_over_linear as gain_over_linear,
)
from .jump_system import (
    JumpSystem as JumpSystem,
)
from .monomial_lifted_system import (
    lifted_system as lifted_system,
)
from .mode_switching_system import (
    modal_system as modal_system,
)
from .lmmse_recursion import (
    lmmse as lmmse,
    true_covariance as true_covariance,
)
from .system import (
    Gains as Gains,
    Schedule as Schedule,
    load_schedule as load_schedule,
)
from .steady_state import (
    SteadyState as SteadyState,
)
from .system import (
    LinearSystem as LinearSystem,
    Steps as Steps,
    state_moments as state_moments,
)
