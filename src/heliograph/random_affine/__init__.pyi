"""Public names of the room; the package loads them when first used."""

from .hop import (
    GainAndNoise as GainAndNoise,
    known as known,
)
from .markov_chain_and_autoregression import (
    MarkovChain as MarkovChain,
    Autoregression as Autoregression,
)
from .mixture import (
    Mixture as Mixture,
)
from .series_and_stack import (
    Series as Series,
    Stack as Stack,
)
from .moments.monomial_lift import (
    Lift as Lift,
    square as square,
)
from .laws.fading import (
    LogNormal as LogNormal,
    Nakagami as Nakagami,
    Rician as Rician,
)
from .laws.law import (
    AbstractLaw as AbstractLaw,
    Constant as Constant,
    GivenMoments as GivenMoments,
    bernoulli as bernoulli,
)
from .delay import (
    DelayLine as DelayLine,
)
from .modes import (
    Faded as Faded,
    Modes as Modes,
    joint_modes as joint_modes,
)
from .noises.noise_from_moments import (
    NoiseMoments as NoiseMoments,
    recorded_noise as recorded_noise,
)
from .noises.noise import (
    AbstractNoise as AbstractNoise,
    FiniteSupport as FiniteSupport,
    Independent as Independent,
)
from .noises.shaped_noise import (
    Shaped as Shaped,
)
from .moments.second_moments import (
    second_order as second_order,
)
from .phase_rotation import (
    Rotation as Rotation,
)
from .sum_of_maps import (
    Superposed as Superposed,
)
from .base import (
    AbstractRandomAffine as AbstractRandomAffine,
)
