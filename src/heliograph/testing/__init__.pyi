"""Public names of the room; the package loads them when first used."""

from .channel_contract import (
    check_random_affine as check_random_affine,
)
from .filter_contract import (
    check_filter as check_filter,
)
from .fusion_and_quantizer_contract import (
    check_quantizer as check_quantizer,
    check_fusion as check_fusion,
)
from .unit_invariance import (
    check_scaling as check_scaling,
)
