"""Names that other folders take; the package loads them when first used."""

from .climbs import ClimbEnds as ClimbEnds
from .data import LikelihoodData as LikelihoodData
from .data import gather_data as gather_data
from .multistart import AWAY as AWAY
from .multistart import FURTHER as FURTHER
from .multistart import HighestPoint as HighestPoint
from .multistart import MaximumSearch as MaximumSearch
from .multistart import SPREAD as SPREAD
from .objective import Form as Form
from .objective import Objective as Objective
from .objective import join_all_nodes as join_all_nodes
from .objective import make_objectives as make_objectives
from .parameter_transforms import count_coordinates as count_coordinates
from .parameter_transforms import from_unconstrained as from_unconstrained
from .parameter_transforms import map_from_unconstrained as map_from_unconstrained
from .parameter_transforms import map_to_unconstrained as map_to_unconstrained
from .parameter_transforms import slope_from_unconstrained as slope_from_unconstrained
from .parameter_transforms import slope_to_unconstrained as slope_to_unconstrained
from .parameter_transforms import to_unconstrained as to_unconstrained
from .predictive_density import ChannelDensities as ChannelDensities
from .predictive_density import NODES as NODES
from .predictive_density import Predictive as Predictive
from .predictive_density import evaluate_predictive as evaluate_predictive
from .predictive_density import make_signal_filter as make_signal_filter
from .predictive_density import predictive as predictive
from .surface import LikelihoodSurface as LikelihoodSurface
