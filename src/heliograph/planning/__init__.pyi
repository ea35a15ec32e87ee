"""Public names of the room; the package loads them when first used."""

from .allocation import (
    Allocation as Allocation,
    LeastPower as LeastPower,
)
from .budget import (
    Budget as Budget,
)
from .bursts import (
    Bursts as Bursts,
    burst_sending as burst_sending,
)
from .certificate import (
    Certificate as Certificate,
)
from .choose import (
    Choice as Choice,
    choose_sensors as choose_sensors,
)
from .coherent import (
    CoherentDesign as CoherentDesign,
    CoherentSum as CoherentSum,
    coherent_least_power as coherent_least_power,
    coherent_powers as coherent_powers,
    coherent_programme as coherent_programme,
    coherent_sum as coherent_sum,
)
from .criterion import (
    Error as Error,
)
from .designed import (
    designed_network as designed_network,
)
from .feedback import (
    FeedbackLimit as FeedbackLimit,
    fed_back_channel as fed_back_channel,
    feedback_limit as feedback_limit,
)
from .fixed_point import (
    least_power as least_power,
    water_filling as water_filling,
)
from .front import (
    Front as Front,
    error_over_power as error_over_power,
)
from .independent import (
    independent_paths as independent_paths,
)
from .outcome import (
    NetworkDesign as NetworkDesign,
)
from .paths import (
    Paths as Paths,
)
from .purchases import (
    Purchase as Purchase,
    purchases_of as purchases_of,
)
from .reading import (
    paths_of as paths_of,
)
from .relay_line import (
    RelayLine as RelayLine,
    best_relays as best_relays,
    relay_line as relay_line,
)
from .relay_scene import (
    Radio as Radio,
    RelayScene as RelayScene,
)
from .relay_sites import (
    RelayMap as RelayMap,
    relay_map as relay_map,
    choose_relays as choose_relays,
)
from .schedules import (
    SendingSchedule as SendingSchedule,
    best_schedule as best_schedule,
)
from .semidefinite import (
    semidefinite_least_power as semidefinite_least_power,
    semidefinite_powers as semidefinite_powers,
)
from .sent import (
    SentPower as SentPower,
)
from .site_map import (
    SiteMap as SiteMap,
    error_over_sites as error_over_sites,
)
from .splits import (
    path_noise as path_noise,
    power_for_noise as power_for_noise,
    split_power as split_power,
)
from .task import (
    Task as Task,
)
