"""Names that other folders take; the package loads them when first used."""

from .bag import OFTEN as OFTEN
from .bag import Progress as Progress
from .bag import is_bag as is_bag
from .bag import list_fields as list_fields
from .bag import open_bag as open_bag
from .bag import parts_of as parts_of
from .bag import read_bag as read_bag
from .mcap_chunks import read_messages_in_order as read_messages_in_order
from .mcap_messages import holds_messages as holds_messages
from .mcap_messages import read_mcap_messages as read_mcap_messages
from .output import write_bag as write_bag
