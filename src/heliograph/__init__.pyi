"""Public names, in the order data flows. The package loads them when first used; this list is the only one."""

from .model.over_time import (
    OverTime as OverTime,
    over_time as over_time,
)
from .random_affine import (
    AbstractRandomAffine as AbstractRandomAffine,
    Constant as Constant,
    Discrete as Discrete,
    FiniteSupport as FiniteSupport,
    GainAndNoise as GainAndNoise,
    Gaussian as Gaussian,
    GivenMoments as GivenMoments,
    Independent as Independent,
    Lift as Lift,
    LogNormal as LogNormal,
    Mixture as Mixture,
    Nakagami as Nakagami,
    NoiseMoments as NoiseMoments,
    Rayleigh as Rayleigh,
    Rician as Rician,
    Series as Series,
    Shaped as Shaped,
    Stack as Stack,
    bernoulli as bernoulli,
    known as known,
    recorded_noise as recorded_noise,
    second_order as second_order,
    square as square,
)
from .model.plant import (
    LinearPlant as LinearPlant,
    Plant as Plant,
    with_bias as with_bias,
)
from .model.sensor import (
    LinearSensor as LinearSensor,
    Sensor as Sensor,
)
from .model.channel import (
    amplify_and_forward as amplify_and_forward,
    dropout as dropout,
    erasure as erasure,
    hop as hop,
    mean_gain as mean_gain,
    parallel as parallel,
    perfect as perfect,
    silent as silent,
    with_direct_link as with_direct_link,
)
from .model.estimate import (
    Estimate as Estimate,
    Innovation as Innovation,
)
from .filters.base import (
    AbstractFilter as AbstractFilter,
)
from .filters.transform import (
    Cubature as Cubature,
    Linearization as Linearization,
    PolynomialMoments as PolynomialMoments,
)
from .filters.correction import (
    Scalars as Scalars,
)
from .filters.update import (
    Interval as Interval,
    Polytope as Polytope,
    ZeroMean as ZeroMean,
)
from .linear.system import (
    LinearSystem as LinearSystem,
    Steps as Steps,
    state_moments as state_moments,
)
from .linear.lift import (
    lifted_system as lifted_system,
)
from .linear.schedule import (
    Gains as Gains,
    Schedule as Schedule,
    load_schedule as load_schedule,
)
from .linear.recursion import (
    lmmse as lmmse,
    true_covariance as true_covariance,
)
from .linear.comparison import (
    GainOverLinear as GainOverLinear,
    gain_over_linear as gain_over_linear,
)
from .h_infinity.growth_system import (
    Growth as Growth,
    GrowthSystem as GrowthSystem,
    growth_system as growth_system,
)
from .h_infinity.growth_check import (
    GrowthFinding as GrowthFinding,
    check_growth as check_growth,
    check_size as check_size,
)
from .h_infinity.design import (
    HInfinityDesign as HInfinityDesign,
    horizon_design as horizon_design,
    recursive_design as recursive_design,
    smallest_recursive_level as smallest_recursive_level,
)
from .h_infinity.closed_form import (
    known_channel_design as known_channel_design,
    level_without_measurements as level_without_measurements,
)
from .h_infinity.certificate import (
    HInfinityCertificate as HInfinityCertificate,
    certify_level as certify_level,
)
from .filters.gaussian import (
    cubature_filter as cubature_filter,
    extended_filter as extended_filter,
    gaussian_filter as gaussian_filter,
    mean_gain_filter as mean_gain_filter,
)
from .filters.kalman import (
    kalman_filter as kalman_filter,
)
from .filters.prediction import (
    prediction_of as prediction_of,
)
from .filters.linear import (
    linear_filter as linear_filter,
    open_loop_filter as open_loop_filter,
)
from .filters.scheduled import (
    LinearSystemFilter as LinearSystemFilter,
    ScheduledFilter as ScheduledFilter,
)
from .filters.polynomial import (
    PolynomialFilter as PolynomialFilter,
    memory_filter as memory_filter,
    polynomial_filter as polynomial_filter,
    scheduled_polynomial_filter as scheduled_polynomial_filter,
)
from .filters.mixture import (
    mixture_filter as mixture_filter,
)
from .filters.h_infinity import (
    HInfinityFilter as HInfinityFilter,
    h_infinity_filter as h_infinity_filter,
)
from .filters.sequential import (
    sequential_filter as sequential_filter,
)
from .fusion.quantizer import (
    AbstractQuantizer as AbstractQuantizer,
    EscapeQuantizer as EscapeQuantizer,
    Quantized as Quantized,
    UniformQuantizer as UniformQuantizer,
)
from .fusion.rules import (
    CovarianceIntersection as CovarianceIntersection,
    EqualIntersection as EqualIntersection,
    FixedIntersection as FixedIntersection,
    Fusion as Fusion,
    InverseCovarianceIntersection as InverseCovarianceIntersection,
    WeightedFusion as WeightedFusion,
    fuse as fuse,
)
from .fusion.level import (
    fused_error_norm as fused_error_norm,
    fused_level as fused_level,
    level_weights as level_weights,
)
from .model.relays import (
    RelayNetwork as RelayNetwork,
)
from .relays.design import (
    RelayDesign as RelayDesign,
    given_design as given_design,
    relay_schedules as relay_schedules,
)
from .relays.own_error import (
    own_error_design as own_error_design,
)
from .relays.receiver_error import (
    receiver_error_design as receiver_error_design,
)
from .relays.receiver import (
    receiver_behind_relays as receiver_behind_relays,
)
from .relays.periodic import (
    periodic_behind_relays as periodic_behind_relays,
    periodic_given_design as periodic_given_design,
    periodic_own_error_design as periodic_own_error_design,
)
from .relays.periodic_tuning import (
    periodic_receiver_error_design as periodic_receiver_error_design,
    periodic_relays_for_best_receiver as periodic_relays_for_best_receiver,
)
from .simulation.network import (
    Network as Network,
    Node as Node,
)
from .simulation.simulate import (
    monte_carlo as monte_carlo,
    run as run,
)
from .simulation.likelihood import (
    log_likelihood as log_likelihood,
)
from .simulation.over_runs import (
    over_runs as over_runs,
)
from .simulation.stream import (
    Stream as Stream,
)
from .simulation.record import (
    Uplink as Uplink,
    Record as Record,
    Trajectories as Trajectories,
)
from .simulation.statistics import (
    ErrorStatistics as ErrorStatistics,
    Statistics as Statistics,
    error_statistics as error_statistics,
    pool as pool,
)
from .campaign.read import (
    load_campaign as load_campaign,
)
from .campaign.plan import (
    Campaign as Campaign,
)
from .campaign.run import (
    CampaignRun as CampaignRun,
    run_campaign as run_campaign,
)
from .campaign.summary import (
    open_results as open_results,
)
from .report.progress import (
    show_progress as show_progress,
)
from .numerics.compilation_cache import (
    keep_compilations as keep_compilations,
)

__version__: str
