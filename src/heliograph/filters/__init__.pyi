"""Public names of the room; the package loads them when first used."""

from .base import (
    AbstractFilter as AbstractFilter,
    believes as believes,
    corrects as corrects,
    estimates as estimates,
    in_float64 as in_float64,
    predicts as predicts,
)
from .wrappers.clock import (
    clock_filter as clock_filter,
)
from .gaussian.uncertain_channel_bounds import (
    Scalars as Scalars,
)
from .wrappers.mean_covariance_bound import (
    mean_error_bound as mean_error_bound,
)
from .wrappers.late_data import late_filter as late_filter
from .wrappers.delay import (
    part_filter as part_filter,
)
from .wrappers.fed_back import (
    fed_back_filter as fed_back_filter,
)
from .gaussian.factories import (
    gaussian_filter as gaussian_filter,
)
from .innovation import (
    InnovationSummary as InnovationSummary,
    Weighed as Weighed,
    gaussian_innovation as gaussian_innovation,
    mixed_innovation as mixed_innovation,
)
from .plausibility import (
    Judgement as Judgement,
)
from .filter_for_likelihood import (
    likelihood_filter as likelihood_filter,
)
from .linear.memory_ignored import (
    as_current_filter as as_current_filter,
    memoryless_filter as memoryless_filter,
)
from .gaussian.gaussian_prediction import (
    open_loop_filter as open_loop_filter,
)
from .modes.finite_support_filter import (
    mixture_filter as mixture_filter,
)
from .modes.multiple_model import (
    gpb1_filter as gpb1_filter,
    gpb2_filter as gpb2_filter,
    imm_filter as imm_filter,
)
from .modes.particle import (
    particle_filter as particle_filter,
)
from .linear.polynomial import (
    PolynomialFilter as PolynomialFilter,
    scheduled_polynomial_filter as scheduled_polynomial_filter,
)
from .linear.memory_filter import memory_filter as memory_filter
from .wrappers.fed_back import (
    prediction_of as prediction_of,
)
from .modes.mode_observed import (
    mode_known_filter as mode_known_filter,
    mode_late_filter as mode_late_filter,
)
from .rows.run_over_data import (
    Filtered as Filtered,
)
from .linear.scheduled_gains import (
    LinearSystemFilter as LinearSystemFilter,
    ScheduledFilter as ScheduledFilter,
)
from .gaussian.sequential_nodes import (
    sequential_filter as sequential_filter,
)
from .modes.side_information import (
    side_information_filter as side_information_filter,
)
from .gaussian.moment_transforms import (
    AbstractTransform as AbstractTransform,
    Cubature as Cubature,
    Linearization as Linearization,
    PolynomialMoments as PolynomialMoments,
    Transformed as Transformed,
)
from .gaussian.unscented import (
    Unscented as Unscented,
)
from .gaussian.uncertain_channel_updates import (
    AbstractUpdate as AbstractUpdate,
    Interval as Interval,
    Polytope as Polytope,
    ZeroMean as ZeroMean,
)
from .linear.true_error import (
    TrueError as TrueError,
    true_error as true_error,
)
from .gaussian.robust import (
    Gate as Gate,
    Huber as Huber,
    InverseMultiquadric as InverseMultiquadric,
    StudentVB as StudentVB,
    WoLF as WoLF,
)
