"""Names that other folders take; the package loads them when first used."""

from .additive_links import AdditiveModalFilter as AdditiveModalFilter
from .additive_links import additive_modal_filter as additive_modal_filter
from .additive_links import independent_terms as independent_terms
from .arrival_patterns import ChannelByPattern as ChannelByPattern
from .arrival_patterns import append_flag as append_flag
from .arrival_patterns import describe_by_pattern as describe_by_pattern
from .arrival_patterns import pattern_of as pattern_of
from .channel_by_mode import ChannelByMode as ChannelByMode
from .channel_by_mode import channels_by_mode as channels_by_mode
from .correction_by_mode import correct_in_every_mode as correct_in_every_mode
from .finite_support_filter import AtomCombinations as AtomCombinations
from .finite_support_filter import MixtureFilter as MixtureFilter
from .jump_linear_filter import ModalFilter as ModalFilter
from .jump_linear_filter import claim_of_modes as claim_of_modes
from .jump_linear_filter import modal_filter as modal_filter
from .mixing import replicate as replicate
from .mode_observed import ModeObservedFilter as ModeObservedFilter
from .models_by_mode import find_models as find_models
from .multiple_model import ModalBeliefs as ModalBeliefs
from .multiple_model import MultipleModelFilter as MultipleModelFilter
from .multiple_model import imm_filter as imm_filter
from .side_information import SideInformationFilter as SideInformationFilter
from .side_information import side_information_filter as side_information_filter
from .uncertain_chain import UncertainModalFilter as UncertainModalFilter
from .uncertain_chain import uncertain_modal_filter as uncertain_modal_filter
