"""Names that other folders take; the package loads them when first used."""

from .migration import PlantMigration as PlantMigration
from .migration import describe_network as describe_network
from .network_changes import DESCRIPTION as DESCRIPTION
from .network_changes import LISTED as LISTED
from .network_changes import SAME as SAME
from .network_changes import list_changes as list_changes
from .old_layout import LOWER as LOWER
from .old_layout import VARIANCES as VARIANCES
from .old_layout import can_read_layout as can_read_layout
from .old_layout import describe_old_layout as describe_old_layout
from .old_layout import factorise_covariance as factorise_covariance
from .old_layout import relocate_parts as relocate_parts
from .old_layout import split_by_path as split_by_path
from .plant_codec import pack_plant as pack_plant
from .plant_codec import unpack_plant as unpack_plant
from .snapshot import Identity as Identity
from .snapshot import check_same_network as check_same_network
from .snapshot import list_versions as list_versions
from .snapshot import network_identity as network_identity
from .snapshot import pack_snapshot as pack_snapshot
from .snapshot import unpack_snapshot as unpack_snapshot
from .timeline_migration import carry_over_timeline as carry_over_timeline
