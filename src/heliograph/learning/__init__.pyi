"""Public names of the room; the package loads them when first used."""
