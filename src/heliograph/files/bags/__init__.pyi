"""Names that other folders take; the package loads them when first used."""

from .estimates_writer import write_bag as write_bag
from .mcap_chunks import read_messages_in_order as read_messages_in_order
from .mcap_json_and_protobuf import holds_messages as holds_messages
from .mcap_json_and_protobuf import read_mcap_messages as read_mcap_messages
from .ros_bag import OFTEN as OFTEN
from .ros_bag import Progress as Progress
from .ros_bag import is_bag as is_bag
from .ros_bag import list_fields as list_fields
from .ros_bag import open_bag as open_bag
from .ros_bag import parts_of as parts_of
from .ros_bag import read_bag as read_bag
