"""Names that other folders take; the package loads them when first used."""

from .factor_of_covariance import FACTOR_TOLERANCE as FACTOR_TOLERANCE
from .noise import AbstractNoise as AbstractNoise
from .noise import FiniteSupport as FiniteSupport
from .noise import Gaussian as Gaussian
from .noise import Independent as Independent
from .noise import Matrix as Matrix
from .noise import NoiseLike as NoiseLike
from .noise import Number as Number
from .noise import Square as Square
from .noise import Vector as Vector
from .noise import as_noise as as_noise
from .noise import count_components as count_components
from .noise import noise_moment_vector as noise_moment_vector
from .noise_from_moments import about_mean as about_mean
from .outlier_noise import Contaminated as Contaminated
from .outlier_noise import StudentT as StudentT
from .outlier_noise import has_bounded_noise as has_bounded_noise
from .shaped_noise import Shaped as Shaped
