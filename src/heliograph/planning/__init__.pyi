"""Public names of the room; the package loads them when first used."""

from .bit_allocation import (
    BitsDesign as BitsDesign,
    design_bits as design_bits,
)
from .power_budget import (
    Budget as Budget,
)
from .design_comparisons import (
    error_over_power as error_over_power,
    error_over_sites as error_over_sites,
    worth_of_changes as worth_of_changes,
)
from .error_objective import (
    Error as Error,
)
from .message_rates import (
    MessageRate as MessageRate,
    delta_for_rate as delta_for_rate,
    least_error as least_error,
    prediction_error_rate as prediction_error_rate,
    send_on_delta_rate as send_on_delta_rate,
    simulate_rate as simulate_rate,
)
from .multihop_paths.network_to_paths import (
    paths_of as paths_of,
)
from .multihop_paths.model import (
    independent_paths as independent_paths,
)
from .design_problem import (
    DesignProblem as DesignProblem,
    PowerDesign as PowerDesign,
)
from .network_from_design import (
    designed_network as designed_network,
)
from .multihop_paths.power_split_over_hops import (
    split_power as split_power,
)
from .sensor_worth import (
    ErrorWithout as ErrorWithout,
    SensorWorth as SensorWorth,
    worth_of_sensors as worth_of_sensors,
)
