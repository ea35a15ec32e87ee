"""Public names of the room; the package loads them when first used."""

from .transmission.recorded_signal import (
    arrivals as arrivals,
)
from .centres.cross_covariances import (
    CrossCovariances as CrossCovariances,
    cross_covariances as cross_covariances,
    fused_covariances as fused_covariances,
)
from .mesh.errors import (
    MeshErrors as MeshErrors,
    best_possible as best_possible,
    freeze as freeze,
    mesh_arrivals as mesh_arrivals,
    mesh_errors as mesh_errors,
)
from .mesh.mean_errors import (
    mean_mesh_errors as mean_mesh_errors,
)
from .boundedness import (
    Boundedness as Boundedness,
    certify_boundedness as certify_boundedness,
)
from .declared_noise.judgement import (
    DeclaredBias as DeclaredBias,
    DeclaredClass as DeclaredClass,
    DeclaredJudgement as DeclaredJudgement,
    judge_declared as judge_declared,
    judge_declared_links as judge_declared_links,
)
from .description.angle_doubts import (
    WideAngles as WideAngles,
)
from .description.doubtful_estimates import (
    doubt_estimates as doubt_estimates,
)
from .description.doubts import (
    Doubt as Doubt,
    doubts_before_data as doubts_before_data,
)
from .rows.output_columns import (
    FilterColumns as FilterColumns,
)
from .rows.row_smoother import (
    RowSmoother as RowSmoother,
)
from .rows.row_step import (
    RowStep as RowStep,
)
from .runs.compilation_cache import (
    keep_compilations as keep_compilations,
)
from .runs.map_over_runs import (
    over_runs as over_runs,
)
from .results.reducer import (
    AbstractReducer as AbstractReducer,
    OfStep as OfStep,
    Trajectories as Trajectories,
)
from .network_filters import (
    centre_filter as centre_filter,
)
from .centres.uplinks import (
    SentReports as SentReports,
    Uplink as Uplink,
)
from .centres.named_filter import (
    NamedFilter as NamedFilter,
    find_filter_by_name as find_filter_by_name,
)
from .mesh.node_filter import (
    NodeFilter as NodeFilter,
    node_network as node_network,
)
from .centres.relay_tree import (
    RelayTree as RelayTree,
    relay_tree as relay_tree,
)
from .results.statistics import (
    ErrorStatistics as ErrorStatistics,
    pool as pool,
)
from .results.error_sums import (
    error_statistics as error_statistics,
)
from .results.error_statistics_by_name import (
    StatisticsByName as StatisticsByName,
)
from .results.consistency import (
    Consistency as Consistency,
)
from .results.whiteness import (
    memory_test as memory_test,
    MemoryTest as MemoryTest,
    score_innovations as score_innovations,
    whitened_innovations as whitened_innovations,
)
from .transmission.recorded_signal import (
    transmit as transmit,
)
