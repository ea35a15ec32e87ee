"""Names that other folders take; the package loads them when first used."""

from .factory import build_partly_drawn as build_partly_drawn
from .rao_blackwellised import PartlyDrawnFilter as PartlyDrawnFilter
from .resampling import effective_number as effective_number
from .resampling import fold_in_bits as fold_in_bits
from .resampling import invert_distribution as invert_distribution
from .resampling import resample_systematically as resample_systematically
from .state_particles import MANY as MANY
from .state_particles import StateParticleFilter as StateParticleFilter
from .state_particles import StateParticles as StateParticles
from .state_particles import build_state_particles as build_state_particles
