"""Names that other folders take; the package loads them when first used."""

from .database import open_database as open_database
from .part_leases import Leases as Leases
from .store import Store as Store
from .store_owner import name_of_process as name_of_process
from .store_owner import own_store as own_store
from .store_protocol import AwayError as AwayError
from .store_protocol import ConflictError as ConflictError
from .store_protocol import Entry as Entry
from .store_protocol import InMemoryStore as InMemoryStore
from .store_protocol import StoreProtocol as StoreProtocol
from .store_protocol import StoredPlant as StoredPlant
from .store_protocol import describe_damaged_plants as describe_damaged_plants
from .store_protocol import identity as identity
