"""Public names of the room; the package loads them when first used."""

from .engine import (
    engine_of as engine_of,
)
