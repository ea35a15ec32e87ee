"""Names that other folders take; the package loads them when first used."""

from .design import design_paths as design_paths
from .model import Paths as Paths
from .model import require_at_least as require_at_least
from .network_to_paths import paths_of as paths_of
from .path_problem import make_power_task as make_power_task
