"""Public names of the room; the package loads them when first used."""

from .held_out_comparison import (
    Comparison as Comparison,
    compare_laws as compare_laws,
)
from .likelihood.predictive_density import (
    Predictive as Predictive,
    predictive as predictive,
)
from .packet_losses.delay_law import (
    Delays as Delays,
)
from .packet_losses.loss_laws import (
    AbstractLossLaw as AbstractLossLaw,
)
from .packet_losses.learn_losses import (
    LossMemory as LossMemory,
    Losses as Losses,
    learn_losses as learn_losses,
)
from .packet_losses.probability_intervals import (
    Share as Share,
)
from .packet_losses.packet_fates import (
    fates_by_hop as fates_by_hop,
    fates_by_node as fates_by_node,
    fates_of_measurements as fates_of_measurements,
    fates_of_sequence as fates_of_sequence,
)
from .hypothesis_tests import (
    FitTest as FitTest,
)
from .fit_result import (
    Fit as Fit,
)
from .identifiability import (
    Identifiability as Identifiability,
    identifiable as identifiable,
)
from .free_parameters import (
    Parameters as Parameters,
)
from .parametric_network import (
    Description as Description,
    describe as describe,
)
from .estimate_row import (
    Row as Row,
)
from .samples_to_decide import (
    samples_to_tell as samples_to_tell,
)
from .sender_fit import (
    SenderFit as SenderFit,
)
