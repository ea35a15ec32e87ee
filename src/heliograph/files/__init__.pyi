"""Public names of the room; the package loads them when first used."""

from .device_availability import (
    Available as Available,
)
from .bags.estimates_writer import (
    Pose as Pose,
)
from .sources.derived_values import (
    Covariance as Covariance,
    Geodetic as Geodetic,
    Yaw as Yaw,
)
from .estimates.estimates_table import (
    write_estimates as write_estimates,
)
from .events.event_table import (
    EventTable as EventTable,
)
from .fitted import (
    load_fitted as load_fitted,
)
from .estimates.forecasts_table import (
    write_forecast as write_forecast,
)
from .sources.source_description import (
    Count as Count,
    Field as Field,
    Level as Level,
    Source as Source,
    Stamp as Stamp,
    json_field as json_field,
)
from .logs.log_sources import (
    LogSources as LogSources,
)
from .sources.lorawan import (
    chirpstack as chirpstack,
    the_things_stack as the_things_stack,
)
from .messages.messages_to_events import (
    read_messages as read_messages,
)
from .network_file import (
    load_network as load_network,
)
from .recordings.recording import (
    Recording as Recording,
    read_recording as read_recording,
    write_recording as write_recording,
)
from .sources.message_reading import (
    Reading as Reading,
)
from .stores.store_tables import (
    read_store as read_store,
    store_estimates as store_estimates,
)
from .tables.table import (
    read_table as read_table,
    write_table as write_table,
)
