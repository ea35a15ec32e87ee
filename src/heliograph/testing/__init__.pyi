"""Public names of the room; the package loads them when first used."""

from .channels import (
    check_random_affine as check_random_affine,
)
from .filters import (
    check_filter as check_filter,
)
from .fusion import (
    check_quantizer as check_quantizer,
    check_fusion as check_fusion,
)
from .scaling import (
    check_scaling as check_scaling,
)
