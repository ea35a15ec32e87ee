"""Public names of the package, which loads them when first used."""

from .compiled import (
    compile as compile,
)
from .nodes import (
    Unsupported as Unsupported,
)
