"""Names that other folders take; the package loads them when first used."""

from .accepted_models import accept_limits as accept_limits
from .accepted_models import accept_sensor_inputs as accept_sensor_inputs
from .accepted_models import accept_told_numbers as accept_told_numbers
from .delay import build_behind_delays as build_behind_delays
from .delay import deliver_line_as_current as deliver_line_as_current
from .fed_back import FedBackFilter as FedBackFilter
from .fed_back import PredictionFilter as PredictionFilter
from .late_data import late_filter as late_filter
from .sensor_inputs import FilterOfInputs as FilterOfInputs
from .state_limits import LimitedFilter as LimitedFilter
from .told_link_law import ToldFilter as ToldFilter
from .told_link_law import believe_typical as believe_typical
from .wrapper import AbstractWrapper as AbstractWrapper
