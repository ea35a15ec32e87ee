"""Public names of the room; the package loads them when first used."""

from .fixed_interval_lag_point import (
    AbstractSmoothing as AbstractSmoothing,
    FixedInterval as FixedInterval,
    FixedLag as FixedLag,
    FixedPoint as FixedPoint,
)
from .rts import (
    PlannedSmoother as PlannedSmoother,
    planned_smoother as planned_smoother,
)
from .forward_and_backward_pass import (
    smoother_steps as smoother_steps,
)
from .simulation_smoother import (
    simulation_smoother as simulation_smoother,
)
from .rts import (
    Smoothed as Smoothed,
)
