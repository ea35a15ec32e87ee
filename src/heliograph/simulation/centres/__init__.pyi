"""Names that other folders take; the package loads them when first used."""

from .centre_filter import CentreFilter as CentreFilter
from .fused_innovation import FusedInnovation as FusedInnovation
from .fused_innovation import following_prior as following_prior
from .fused_innovation import make_fused_innovations as make_fused_innovations
from .fusion_centre import CentreState as CentreState
from .fusion_centre import FusionCentre as FusionCentre
from .fusion_centre import find_claim_of_informed_fusion as find_claim_of_informed_fusion
from .fusion_centre import find_claim_of_report_fusion as find_claim_of_report_fusion
from .fusion_centre import has_data_dependent_gains as has_data_dependent_gains
from .fusions import ReportFusion as ReportFusion
from .fusions import StackedFusions as StackedFusions
from .fusions import build_centre_filter as build_centre_filter
from .fusions import build_report_fusions as build_report_fusions
from .fusions import list_centres as list_centres
from .fusions import list_stacked_fusions as list_stacked_fusions
from .linearised_centre import LinearisedCentre as LinearisedCentre
from .linearised_centre import LinearisedFusionState as LinearisedFusionState
from .named_filter import find_filter_by_name as find_filter_by_name
from .observation_model import ObservationModel as ObservationModel
from .observation_model import SeparateObservations as SeparateObservations
from .observation_model import stack_nodes as stack_nodes
from .uplinks import SentReports as SentReports
from .uplinks import Uplink as Uplink
from .uplinks import UplinkDraws as UplinkDraws
