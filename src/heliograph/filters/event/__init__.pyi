"""Names that other folders take; the package loads them when first used."""

from .event_filter import EventFilter as EventFilter
from .stochastic_event_filter import StochasticEventFilter as StochasticEventFilter
from .truncated_normal import upper_tail as upper_tail
