"""Names that other folders take; the package loads them when first used."""

from .derived import Computed as Computed
from .fields import TimeUnit as TimeUnit
from .fields import convert_name as convert_name
from .fields import convert_time as convert_time
from .fields import decode_items as decode_items
from .fields import decode_json as decode_json
from .fields import fail_of_doubled as fail_of_doubled
from .fields import field_at as field_at
from .fields import is_stamp as is_stamp
from .fields import match_topic as match_topic
from .fields import parse_arrival as parse_arrival
from .fields import parse_number as parse_number
from .fields import parse_start as parse_start
from .json_field import Source as Source
from .reading import Reading as Reading
from .reading import Unread as Unread
from .sources import SECOND as SECOND
from .sources import Sources as Sources
