"""Names that other folders take; the package loads them when first used."""

from .derived_values import Computed as Computed
from .message_fields import TimeUnit as TimeUnit
from .message_fields import convert_name as convert_name
from .message_fields import convert_time as convert_time
from .message_fields import decode_items as decode_items
from .message_fields import decode_json as decode_json
from .message_fields import fail_of_doubled as fail_of_doubled
from .message_fields import field_at as field_at
from .message_fields import is_stamp as is_stamp
from .message_fields import match_topic as match_topic
from .message_fields import parse_arrival as parse_arrival
from .message_fields import parse_number as parse_number
from .message_fields import parse_start as parse_start
from .message_reading import Reading as Reading
from .message_reading import Unread as Unread
from .source_description import Source as Source
from .topic_reader import SECOND as SECOND
from .topic_reader import TopicReader as TopicReader
