"""Names that other folders take; the package loads them when first used."""

from .compilation_cache import keep_compilations as keep_compilations
from .lanes import LANES as LANES
from .lanes import RunLanes as RunLanes
from .lanes import SharedResult as SharedResult
from .lanes import add_sums as add_sums
from .lanes import advance_in_chunks as advance_in_chunks
from .lanes import count_runs_by_batch as count_runs_by_batch
from .lanes import has_processor_alone as has_processor_alone
from .lanes import is_shared as is_shared
from .lanes import split_into_chunks as split_into_chunks
from .map_over_runs import over_runs as over_runs
from .memory import NeededMemory as NeededMemory
from .memory import check_memory as check_memory
from .memory import count_bytes as count_bytes
from .memory import explain_out_of_memory as explain_out_of_memory
from .native import simulate_natively as simulate_natively
from .stacked_filters import StackedFilters as StackedFilters
from .stacked_filters import StepOutput as StepOutput
from .stacked_filters import filter_step as filter_step
from .stacked_filters import initial_state as initial_state
from .stacked_filters import map_all as map_all
from .stacked_filters import stack_filters as stack_filters
from .xla_runs import apply_to_each_run as apply_to_each_run
from .xla_runs import list_used_leaves as list_used_leaves
from .xla_runs import simulate_trajectories as simulate_trajectories
