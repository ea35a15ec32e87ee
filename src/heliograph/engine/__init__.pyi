"""Public names of the room; the package loads them when first used."""

from .choice import (
    engine_of as engine_of,
)
