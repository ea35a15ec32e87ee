"""Public names of the room; the package loads them when first used."""

from .design import (
    RelayDesign as RelayDesign,
    given_design as given_design,
    relay_schedules as relay_schedules,
    local_error_design as local_error_design,
)
from .periodic_steady_state import (
    periodic_behind_relays as periodic_behind_relays,
    periodic_given_design as periodic_given_design,
    periodic_local_error_design as periodic_local_error_design,
)
from .periodic_steady_state import (
    periodic_receiver_error_design as periodic_receiver_error_design,
    periodic_relays_for_best_receiver as periodic_relays_for_best_receiver,
)
from .receiver import (
    receiver_behind_relays as receiver_behind_relays,
    receiver_system as receiver_system,
)
from .design_for_receiver_error import (
    receiver_error_design as receiver_error_design,
)
