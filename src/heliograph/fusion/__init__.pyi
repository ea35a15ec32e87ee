"""Public names of the room; the package loads them when first used."""

from .all_reports_fusion import (
    AllReports as AllReports,
)
from .report_link import (
    EventSending as EventSending,
)
from .joint_covariance_fusion import (
    DiagonalWeights as DiagonalWeights,
    MatrixWeights as MatrixWeights,
    ScalarWeights as ScalarWeights,
)
from .h_infinity_levels import (
    fused_error_norm as fused_error_norm,
    fused_level as fused_level,
    level_weights as level_weights,
)
from .mesh.graph import (
    neighbours_within as neighbours_within,
)
from .mesh.neighbour_rules import (
    DiffusionWeights as DiffusionWeights,
    FrozenWeights as FrozenWeights,
    TraceIntersection as TraceIntersection,
)
from .quantizer import (
    AbstractQuantizer as AbstractQuantizer,
    Quantized as Quantized,
)
from .escape_quantizer import EscapeQuantizer as EscapeQuantizer
from .zoom_quantizer import (
    ZoomQuantizer as ZoomQuantizer,
)
from .quantizer import (
    UniformQuantizer as UniformQuantizer,
)
from .report_link import (
    ReportLink as ReportLink,
)
from .rules import (
    EqualIntersection as EqualIntersection,
    AbstractFusion as AbstractFusion,
    FixedIntersection as FixedIntersection,
    InverseCovarianceIntersection as InverseCovarianceIntersection,
    WeightedFusion as WeightedFusion,
    fuse as fuse,
)
from .split_covariance_intersection import (
    SplitIntersection as SplitIntersection,
)
