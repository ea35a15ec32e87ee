"""Public names, in the order data flows. The package loads them when first used; this list is the only one."""

from . import (
    random_affine as random_affine,
    model as model,
    models as models,
    linear as linear,
    relays as relays,
    h_infinity as h_infinity,
    filters as filters,
    smoothing as smoothing,
    fusion as fusion,
    simulation as simulation,
    forecasting as forecasting,
    learning as learning,
    planning as planning,
    files as files,
    campaign as campaign,
    testing as testing,
)
from .numerics.check import (
    InputError as InputError,
)
from .random_affine.laws.fading import (
    Rayleigh as Rayleigh,
)
from .random_affine.words.bit_flips import (
    decode_and_forward as decode_and_forward,
)
from .random_affine.laws.law import (
    Discrete as Discrete,
)
from .random_affine.noises.noise import (
    Gaussian as Gaussian,
)
from .random_affine.noises.outlier_noise import (
    Contaminated as Contaminated,
    StudentT as StudentT,
)
from .model.plant import (
    LinearPlant as LinearPlant,
    Plant as Plant,
)
from .model.sensor import (
    LinearSensor as LinearSensor,
    Sensor as Sensor,
)
from .model.sensor import (
    state_space as state_space,
)
from .model.diffuse_start import (
    diffuse as diffuse,
)
from .model.markov_jump_models import (
    markov_plant as markov_plant,
    markov_sensor as markov_sensor,
)
from .model.channel import (
    amplify_and_forward as amplify_and_forward,
    dropout as dropout,
    erasure as erasure,
    hop as hop,
    parallel as parallel,
    perfect as perfect,
    superposed as superposed,
)
from .model.fading import (
    gilbert_elliott as gilbert_elliott,
    markov_fading as markov_fading,
    shared as shared,
)
from .model.trigger import (
    Periodic as Periodic,
    SendOnDelta as SendOnDelta,
    SendOnPredictionError as SendOnPredictionError,
    StochasticTrigger as StochasticTrigger,
)
from .model.words.encoder import (
    Words as Words,
)
from .filters.event.factory import (
    event_filter as event_filter,
)
from .filters.gaussian.factories import (
    cubature_filter as cubature_filter,
    extended_filter as extended_filter,
    mean_gain_filter as mean_gain_filter,
)
from .filters.gaussian.factories import (
    kalman_filter as kalman_filter,
)
from .filters.gaussian.unscented import (
    unscented_filter as unscented_filter,
)
from .filters.linear.linear import (
    linear_filter as linear_filter,
)
from .filters.words.factory import (
    word_filter as word_filter,
)
from .filters.linear.polynomial import (
    polynomial_filter as polynomial_filter,
)
from .filters.gaussian.adaptive import (
    adaptive_filter as adaptive_filter,
)
from .filters.gaussian.robust_factory import (
    robust_filter as robust_filter,
)
from .linear.steady_state import (
    steady_state as steady_state,
)
from .smoothing.rts import (
    rts_smoother as rts_smoother,
)
from .fusion.rules import (
    CovarianceIntersection as CovarianceIntersection,
)
from .fusion.network_fusion import (
    Fusion as Fusion,
)
from .simulation.node import (
    Node as Node,
)
from .simulation.network import (
    Network as Network,
)
from .simulation.simulate import (
    monte_carlo as monte_carlo,
    simulate as simulate,
)
from .simulation.recordings.filter_recording import (
    run as run,
)
from .simulation.likelihood import (
    log_likelihood as log_likelihood,
)
from .simulation.results.consistency import (
    consistency as consistency,
    nees as nees,
    nis as nis,
)
from .simulation.results.record import (
    Record as Record,
)
from .simulation.results.error_sums import (
    Statistics as Statistics,
)
from .forecasting.forecast import (
    forecast as forecast,
)
from .forecasting.backtest import (
    backtest as backtest,
)
from .learning.parametric_network import (
    free as free,
)
from .learning.fitting import (
    fit as fit,
)
from .live.stream import (
    Stream as Stream,
)
from .live.timeline import (
    Timeline as Timeline,
)
from .export.c_files import (
    export_c as export_c,
)
from .planning.network_design import (
    design as design,
)
from .planning.sent_power import (
    power as power,
)
from .report.progress import (
    show_progress as show_progress,
)

__version__: str
